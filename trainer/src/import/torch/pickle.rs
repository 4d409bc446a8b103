//! Pickles of protocols 0 to 5, read into an [`Arena`] without running anything.
//!
//! What Python would call is only noted ([`Object`]), so unknown classes are no obstacle and no
//! danger. Memory is bounded by the bytes read: at most [`MAX_BYTES`], [`MAX_VALUES`] values.

use super::TorchError;
use super::value::{Arena, Id, Object, Value};
use std::collections::HashMap;
use std::io::Read;

/// Longest pickle read. The weights are outside of it, so real ones are below a megabyte.
pub(super) const MAX_BYTES: u64 = 64 << 20;
/// Most values of one pickle, and most entries of its stack.
const MAX_VALUES: usize = 2_000_000;
/// Longest line of the text opcodes.
const MAX_LINE: u64 = 1 << 16;

/// Reads one pickle; `input` then stands behind its last byte.
pub(super) fn read(input: &mut impl Read) -> Result<(Arena, Id), TorchError> {
    let mut machine = Machine {
        input,
        offset: 0,
        arena: Arena { values: Vec::new() },
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
    };
    loop {
        let [opcode] = machine.array()?;
        if opcode == b'.' {
            let root = machine.pop()?;
            return Ok((machine.arena, root));
        }
        machine.step(opcode)?;
    }
}

struct Machine<'a, R: Read> {
    input: &'a mut R,
    offset: u64,
    arena: Arena,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
}

