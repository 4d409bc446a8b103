//! Puts a model's external data into the model, on the level of protobuf fields.
//!
//! ONNX Runtime can take external data from memory only from version 1.18 on; boards have older
//! ones. Everything that is not an external initialiser is copied as it is, so nothing is lost.

/// Numbers of the fields touched, from the public ONNX schema.
mod field {
    pub const MODEL_GRAPH: u64 = 7;
    pub const GRAPH_INITIALIZER: u64 = 5;
    pub const TENSOR_NAME: u64 = 8;
    pub const TENSOR_RAW_DATA: u64 = 9;
    pub const TENSOR_EXTERNAL_DATA: u64 = 13;
    pub const TENSOR_DATA_LOCATION: u64 = 14;
    pub const ENTRY_KEY: u64 = 1;
    pub const ENTRY_VALUE: u64 = 2;
}

/// The model `onnx` with the tensors that lie in file `location` taken from `data`.
///
/// # Errors
/// When the file is no protobuf message, or a tensor refers to data that are not there.
pub(super) fn inline(onnx: &[u8], location: &str, data: &[u8]) -> Result<Vec<u8>, String> {
    let mut out = Vec::with_capacity(onnx.len() + data.len());
    for model_field in Fields(onnx) {
        let model_field = model_field?;
        if model_field.number != field::MODEL_GRAPH {
            out.extend_from_slice(model_field.whole);
            continue;
        }
        let mut graph = Vec::with_capacity(onnx.len() + data.len());
        for graph_field in Fields(model_field.body) {
            let graph_field = graph_field?;
            if graph_field.number == field::GRAPH_INITIALIZER {
                let tensor = inline_tensor(graph_field.body, location, data)?;
                put(&mut graph, field::GRAPH_INITIALIZER, &tensor);
            } else {
                graph.extend_from_slice(graph_field.whole);
            }
        }
        put(&mut out, field::MODEL_GRAPH, &graph);
    }
    Ok(out)
}

fn inline_tensor(tensor: &[u8], location: &str, data: &[u8]) -> Result<Vec<u8>, String> {
    let mut out = Vec::with_capacity(tensor.len());
    let (mut file, mut offset, mut length, mut name) = (None, 0, None, "");
    for f in Fields(tensor) {
        let f = f?;
        match f.number {
            field::TENSOR_EXTERNAL_DATA => {
                let (key, value) = entry(f.body)?;
                let number = || {
                    let wrong = |_| format!("external data {key} `{value}` is not a number");
                    value.parse::<usize>().map_err(wrong)
                };
                match key {
                    "location" => file = Some(value),
                    "offset" => offset = number()?,
                    "length" => length = Some(number()?),
                    // Checksums and what later versions may add.
                    _ => {}
                }
            }
            field::TENSOR_DATA_LOCATION => {}
            number => {
                if number == field::TENSOR_NAME {
                    name = text(f.body)?;
                }
                out.extend_from_slice(f.whole);
            }
        }
    }
    let Some(file) = file else { return Ok(tensor.to_vec()) };
    if file != location {
        return Err(format!("tensor `{name}`: its data are in `{file}`, not in `{location}`"));
    }
    let length = length.unwrap_or_else(|| data.len().saturating_sub(offset));
    let body =
        offset.checked_add(length).and_then(|end| data.get(offset..end)).ok_or_else(|| {
            let have = data.len();
            format!(
                "tensor `{name}`: bytes {offset} to {offset} + {length} are outside {have} bytes"
            )
        })?;
    put(&mut out, field::TENSOR_RAW_DATA, body);
    Ok(out)
}

fn entry(bytes: &[u8]) -> Result<(&str, &str), String> {
    let (mut key, mut value) = ("", "");
    for f in Fields(bytes) {
        let f = f?;
        match f.number {
            field::ENTRY_KEY => key = text(f.body)?,
            field::ENTRY_VALUE => value = text(f.body)?,
            _ => {}
        }
    }
    Ok((key, value))
}

fn text(bytes: &[u8]) -> Result<&str, String> {
    core::str::from_utf8(bytes).map_err(|_| "a name is not UTF-8".into())
}

