//! Markup that is well-formed by construction: every element opened is closed, every text and
//! attribute escaped.

use std::fmt::Write as _;

/// Attributes of an element: name and value, the value still to be escaped.
pub(super) type Attrs<'a> = &'a [(&'a str, &'a str)];

/// A page (or part of one) being written.
#[derive(Debug, Default)]
pub(super) struct Html(String);

impl Html {
    /// An element with what `inside` writes.
    pub fn within<R>(
        &mut self,
        tag: &str,
        attrs: Attrs<'_>,
        inside: impl FnOnce(&mut Self) -> R,
    ) -> R {
        self.start(tag, attrs);
        self.0.push('>');
        let result = inside(self);
        // Writing to a string does not fail.
        let _ = write!(self.0, "</{tag}>");
        result
    }

    /// An element that holds a text.
    pub fn element(&mut self, tag: &str, attrs: Attrs<'_>, text: &str) {
        self.within(tag, attrs, |h| h.text(text));
    }

    /// An element without content.
    pub fn empty(&mut self, tag: &str, attrs: Attrs<'_>) {
        self.start(tag, attrs);
        self.0.push_str("/>");
    }

    /// Text.
    pub fn text(&mut self, text: &str) {
        escape(text, &mut self.0);
    }

    /// Markup made by another [`Html`], or a constant of this program.
    pub fn markup(&mut self, markup: &str) {
        self.0.push_str(markup);
    }

    /// Bytes so far.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// What was written.
    pub fn finish(self) -> String {
        self.0
    }

    fn start(&mut self, tag: &str, attrs: Attrs<'_>) {
        self.0.push('<');
        self.0.push_str(tag);
        for (name, value) in attrs {
            let _ = write!(self.0, " {name}=\"");
            escape(value, &mut self.0);
            self.0.push('"');
        }
    }
}

/// Escapes for text and quoted attributes; control characters, which XML and HTML do not allow,
/// become the replacement character.
fn escape(text: &str, out: &mut String) {
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\n' | '\t' => out.push(c),
            // Overrides of the writing direction would turn the rest of a line around.
            '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => out.push('\u{fffd}'),
            c if c.is_control() => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
}

/// A coordinate: one decimal is a tenth of a pixel.
pub(super) fn at(value: f64) -> String {
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

/// Standard base64 with padding, for data URIs.
pub(super) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |i: usize| u32::from(chunk.get(i).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for i in 0..4 {
            if i <= chunk.len() {
                text.push(char::from(DIGITS[(bits >> (18 - 6 * i)) as usize & 63]));
            } else {
                text.push('=');
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_gets_through_unescaped() {
        let mut h = Html::default();
        h.within("p", &[("title", "\"><script>")], |h| h.text("<b>&'\u{0}\u{202e}é"));
        h.empty("br", &[]);
        assert_eq!(
            h.finish(),
            "<p title=\"&quot;&gt;&lt;script&gt;\">&lt;b&gt;&amp;&#39;\u{fffd}\u{fffd}é</p><br/>"
        );
    }

    #[test]
    fn base64_of_the_standard_s_own_examples() {
        for (bytes, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xff, 0xef, 0xbe]), "/+++");
    }

    #[test]
    fn coordinates_are_short() {
        assert_eq!((at(1.0), at(1.26), at(-0.5)), ("1".into(), "1.3".into(), "-0.5".into()));
    }
}
