//! A line on standard error that shows how far a command is; nothing in a build without `progress`.

#[cfg(feature = "progress")]
pub(super) use indicatif::ProgressBar;

/// A progress bar on standard error, hidden when that is no terminal.
#[cfg(feature = "progress")]
pub(super) fn progress_bar(total: Option<usize>, what: &'static str) -> ProgressBar {
    use indicatif::ProgressStyle;
    let (bar, template) = match total {
        Some(n) => {
            (ProgressBar::new(n as u64), "{prefix} [{bar:30}] {pos}/{len} {msg} {eta_precise}")
        }
        None => (ProgressBar::new_spinner(), "{prefix} {pos} {msg}"),
    };
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style.progress_chars("=> "));
    }
    bar.with_prefix(what)
}

/// Shows nothing.
#[cfg(not(feature = "progress"))]
#[derive(Clone, Copy, Debug)]
pub(super) struct ProgressBar;

#[cfg(not(feature = "progress"))]
impl ProgressBar {
    pub(super) fn inc(&self, _: u64) {}
    pub(super) fn set_position(&self, _: u64) {}
    pub(super) fn set_message(&self, _: String) {}
    pub(super) fn finish_and_clear(&self) {}
}

/// Shows nothing.
#[cfg(not(feature = "progress"))]
pub(super) fn progress_bar(_: Option<usize>, _: &'static str) -> ProgressBar {
    ProgressBar
}