/// Appends a length-delimited field.
fn put(out: &mut Vec<u8>, number: u64, body: &[u8]) {
    for mut v in [number << 3 | 2, body.len() as u64] {
        while v >= 0x80 {
            out.push(v as u8 | 0x80);
            v >>= 7;
        }
        out.push(v as u8);
    }
    out.extend_from_slice(body);
}

/// One field of a message.
struct Field<'a> {
    number: u64,
    /// Key, length and content.
    whole: &'a [u8],
    /// Content of a length-delimited field, else empty.
    body: &'a [u8],
}

/// The fields of a message; stops after the first error.
struct Fields<'a>(&'a [u8]);

impl<'a> Iterator for Fields<'a> {
    type Item = Result<Field<'a>, String>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.is_empty() {
            return None;
        }
        let start = self.0;
        let field = self.read(start);
        if field.is_none() {
            self.0 = &[];
        }
        Some(field.ok_or_else(|| "the file is no ONNX model, or is damaged".into()))
    }
}

impl<'a> Fields<'a> {
    fn read(&mut self, start: &'a [u8]) -> Option<Field<'a>> {
        let key = self.varint()?;
        let mut body: &[u8] = &[];
        match key & 7 {
            0 => {
                self.varint()?;
            }
            1 => self.0 = self.0.get(8..)?,
            2 => {
                let len = usize::try_from(self.varint()?).ok()?;
                body = self.0.get(..len)?;
                self.0 = &self.0[len..];
            }
            5 => self.0 = self.0.get(4..)?,
            _ => return None,
        }
        let whole = &start[..start.len() - self.0.len()];
        Some(Field { number: key >> 3, whole, body })
    }

    fn varint(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (first, rest) = self.0.split_first()?;
            self.0 = rest;
            value |= u64::from(first & 0x7f) << shift;
            if first & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(fields: &[(u64, &[u8])]) -> Vec<u8> {
        let mut out = Vec::new();
        fields.iter().for_each(|(number, body)| put(&mut out, *number, body));
        out
    }

    fn tensor(entries: &[(&str, &str)]) -> Vec<u8> {
        let mut out = message(&[(field::TENSOR_NAME, b"w")]);
        for (k, v) in entries {
            let entry = message(&[(1, k.as_bytes()), (2, v.as_bytes())]);
            put(&mut out, field::TENSOR_EXTERNAL_DATA, &entry);
        }
        // data_location = EXTERNAL, a varint field.
        out.extend([14 << 3, 1]);
        out
    }

    fn model(tensor: &[u8]) -> Vec<u8> {
        let graph = message(&[(2, b"graph name"), (field::GRAPH_INITIALIZER, tensor)]);
        message(&[(2, b"producer"), (field::MODEL_GRAPH, &graph)])
    }

    #[test]
    fn external_data_come_in() {
        let external = tensor(&[("location", "w.bin"), ("offset", "2"), ("length", "3")]);
        let inlined = inline(&model(&external), "w.bin", b"0123456789").unwrap();
        let want = message(&[(field::TENSOR_NAME, b"w"), (field::TENSOR_RAW_DATA, b"234")]);
        assert_eq!(inlined, model(&want));
        // A model without external data stays as it is.
        assert_eq!(inline(&inlined, "w.bin", &[]).unwrap(), inlined);
    }

    #[test]
    fn wrong_references_are_named() {
        let cases = [
            (tensor(&[("location", "other.bin")]), "other.bin"),
            (tensor(&[("location", "w.bin"), ("offset", "9"), ("length", "3")]), "outside"),
            (tensor(&[("location", "w.bin"), ("offset", "x")]), "not a number"),
        ];
        for (tensor, part) in cases {
            let error = inline(&model(&tensor), "w.bin", b"0123456789").unwrap_err();
            assert!(error.contains(part), "{error}");
        }
        let whole = model(&tensor(&[("location", "w.bin")]));
        assert!(inline(&whole[..whole.len() - 1], "w.bin", b"0").is_err());
    }
}
