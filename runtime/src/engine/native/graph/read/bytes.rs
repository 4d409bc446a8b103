//! Narrow numbers: weights of 8 bits with their steps, weights of 16-bit floats, and activations
//! that are rounded to bytes.

use super::{Call, F32, Reader, Step};
use crate::engine::native::graph::{Data, Op, Unary, Value, ValueId};

/// How a tensor of floats became bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rounding {
    scale: f32,
    zero: u8,
}

impl<'a> Reader<'a> {
    /// `QuantizeLinear`: the value stays one of floats, those that a byte can stand for.
    pub(super) fn quantise(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let rounding = self.rounding(call)?;
        let Rounding { scale, zero } = rounding;
        self.push(call, Op::Unary(Unary::Round { scale, zero }), vec![x], self.shape(x))?;
        if let Some(output) = call.node.outputs.first() {
            self.bytes.insert((*output).into(), rounding);
        }
        Ok(())
    }

    /// `DequantizeLinear`, of what `QuantizeLinear` made or of constant weights.
    pub(super) fn dequantise(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let (x, &[output]) = (call.input(0)?, &*call.node.outputs) else {
            return Err(format!("{} results instead of one", call.node.outputs.len()));
        };
        if self.names.contains_key(output) {
            return Err(format!("`{output}` is defined twice"));
        }
        let from = call.node.inputs.first().copied().unwrap_or_default();
        if let Some(made) = self.bytes.get(from).copied() {
            let back = self.rounding(call)?;
            if back != made {
                return Err(format!("it undoes {back:?} where {made:?} was done"));
            }
            self.graph.values[x].name = output.into();
            self.names.insert(output.into(), x);
            return Ok(());
        }
        let value = self.weights(call, x)?;
        self.define(output, value);
        Ok(())
    }

    /// Weights: signed, a step per channel or one for all, no zero point.
    fn weights(&self, call: &Call<'_, 'a>, x: ValueId) -> Step<Value<'a>> {
        let value = &self.graph.values[x];
        let Some(Data::Bytes8 { bytes, signed: true }) = value.data else {
            let name = &value.name;
            return Err(format!("`{name}` must be a constant of signed bytes"));
        };
        if let Some(zero) = call.maybe(2) {
            match &self.graph.values[zero].data {
                Some(Data::Bytes8 { bytes, .. }) if bytes.iter().all(|&b| b == 0) => {}
                _ => return Err("weights with a zero point other than 0".into()),
            }
        }
        let scales = call.input(1)?;
        let shape = value.shape.clone();
        let scale = match &self.graph.values[scales].data {
            Some(data @ (Data::Bytes(_) | Data::Floats(_))) => data.floats(),
            _ => return Err("its scale must be constant floats".into()),
        };
        if let Some(bad) = scale.iter().find(|s| !(s.is_finite() && **s > 0.0)) {
            return Err(format!("a scale of {bad}; it must be above 0"));
        }
        let inner = if scale.len() == 1 {
            1
        } else {
            let along = super::axis(call.int("axis", 1), shape.len())?;
            if shape[along] != scale.len() {
                let n = scale.len();
                return Err(format!("{n} scales for {} channels", shape[along]));
            }
            shape[along + 1..].iter().product()
        };
        let data = Some(Data::Scaled { bytes, scale, inner });
        Ok(Value { name: value.name.clone(), shape, data })
    }

    /// `Cast`, of constants of 16-bit floats to floats.
    pub(super) fn cast(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let (x, to) = (call.input(0)?, call.int("to", 0));
        let (Some(Data::Halves(_)), F32, &[output]) =
            (&self.graph.values[x].data, to, &*call.node.outputs)
        else {
            return Err("only constants of 16-bit floats can be cast, to 32-bit ones".into());
        };
        let value = Value { name: output.into(), ..self.graph.values[x].clone() };
        self.define(output, value);
        Ok(())
    }

    /// Step and zero point of a whole tensor.
    fn rounding(&self, call: &Call<'_, 'a>) -> Step<Rounding> {
        let scale = self.float(call.input(1)?)?;
        if !(scale.is_finite() && scale > 0.0) {
            return Err(format!("a scale of {scale}; it must be above 0"));
        }
        let zero = match call.maybe(2).map(|id| &self.graph.values[id].data) {
            None => 0,
            // Signed bytes are unsigned ones that lie 128 lower.
            Some(Some(Data::Bytes8 { bytes: [b], signed })) => *b ^ (u8::from(*signed) << 7),
            Some(_) => return Err("its zero point must be one constant byte".into()),
        };
        Ok(Rounding { scale, zero })
    }
}
