//! What a person sees while it trains, and the means over the steps between two log entries.

use super::step::StepFigures;
use super::{StepEntry, Validation};
use crate::align::Figures;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

/// Means since the last log entry.
pub(super) struct Window {
    batch: usize,
    sum: StepFigures,
    steps: usize,
    /// Steps with alignment.
    aligned: usize,
    /// Time spent in steps, without validations and checkpoints.
    busy: Duration,
    waited: Duration,
    last: Instant,
    /// Of the last step.
    newest: StepFigures,
    /// Smoothed samples per second and share of waiting, for the bar.
    shown: (f64, f64),
}

impl Window {
    pub fn new(batch: usize) -> Self {
        Self {
            batch,
            sum: StepFigures::default(),
            steps: 0,
            aligned: 0,
            busy: Duration::ZERO,
            waited: Duration::ZERO,
            last: Instant::now(),
            newest: StepFigures::default(),
            shown: (0.0, 0.0),
        }
    }

    /// Time the loop waited for its batch.
    pub fn wait(&mut self, time: Duration) {
        self.waited += time;
    }

    /// A step is done.
    pub fn add(&mut self, figures: StepFigures) {
        self.steps += 1;
        self.sum.loss += figures.loss;
        self.sum.cls += figures.cls;
        self.sum.giou += figures.giou;
        self.sum.grad_norm += figures.grad_norm;
        self.aligned += usize::from(!figures.align.is_empty());
        for (name, value) in &figures.align {
            *self.sum.align.entry(name).or_default() += value;
        }
        self.newest = figures;
        let now = Instant::now();
        self.busy += now - self.last;
        self.last = now;
        self.shown = self.rates();
    }

    /// Leaves out the time since the last step.
    pub fn restart(&mut self) {
        self.last = Instant::now();
    }

    fn rates(&self) -> (f64, f64) {
        let busy = self.busy.as_secs_f64().max(1e-9);
        ((self.steps * self.batch) as f64 / busy, self.waited.as_secs_f64() / busy)
    }

    /// Means, and a new start.
    pub fn take(&mut self, lr: f64) -> StepEntry {
        let n = self.steps.max(1) as f64;
        let (samples_per_s, data_wait) = self.rates();
        let sums = std::mem::take(&mut self.sum);
        let aligned = self.aligned.max(1) as f64;
        let entry = StepEntry {
            loss: sums.loss / n,
            cls: sums.cls / n,
            giou: sums.giou / n,
            grad_norm: sums.grad_norm / n,
            lr,
            samples_per_s,
            data_wait,
            align: sums.align.into_iter().map(|(name, sum)| (name, sum / aligned)).collect(),
        };
        self.steps = 0;
        self.aligned = 0;
        self.busy = Duration::ZERO;
        self.waited = Duration::ZERO;
        entry
    }
}

/// The alignment losses and the discriminator's accuracy, where there are any.
fn alignment(figures: &Figures) -> String {
    let short = [("adversarial", "bce"), ("discriminator_accuracy", "acc"), ("contrastive", "nce")];
    short
        .iter()
        .filter_map(|(name, short)| figures.get(name).map(|v| format!(" {short} {v:.3}")))
        .collect()
}

/// A bar on a terminal, plain lines elsewhere.
pub(super) struct Progress {
    bar: Option<ProgressBar>,
    lines: bool,
    start: Instant,
    first: u64,
    total: u64,
}

impl Progress {
    pub fn new(verbose: bool, first: u64, total: u64) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = (verbose && terminal).then(|| {
            let bar = ProgressBar::new(total);
            let style = "{pos}/{len} [{bar:30}] {msg} | {elapsed} + {eta}";
            // The template is a constant; should it ever not parse, the default bar is shown.
            if let Ok(style) = ProgressStyle::with_template(style) {
                bar.set_style(style.progress_chars("=> "));
            }
            bar.set_position(first);
            bar.reset_eta();
            bar
        });
        Self { bar, lines: verbose && !terminal, start: Instant::now(), first, total }
    }

    /// A line above the bar.
    pub fn line(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None if self.lines => eprintln!("{text}"),
            None => {}
        }
    }

    pub fn step(&self, step: u64, window: &Window) {
        let Some(bar) = &self.bar else { return };
        let (rate, wait) = window.shown;
        let f = &window.newest;
        bar.set_message(format!(
            "loss {:.3} cls {:.5} giou {:.3}{} | {rate:.1} samples/s, data wait {:.0} %",
            f.loss,
            f.cls,
            f.giou,
            alignment(&f.align),
            100.0 * wait
        ));
        bar.set_position(step);
    }

    pub fn entry(&self, step: u64, e: &StepEntry) {
        if !self.lines {
            return;
        }
        let done = (step - self.first).max(1) as f64;
        let left = self.start.elapsed().as_secs_f64() / done * (self.total - step) as f64;
        eprintln!(
            "step {step}/{}  loss {:.3}  cls {:.5}  giou {:.3} {}  grad {:.2}  lr {:.1e}  {:.1} samples/s  data wait {:.0} %  left {:.0} min",
            self.total,
            e.loss,
            e.cls,
            e.giou,
            alignment(&e.align),
            e.grad_norm,
            e.lr,
            e.samples_per_s,
            100.0 * e.data_wait,
            left / 60.0
        );
    }

    pub fn validation(&self, step: u64, v: &Validation) {
        self.line(&format!(
            "step {step} validation: IoU same {:.3} cross {:.3}, success same {:.2} cross {:.2}, cls {:.5}, giou {:.3}",
            v.same.iou, v.cross.iou, v.same.success, v.cross.success, v.all.cls, v.all.giou
        ));
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish();
        }
    }
}
