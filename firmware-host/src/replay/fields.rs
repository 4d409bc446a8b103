//! Typed access to JSON objects that remembers what was never asked for.

use super::error::ReplayError;
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::path::Path;

/// The fields of one object.
pub struct Fields<'a> {
    path: &'a Path,
    /// Which object, for people.
    at: String,
    map: &'a Map<String, Value>,
    asked: BTreeSet<&'a str>,
}

impl<'a> Fields<'a> {
    /// The object `value`, which stands at `at`.
    ///
    /// # Errors
    /// When it is no object.
    pub fn new(value: &'a Value, path: &'a Path, at: String) -> Result<Self, ReplayError> {
        match value.as_object() {
            Some(map) => Ok(Self { path, at, map, asked: BTreeSet::new() }),
            None => Err(ReplayError::Field {
                path: path.into(),
                at,
                detail: format!("expected an object, found {}", kind(value)),
            }),
        }
    }

    /// Which object this is.
    pub fn at(&self) -> &str {
        &self.at
    }

    /// A field that is wrong.
    pub fn wrong(&self, name: &str, detail: String) -> ReplayError {
        let at = if name.is_empty() { self.at.clone() } else { format!("{}, {name}", self.at) };
        ReplayError::Field { path: self.path.into(), at, detail }
    }

    /// A field that has to be there.
    ///
    /// # Errors
    /// When the option is empty.
    pub fn need<T>(&self, name: &str, value: Option<T>) -> Result<T, ReplayError> {
        value.ok_or_else(|| self.wrong(name, "is missing".into()))
    }

    /// The raw field; nothing for null.
    pub fn value(&mut self, name: &str) -> Option<&'a Value> {
        let (key, value) = self.map.get_key_value(name)?;
        self.asked.insert(key);
        (!value.is_null()).then_some(value)
    }

    /// The first of several names that is there.
    pub fn any(&mut self, names: &[&'static str]) -> Option<(&'static str, &'a Value)> {
        names.iter().find_map(|name| self.value(name).map(|value| (*name, value)))
    }

    /// A number.
    ///
    /// # Errors
    /// When it is something else.
    pub fn number(&mut self, name: &str) -> Result<Option<f64>, ReplayError> {
        self.value(name).map(|v| self.to_number(name, v)).transpose()
    }

    /// Reads a value as a number.
    ///
    /// # Errors
    /// When it is something else.
    pub fn to_number(&self, name: &str, value: &Value) -> Result<f64, ReplayError> {
        value
            .as_f64()
            .ok_or_else(|| self.wrong(name, format!("expected a number, found {}", kind(value))))
    }

    /// A whole number, not negative.
    ///
    /// # Errors
    /// When it is something else.
    pub fn whole(&mut self, name: &str) -> Result<Option<u64>, ReplayError> {
        let Some(value) = self.value(name) else { return Ok(None) };
        let whole = value.as_u64().or_else(|| {
            // `3.0` is a whole number too.
            value.as_f64().filter(|v| *v >= 0.0 && v.fract() == 0.0 && *v < 1e15).map(|v| v as u64)
        });
        whole.map(Some).ok_or_else(|| {
            self.wrong(name, format!("expected a whole number from 0, found {}", kind(value)))
        })
    }

    /// A text.
    ///
    /// # Errors
    /// When it is something else.
    pub fn text(&mut self, name: &str) -> Result<Option<&'a str>, ReplayError> {
        let Some(value) = self.value(name) else { return Ok(None) };
        let text = value.as_str().map(Some);
        text.ok_or_else(|| self.wrong(name, format!("expected a text, found {}", kind(value))))
    }

    /// True or false.
    ///
    /// # Errors
    /// When it is something else.
    pub fn flag(&mut self, name: &str) -> Result<Option<bool>, ReplayError> {
        let Some(value) = self.value(name) else { return Ok(None) };
        let flag = value.as_bool().map(Some);
        flag.ok_or_else(|| {
            self.wrong(name, format!("expected true or false, found {}", kind(value)))
        })
    }

    /// A list.
    ///
    /// # Errors
    /// When it is something else.
    pub fn list(&mut self, name: &str) -> Result<Option<&'a [Value]>, ReplayError> {
        let Some(value) = self.value(name) else { return Ok(None) };
        let list = value.as_array().map(|list| Some(list.as_slice()));
        list.ok_or_else(|| self.wrong(name, format!("expected a list, found {}", kind(value))))
    }

    /// A list of numbers.
    ///
    /// # Errors
    /// When it is something else.
    pub fn numbers(&mut self, name: &str) -> Result<Option<Vec<f64>>, ReplayError> {
        let Some(list) = self.list(name)? else { return Ok(None) };
        list.iter().map(|v| self.to_number(name, v)).collect::<Result<_, _>>().map(Some)
    }

    /// This many numbers.
    ///
    /// # Errors
    /// When it is something else.
    pub fn array<const N: usize>(&mut self, name: &str) -> Result<Option<[f64; N]>, ReplayError> {
        let Some(list) = self.numbers(name)? else { return Ok(None) };
        let count = list.len();
        list.try_into()
            .map(Some)
            .map_err(|_| self.wrong(name, format!("expected {N} numbers, found {count}")))
    }

    /// A field nobody compares.
    pub fn ignore(&mut self, names: &[&str]) {
        for name in names {
            self.value(name);
        }
    }

    /// Adds the names that were never asked for to `unknown`, and forgets them.
    pub fn finish(self, unknown: &mut BTreeSet<String>) {
        for name in self.map.keys().filter(|name| !self.asked.contains(name.as_str())) {
            unknown.insert(name.clone());
        }
    }
}

/// What a value is, for people.
pub fn kind(value: &Value) -> String {
    match value {
        Value::Null => "nothing".into(),
        Value::Bool(b) => format!("{b}"),
        Value::Number(n) => format!("the number {n}"),
        Value::String(s) => format!("the text {s:?}"),
        Value::Array(a) => format!("a list of {}", a.len()),
        Value::Object(_) => "an object".into(),
    }
}
