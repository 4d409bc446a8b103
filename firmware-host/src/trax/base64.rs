//! Base64 as pictures come in (RFC 4648, padding optional).

/// Text that is no base64.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Base64Error {
    /// A character that does not belong.
    #[error("base64: character {at} ({byte:#04x}) is not of its alphabet")]
    Symbol {
        /// 0-based position.
        at: usize,
        /// The character.
        byte: u8,
    },
    /// A number of characters that no number of bytes gives.
    #[error("base64: {len} characters (padding not counted) cannot be whole bytes")]
    Length {
        /// Characters before the padding.
        len: usize,
    },
}

const NONE: u8 = 0xFF;

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

const VALUES: [u8; 256] = {
    let mut values = [NONE; 256];
    let mut i = 0;
    while i < ALPHABET.len() {
        values[ALPHABET[i] as usize] = i as u8;
        i += 1;
    }
    values
};

/// Bytes that this many characters before the padding stand for.
pub(super) const fn decoded_len(symbols: usize) -> usize {
    symbols / 4 * 3 + (symbols % 4).saturating_sub(1)
}

/// The text without its padding.
pub(super) fn unpadded(text: &str) -> &str {
    let text = text.strip_suffix('=').unwrap_or(text);
    text.strip_suffix('=').unwrap_or(text)
}

/// Decodes a text.
///
/// # Errors
/// When a character does not belong, or the text ends inside a byte.
pub fn decode(text: &str) -> Result<Vec<u8>, Base64Error> {
    let symbols = unpadded(text).as_bytes();
    if symbols.len() % 4 == 1 {
        return Err(Base64Error::Length { len: symbols.len() });
    }
    let mut out = Vec::with_capacity(decoded_len(symbols.len()));
    for (i, chunk) in symbols.chunks(4).enumerate() {
        let mut word = 0u32;
        for (k, &byte) in chunk.iter().enumerate() {
            let value = VALUES[usize::from(byte)];
            if value == NONE {
                return Err(Base64Error::Symbol { at: 4 * i + k, byte });
            }
            word |= u32::from(value) << (18 - 6 * k);
        }
        let [_, a, b, c] = word.to_be_bytes();
        out.extend_from_slice(&[a, b, c][..chunk.len() - 1]);
    }
    Ok(out)
}

/// Encodes bytes, with padding.
pub fn encode(bytes: &[u8]) -> String {
    let mut out = Vec::new();
    encode_into(bytes, &mut out);
    out.into_iter().map(char::from).collect()
}

/// Encodes bytes, with padding, to the end of `out`.
pub fn encode_into(bytes: &[u8], out: &mut Vec<u8>) {
    out.reserve(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let mut word = [0; 4];
        word[1..=chunk.len()].copy_from_slice(chunk);
        let word = u32::from_be_bytes(word);
        for i in 0..4 {
            let symbol = ALPHABET[(word >> (18 - 6 * i) & 63) as usize];
            out.push(if i <= chunk.len() { symbol } else { b'=' });
        }
    }
}
