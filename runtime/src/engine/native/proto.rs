//! A reader for the part of ONNX that the exporter writes: protobuf fields straight from the
//! bytes, nothing copied. Unknown fields are skipped; whatever points outside the bytes is an error.

/// Bytes that are not a readable ONNX file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not readable as ONNX: {what} near byte {at} of its message")]
pub struct ProtoError {
    /// What was found.
    what: &'static str,
    /// Where, from the start of the message that holds it.
    at: usize,
}

type Result<T> = core::result::Result<T, ProtoError>;

/// One value of a field.
#[derive(Clone, Copy, Debug)]
enum Wire<'a> {
    Number(u64),
    Bytes(&'a [u8]),
    Four([u8; 4]),
}

/// Walks over the fields of one message.
struct Fields<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Fields<'a> {
    const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    const fn fail<T>(&self, what: &'static str) -> Result<T> {
        Err(ProtoError { what, at: self.at })
    }

    fn varint(&mut self) -> Result<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let Some(&byte) = self.bytes.get(self.at) else { return self.fail("a cut-off number") };
            self.at += 1;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        self.fail("a number of more than ten bytes")
    }

    fn take(&mut self, len: u64) -> Result<&'a [u8]> {
        let end = usize::try_from(len).ok().and_then(|n| self.at.checked_add(n));
        match end.and_then(|end| self.bytes.get(self.at..end)) {
            Some(bytes) => {
                self.at += bytes.len();
                Ok(bytes)
            }
            None => self.fail("a field that is longer than its message"),
        }
    }

    /// The next field's number and value.
    fn next(&mut self) -> Result<Option<(u64, Wire<'a>)>> {
        while self.at < self.bytes.len() {
            let tag = self.varint()?;
            let value = match tag & 7 {
                0 => Wire::Number(self.varint()?),
                1 => {
                    self.take(8)?;
                    continue;
                }
                2 => {
                    let len = self.varint()?;
                    Wire::Bytes(self.take(len)?)
                }
                5 => {
                    let mut four = [0; 4];
                    four.copy_from_slice(self.take(4)?);
                    Wire::Four(four)
                }
                _ => return self.fail("a field of unknown kind"),
            };
            return Ok(Some((tag >> 3, value)));
        }
        Ok(None)
    }
}

fn text(bytes: &[u8]) -> Result<&str> {
    core::str::from_utf8(bytes)
        .map_err(|e| ProtoError { what: "text that is not UTF-8", at: e.valid_up_to() })
}

/// Appends a repeated integer, packed or not.
fn integers(value: Wire<'_>, out: &mut Vec<i64>) -> Result<()> {
    match value {
        Wire::Number(n) => out.push(n as i64),
        Wire::Bytes(bytes) => {
            let mut fields = Fields::new(bytes);
            while fields.at < bytes.len() {
                out.push(fields.varint()? as i64);
            }
        }
        Wire::Four(_) => return Fields::new(&[]).fail("a float where integers belong"),
    }
    Ok(())
}

/// Calls `visit` for every field of a message.
fn each<'a>(bytes: &'a [u8], mut visit: impl FnMut(u64, Wire<'a>) -> Result<()>) -> Result<()> {
    let mut fields = Fields::new(bytes);
    while let Some((number, value)) = fields.next()? {
        visit(number, value)?;
    }
    Ok(())
}

/// A graph with its nodes in file order, which ONNX says is an order of execution.
#[derive(Debug, Default)]
pub struct Graph<'a> {
    /// Operators.
    pub nodes: Vec<Node<'a>>,
    /// Constants.
    pub initializers: Vec<Tensor<'a>>,
    /// Declared inputs.
    pub inputs: Vec<Port<'a>>,
    /// Declared outputs.
    pub outputs: Vec<Port<'a>>,
}

/// One operator.
#[derive(Debug, Default)]
pub struct Node<'a> {
    /// Its own name; may be empty.
    pub name: &'a str,
    /// Kind: `Conv`, `MatMul`, ..
    pub op: &'a str,
    /// Operator set; empty is ONNX itself.
    pub domain: &'a str,
    /// Names of its inputs; an empty one is left out.
    pub inputs: Vec<&'a str>,
    /// Names of its outputs.
    pub outputs: Vec<&'a str>,
    /// Settings.
    pub attributes: Vec<Attribute<'a>>,
}

/// A setting of a node.
#[derive(Debug, Default)]
pub struct Attribute<'a> {
    /// Its name.
    pub name: &'a str,
    /// Value, if it is a float.
    pub float: Option<f32>,
    /// Value, if it is an integer.
    pub int: Option<i64>,
    /// Value, if it is text.
    pub text: Option<&'a [u8]>,
    /// Value, if it is a list of integers.
    pub ints: Vec<i64>,
    /// Value, if it is a tensor.
    pub tensor: Option<Tensor<'a>>,
}

/// A constant.
#[derive(Clone, Debug, Default)]
pub struct Tensor<'a> {
    /// Name of the value.
    pub name: &'a str,
    /// Shape.
    pub dims: Vec<i64>,
    /// Element type; 1 is f32, 7 is i64.
    pub kind: i64,
    /// Elements, little endian.
    pub raw: &'a [u8],
    /// Elements of an integer tensor without `raw`.
    pub ints: Vec<i64>,
    /// Elements of a float tensor without `raw`.
    pub floats: Vec<f32>,
    /// Whether the elements are in another file.
    pub external: bool,
    /// `location`, `offset`, `length` of that file.
    pub entries: Vec<(&'a str, &'a str)>,
}

