//! Errors as programs print them.

use std::string::{String, ToString};

/// The error and its causes on one line. A cause that a message already quotes is not repeated.
pub fn one_line(error: &dyn core::error::Error) -> String {
    let mut line = error.to_string();
    let mut cause = error.source();
    while let Some(e) = cause {
        let text = e.to_string();
        if !line.contains(&text) {
            line.push_str(": ");
            line.push_str(&text);
        }
        cause = e.source();
    }
    line.replace(['\n', '\r'], " ")
}

#[cfg(test)]
mod tests {
    use super::one_line;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Link {
        text: &'static str,
        source: Option<std::boxed::Box<Link>>,
    }

    #[test]
    fn causes_are_added_unless_quoted() {
        let link = |text, source: Option<Link>| Link { text, source: source.map(Into::into) };
        let quoted = link("file a: cannot open", Some(link("cannot open", None)));
        assert_eq!(one_line(&quoted), "file a: cannot open");
        let chain = link("loading", Some(link("file a", Some(link("no\nsuch file", None)))));
        assert_eq!(one_line(&chain), "loading: file a: no such file");
    }
}