impl<R: Read> Machine<'_, R> {
    fn error(&self, reason: impl Into<String>) -> TorchError {
        TorchError::Pickle { offset: self.offset, reason: reason.into() }
    }

    fn count(&mut self, bytes: u64) -> Result<(), TorchError> {
        self.offset = self.offset.saturating_add(bytes);
        if self.offset > MAX_BYTES {
            return Err(self.error(format!("the pickle is longer than {MAX_BYTES} bytes")));
        }
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], TorchError> {
        let mut bytes = [0; N];
        self.input.read_exact(&mut bytes).map_err(|e| self.cut(e))?;
        self.count(N as u64)?;
        Ok(bytes)
    }

    fn cut(&self, e: std::io::Error) -> TorchError {
        match e.kind() {
            std::io::ErrorKind::UnexpectedEof => self.error("the file ends inside the pickle"),
            _ => TorchError::Io(e),
        }
    }

    /// `length` bytes; no more memory than the input really has.
    fn bytes(&mut self, length: u64) -> Result<Vec<u8>, TorchError> {
        self.count(length)?;
        let mut bytes = Vec::new();
        (&mut *self.input).take(length).read_to_end(&mut bytes).map_err(TorchError::Io)?;
        if bytes.len() as u64 != length {
            return Err(self.error("the file ends inside the pickle"));
        }
        Ok(bytes)
    }

    fn text(&mut self, length: u64) -> Result<Value, TorchError> {
        let bytes = self.bytes(length)?;
        // Python allows lone surrogates here; they become replacement characters.
        Ok(Value::Text(match String::from_utf8(bytes) {
            Ok(text) => text,
            Err(e) => String::from_utf8_lossy(e.as_bytes()).into_owned(),
        }))
    }

    fn line(&mut self) -> Result<String, TorchError> {
        let mut line = Vec::new();
        loop {
            match self.array()? {
                [b'\n'] => return Ok(String::from_utf8_lossy(&line).into_owned()),
                _ if line.len() as u64 >= MAX_LINE => {
                    return Err(self.error("a line without an end"));
                }
                [byte] => line.push(byte),
            }
        }
    }

    fn add(&mut self, value: Value) -> Result<Id, TorchError> {
        if self.arena.values.len() >= MAX_VALUES {
            return Err(self.error(format!("more than {MAX_VALUES} values")));
        }
        let id = Id(self.arena.values.len() as u32);
        self.arena.values.push(value);
        Ok(id)
    }

    fn push(&mut self, value: Value) -> Result<(), TorchError> {
        let id = self.add(value)?;
        self.push_id(id)
    }

    fn push_id(&mut self, id: Id) -> Result<(), TorchError> {
        if self.stack.len() >= MAX_VALUES {
            return Err(self.error(format!("more than {MAX_VALUES} values on the stack")));
        }
        self.stack.push(id);
        Ok(())
    }

    fn pop(&mut self) -> Result<Id, TorchError> {
        if self.stack.len() <= self.marks.last().copied().unwrap_or(0) {
            return Err(self.error("a value is missing on the stack"));
        }
        self.stack.pop().ok_or_else(|| self.error("a value is missing on the stack"))
    }

    fn top(&mut self) -> Result<Id, TorchError> {
        let id = self.pop()?;
        self.stack.push(id);
        Ok(id)
    }

    fn pop_mark(&mut self) -> Result<Vec<Id>, TorchError> {
        match self.marks.pop() {
            Some(mark) if mark <= self.stack.len() => Ok(self.stack.split_off(mark)),
            _ => Err(self.error("a mark is missing on the stack")),
        }
    }

    fn pairs(&self, values: &[Id]) -> Result<Vec<(Id, Id)>, TorchError> {
        let (pairs, rest) = values.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(self.error("a key without a value"));
        }
        Ok(pairs.iter().map(|[k, v]| (*k, *v)).collect())
    }

    fn object(&mut self, callee: Id, args: Id) -> Result<(), TorchError> {
        let object =
            Object { callee, args, states: Vec::new(), items: Vec::new(), elements: Vec::new() };
        self.push(Value::Object(Box::new(object)))
    }

    fn mutable(&mut self, id: Id) -> Result<&mut Value, TorchError> {
        let error = self.error("a value that is not there");
        self.arena.values.get_mut(id.0 as usize).ok_or(error)
    }

    fn set_items(&mut self, target: Id, pairs: Vec<(Id, Id)>) -> Result<(), TorchError> {
        match self.mutable(target)? {
            Value::Dict(items) => items.extend(pairs),
            Value::Object(object) => object.items.extend(pairs),
            _ => return Err(self.error("items are set on what is no dictionary")),
        }
        Ok(())
    }

    fn extend(&mut self, target: Id, values: Vec<Id>) -> Result<(), TorchError> {
        match self.mutable(target)? {
            Value::List(items) | Value::Set(items) => items.extend(values),
            Value::Object(object) => object.elements.extend(values),
            _ => return Err(self.error("elements are added to what is no list")),
        }
        Ok(())
    }

    fn memoize(&mut self, index: u64) -> Result<(), TorchError> {
        let id = self.top()?;
        if self.memo.len() >= MAX_VALUES {
            return Err(self.error(format!("more than {MAX_VALUES} values remembered")));
        }
        self.memo.insert(index, id);
        Ok(())
    }

    fn recall(&mut self, index: u64) -> Result<(), TorchError> {
        match self.memo.get(&index) {
            Some(id) => self.push_id(*id),
            None => Err(self.error(format!("value {index} was never remembered"))),
        }
    }

    fn number<T: std::str::FromStr>(&self, text: &str) -> Result<T, TorchError> {
        text.trim().parse().map_err(|_| self.error(format!("{text:?} is no number")))
    }

    fn long(&mut self, length: u64) -> Result<(), TorchError> {
        let bytes = self.bytes(length)?;
        let value = if bytes.len() > 16 {
            Value::HugeInt
        } else {
            let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
            let mut wide = [if negative { 0xff } else { 0 }; 16];
            wide[..bytes.len()].copy_from_slice(&bytes);
            Value::Int(i128::from_le_bytes(wide))
        };
        self.push(value)
    }

    fn global(&mut self) -> Result<Id, TorchError> {
        let (module, name) = (self.line()?, self.line()?);
        self.add(Value::Global { module, name })
    }

    fn step(&mut self, opcode: u8) -> Result<(), TorchError> {
        match opcode {
            // Framing says nothing about the values.
            0x80 => {
                let [version] = self.array()?;
                if version > 5 {
                    return Err(self.error(format!("pickle protocol {version} is not known")));
                }
            }
            0x95 => {
                self.array::<8>()?;
            }
            // Stack and memo.
            b'(' => {
                if self.marks.len() >= MAX_VALUES {
                    return Err(self.error("too many marks"));
                }
                self.marks.push(self.stack.len());
            }
            b'0' => {
                // Pops a mark when nothing is above it.
                if self.marks.last() == Some(&self.stack.len()) {
                    self.marks.pop();
                } else {
                    self.pop()?;
                }
            }
            b'1' => {
                self.pop_mark()?;
            }
            b'2' => {
                let id = self.top()?;
                self.push_id(id)?;
            }
            b'p' => {
                let line = self.line()?;
                let index = self.number(&line)?;
                self.memoize(index)?;
            }
            b'q' => {
                let [index] = self.array()?;
                self.memoize(index.into())?;
            }
            b'r' => {
                let index = u32::from_le_bytes(self.array()?);
                self.memoize(index.into())?;
            }
            0x94 => self.memoize(self.memo.len() as u64)?,
            b'g' => {
                let line = self.line()?;
                let index = self.number(&line)?;
                self.recall(index)?;
            }
            b'h' => {
                let [index] = self.array()?;
                self.recall(index.into())?;
            }
            b'j' => {
                let index = u32::from_le_bytes(self.array()?);
                self.recall(index.into())?;
            }
            _ => return self.step_value(opcode),
        }
        Ok(())
    }

    /// Opcodes that push numbers, texts and bytes.
    fn step_value(&mut self, opcode: u8) -> Result<(), TorchError> {
        let value = match opcode {
            b'N' => Value::None,
            0x88 => Value::Bool(true),
            0x89 => Value::Bool(false),
            b'I' => match self.line()?.as_str() {
                "00" => Value::Bool(false),
                "01" => Value::Bool(true),
                text => Value::Int(self.number(text)?),
            },
            b'L' => {
                let line = self.line()?;
                let digits = line.trim_end_matches('L');
                digits.parse().map_or(Value::HugeInt, Value::Int)
            }
            b'J' => Value::Int(i32::from_le_bytes(self.array()?).into()),
            b'K' => Value::Int(u8::from_le_bytes(self.array()?).into()),
            b'M' => Value::Int(u16::from_le_bytes(self.array()?).into()),
            0x8a => {
                let [length] = self.array()?;
                return self.long(length.into());
            }
            0x8b => {
                let length = u32::from_le_bytes(self.array()?);
                return self.long(length.into());
            }
            b'F' => {
                let line = self.line()?;
                Value::Float(self.number(&line)?)
            }
            b'G' => Value::Float(f64::from_be_bytes(self.array()?)),
            b'V' => Value::Text(self.line()?),
            b'S' => {
                let line = self.line()?;
                Value::Text(line.trim_matches(['\'', '"']).to_owned())
            }
            b'X' | b'T' => {
                let length = u32::from_le_bytes(self.array()?);
                self.text(length.into())?
            }
            b'U' | 0x8c => {
                let [length] = self.array()?;
                self.text(length.into())?
            }
            0x8d => {
                let length = u64::from_le_bytes(self.array()?);
                self.text(length)?
            }
            b'B' => {
                let length = u32::from_le_bytes(self.array()?);
                Value::Bytes(self.bytes(length.into())?)
            }
            b'C' => {
                let [length] = self.array()?;
                Value::Bytes(self.bytes(length.into())?)
            }
            0x8e | 0x96 => {
                let length = u64::from_le_bytes(self.array()?);
                Value::Bytes(self.bytes(length)?)
            }
            _ => return self.step_container(opcode),
        };
        self.push(value)
    }

    /// Opcodes that make and fill containers and objects.
    fn step_container(&mut self, opcode: u8) -> Result<(), TorchError> {
        match opcode {
            b')' => self.push(Value::Tuple(Vec::new())),
            b']' => self.push(Value::List(Vec::new())),
            b'}' => self.push(Value::Dict(Vec::new())),
            0x8f => self.push(Value::Set(Vec::new())),
            b't' => {
                let items = self.pop_mark()?;
                self.push(Value::Tuple(items))
            }
            b'l' => {
                let items = self.pop_mark()?;
                self.push(Value::List(items))
            }
            b'd' => {
                let items = self.pop_mark()?;
                let pairs = self.pairs(&items)?;
                self.push(Value::Dict(pairs))
            }
            0x91 => {
                let items = self.pop_mark()?;
                self.push(Value::Set(items))
            }
            0x85..=0x87 => {
                let mut items = Vec::with_capacity(3);
                for _ in 0x85..=opcode {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.push(Value::Tuple(items))
            }
            b'a' => {
                let value = self.pop()?;
                let list = self.top()?;
                self.extend(list, vec![value])
            }
            b'e' | 0x90 => {
                let values = self.pop_mark()?;
                let list = self.top()?;
                self.extend(list, values)
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                let dict = self.top()?;
                self.set_items(dict, vec![(key, value)])
            }
            b'u' => {
                let items = self.pop_mark()?;
                let pairs = self.pairs(&items)?;
                let dict = self.top()?;
                self.set_items(dict, pairs)
            }
            _ => self.step_object(opcode),
        }
    }

    /// Opcodes that name classes and note what would be called.
    fn step_object(&mut self, opcode: u8) -> Result<(), TorchError> {
        match opcode {
            b'c' => {
                let id = self.global()?;
                self.push_id(id)
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let value = match (self.arena.text(module), self.arena.text(name)) {
                    (Some(module), Some(name)) => {
                        Value::Global { module: module.into(), name: name.into() }
                    }
                    _ => return Err(self.error("a class whose name is no text")),
                };
                self.push(value)
            }
            b'R' | 0x81 => {
                let (args, callee) = (self.pop()?, self.pop()?);
                self.object(callee, args)
            }
            0x92 => {
                let (_keywords, args, callee) = (self.pop()?, self.pop()?, self.pop()?);
                self.object(callee, args)
            }
            b'i' => {
                let callee = self.global()?;
                let args = self.pop_mark()?;
                let args = self.add(Value::Tuple(args))?;
                self.object(callee, args)
            }
            b'o' => {
                let mut args = self.pop_mark()?;
                if args.is_empty() {
                    return Err(self.error("an object without a class"));
                }
                let callee = args.remove(0);
                let args = self.add(Value::Tuple(args))?;
                self.object(callee, args)
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                match self.mutable(target)? {
                    Value::Object(object) => {
                        object.states.push(state);
                        Ok(())
                    }
                    _ => Err(self.error("a state is set on what is no object")),
                }
            }
            b'P' => {
                let line = self.line()?;
                let id = self.add(Value::Text(line))?;
                self.push(Value::Persistent(id))
            }
            b'Q' => {
                let id = self.pop()?;
                self.push(Value::Persistent(id))
            }
            0x82..=0x84 | 0x97 | 0x98 => Err(self
                .error(format!("opcode {opcode:#04x} is not supported (no PyTorch file has it)"))),
            _ => Err(self.error(format!("{opcode:#04x} is no pickle opcode"))),
        }
    }
}