/// An input or output.
#[derive(Debug, Default)]
pub struct Port<'a> {
    /// Name of the value.
    pub name: &'a str,
    /// Element type; 1 is f32. 0 when not declared.
    pub kind: i64,
    /// Shape; −1 where it is not fixed.
    pub dims: Vec<i64>,
}

/// Reads a model file.
pub fn read(bytes: &[u8]) -> Result<Option<Graph<'_>>> {
    let mut graph = None;
    each(bytes, |number, value| {
        if let (7, Wire::Bytes(b)) = (number, value) {
            graph = Some(read_graph(b)?);
        }
        Ok(())
    })?;
    Ok(graph)
}

fn read_graph(bytes: &[u8]) -> Result<Graph<'_>> {
    let mut graph = Graph::default();
    each(bytes, |number, value| {
        if let Wire::Bytes(b) = value {
            match number {
                1 => graph.nodes.push(read_node(b)?),
                5 => graph.initializers.push(read_tensor(b)?),
                11 => graph.inputs.push(read_port(b)?),
                12 => graph.outputs.push(read_port(b)?),
                _ => {}
            }
        }
        Ok(())
    })?;
    Ok(graph)
}

fn read_node(bytes: &[u8]) -> Result<Node<'_>> {
    let mut node = Node::default();
    each(bytes, |number, value| {
        if let Wire::Bytes(b) = value {
            match number {
                1 => node.inputs.push(text(b)?),
                2 => node.outputs.push(text(b)?),
                3 => node.name = text(b)?,
                4 => node.op = text(b)?,
                5 => node.attributes.push(read_attribute(b)?),
                7 => node.domain = text(b)?,
                _ => {}
            }
        }
        Ok(())
    })?;
    Ok(node)
}

fn read_attribute(bytes: &[u8]) -> Result<Attribute<'_>> {
    let mut attribute = Attribute::default();
    each(bytes, |number, value| {
        match (number, value) {
            (1, Wire::Bytes(b)) => attribute.name = text(b)?,
            (2, Wire::Four(four)) => attribute.float = Some(f32::from_le_bytes(four)),
            (3, Wire::Number(n)) => attribute.int = Some(n as i64),
            (4, Wire::Bytes(b)) => attribute.text = Some(b),
            (5, Wire::Bytes(b)) => attribute.tensor = Some(read_tensor(b)?),
            (8, value) => integers(value, &mut attribute.ints)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(attribute)
}

fn read_tensor(bytes: &[u8]) -> Result<Tensor<'_>> {
    let mut tensor = Tensor::default();
    each(bytes, |number, value| {
        match (number, value) {
            (1, value) => integers(value, &mut tensor.dims)?,
            (2, Wire::Number(n)) => tensor.kind = n as i64,
            (4, Wire::Four(four)) => tensor.floats.push(f32::from_le_bytes(four)),
            (4, Wire::Bytes(b)) => tensor.floats.extend(floats(b)),
            (7, value) => integers(value, &mut tensor.ints)?,
            (8, Wire::Bytes(b)) => tensor.name = text(b)?,
            (9, Wire::Bytes(b)) => tensor.raw = b,
            (13, Wire::Bytes(b)) => tensor.entries.push(read_entry(b)?),
            (14, Wire::Number(n)) => tensor.external = n == 1,
            _ => {}
        }
        Ok(())
    })?;
    Ok(tensor)
}

/// Little-endian floats; a rest of fewer than four bytes is left out.
pub fn floats(bytes: &[u8]) -> impl Iterator<Item = f32> + '_ {
    bytes.as_chunks::<4>().0.iter().map(|four| f32::from_le_bytes(*four))
}

fn read_entry(bytes: &[u8]) -> Result<(&str, &str)> {
    let mut entry = ("", "");
    each(bytes, |number, value| {
        match (number, value) {
            (1, Wire::Bytes(b)) => entry.0 = text(b)?,
            (2, Wire::Bytes(b)) => entry.1 = text(b)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(entry)
}

fn read_port(bytes: &[u8]) -> Result<Port<'_>> {
    let mut port = Port::default();
    each(bytes, |number, value| {
        match (number, value) {
            (1, Wire::Bytes(b)) => port.name = text(b)?,
            (2, Wire::Bytes(b)) => each(b, |number, value| {
                if let (1, Wire::Bytes(b)) = (number, value) {
                    read_tensor_type(b, &mut port)?;
                }
                Ok(())
            })?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(port)
}

fn read_tensor_type<'a>(bytes: &'a [u8], port: &mut Port<'a>) -> Result<()> {
    each(bytes, |number, value| {
        match (number, value) {
            (1, Wire::Number(n)) => port.kind = n as i64,
            (2, Wire::Bytes(shape)) => each(shape, |number, value| {
                if let (1, Wire::Bytes(dim)) = (number, value) {
                    let mut size = -1;
                    each(dim, |number, value| {
                        if let (1, Wire::Number(n)) = (number, value) {
                            size = n as i64;
                        }
                        Ok(())
                    })?;
                    port.dims.push(size);
                }
                Ok(())
            })?,
            _ => {}
        }
        Ok(())
    })
}
