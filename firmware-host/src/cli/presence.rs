//! `tsda presence`, and the runs it shares with `tsda calibrate`.

use super::progress_bar;
use crate::engine::EngineArgs;
use crate::error::{EXIT_OK, HostError};
use crate::model;
use crate::output::write_file;
use crate::picture::Picture as Drawn;
use crate::redetect::RedetectArgs;
use crate::render::{Clip, ClipConfig};
use clap::Args;
use serde::Serialize;
use std::fmt::Write as _;
use std::path::PathBuf;
use tsda_eval::dataset::{self, Dataset, DatasetError, Picture, Sequence};
use tsda_eval::presence::{Delay, Observation, PresenceSummary};
use tsda_eval::protocol::{Protocol, start_frame};
use tsda_eval::{observe, presence};
use tsda_runtime::engine::AnyEngine;
use tsda_runtime::{BBox, Modality, Tracker};

/// What is tracked, with what: shared by `presence` and `calibrate`.
#[derive(Debug, Args)]
pub struct RunsArgs {
    /// Bundle to track with, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// KIND:PATH as in `tsda eval`, or rendered:SEED for a drawn clip in which the target walks behind
    /// a screen; may be repeated
    #[arg(long, value_name = "KIND:PATH[@SPLIT]", required = true)]
    pub dataset: Vec<String>,
    /// rgb2t, t2rgb, switch:N (switch: N = 200), rgb or t; may be repeated; sequences that lack a sensor
    /// of one are left out of it [default: rgb2t t2rgb switch:200]
    #[arg(long, value_name = "PROTOCOL")]
    pub protocol: Vec<Protocol>,
    /// Where the network runs
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Looking for a lost target
    #[command(flatten)]
    pub redetect: RedetectArgs,
}

/// Arguments of `tsda presence`.
#[derive(Debug, Args)]
pub struct PresenceArgs {
    /// What is tracked, with what
    #[command(flatten)]
    pub runs: RunsArgs,
    /// Also as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// The runs of one protocol.
pub(super) struct ProtocolRuns {
    pub(super) protocol: Protocol,
    pub(super) runs: Vec<Observation>,
}

#[derive(Serialize)]
struct Row {
    protocol: String,
    #[serde(flatten)]
    summary: PresenceSummary,
}

pub(super) fn run(args: &PresenceArgs) -> Result<u8, HostError> {
    let bundle = model::load(args.runs.bundle.as_deref())?;
    let mut tracker = model::tracker_on(&bundle, &args.runs.engine.choice()?)?;
    let rows: Vec<Row> = observe_all(&args.runs, &mut tracker)?
        .iter()
        .map(|p| Row { protocol: p.protocol.to_string(), summary: presence(&p.runs) })
        .collect();
    print!("{}", table(&rows));
    if let Some(path) = &args.json {
        let mut json = serde_json::to_vec_pretty(&rows)
            .map_err(|e| HostError::Encode { path: path.clone(), reason: e.to_string() })?;
        json.push(b'\n');
        write_file(path, &json)?;
    }
    Ok(EXIT_OK)
}

/// Runs every target of every dataset under every protocol that its sensors allow.
pub(super) fn observe_all(
    args: &RunsArgs,
    tracker: &mut Tracker<AnyEngine>,
) -> Result<Vec<ProtocolRuns>, HostError> {
    args.redetect.apply(tracker)?;
    let data = args.dataset.iter().map(|d| open(d)).collect::<Result<Vec<_>, _>>()?;
    let protocols = match &args.protocol[..] {
        [] => &Protocol::CROSS_MODAL,
        some => some,
    };
    let mut jobs = Vec::new();
    for &protocol in protocols {
        for sequence in data.iter().flat_map(|d| &d.sequences) {
            if protocol.needs().iter().all(|m| sequence.modalities().contains(m)) {
                let targets = 0..sequence.targets();
                let ready = |&t: &usize| start_frame(sequence.as_ref(), t, protocol).is_some();
                jobs.extend(targets.filter(ready).map(|t| (protocol, sequence, t)));
            }
        }
    }
    let bar = progress_bar(Some(jobs.len()), "tracking");
    let mut all: Vec<ProtocolRuns> = Vec::new();
    for (protocol, sequence, target) in jobs {
        bar.set_message(format!("{protocol} {}", sequence.id()));
        let run = observe(sequence.as_ref(), target, protocol, tracker)
            .map_err(|e| HostError::Eval(Box::new(e)))?;
        match all.last_mut().filter(|p| p.protocol == protocol) {
            Some(p) => p.runs.push(run),
            None => all.push(ProtocolRuns { protocol, runs: vec![run] }),
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    if all.is_empty() {
        return Err(HostError::Argument {
            what: format!("--dataset {}", args.dataset.join(" ")),
            reason: "no sequence has a target and the sensors that the protocols need; choose \
                     them with --protocol"
                .into(),
        });
    }
    Ok(all)
}

fn open(text: &str) -> Result<Dataset, HostError> {
    let unusable =
        |reason: String| HostError::Argument { what: format!("--dataset {text}"), reason };
    let Some(seed) = text.strip_prefix("rendered:") else {
        return dataset::open(text).map_err(|e| unusable(e.to_string()));
    };
    let seed = seed.parse().map_err(|e| {
        unusable(format!("a seed is expected after rendered:, as in rendered:7 ({e})"))
    })?;
    Ok(Dataset { name: text.to_owned(), sequences: vec![Box::new(ScreenClip::new(seed))] })
}

/// The drawn clip with the screen, as a sequence.
struct ScreenClip {
    id: String,
    clip: Clip,
}

impl ScreenClip {
    /// Frames; at the speed of the story this hides the target for some five seconds.
    const FRAMES: usize = 240;
    /// Visible shares up to which the target is absent, and from which it is annotated as visible.
    const SHARES: (f32, f32) = (0.05, 0.5);

    fn new(seed: u32) -> Self {
        let config =
            ClipConfig { seed, frames: Self::FRAMES, screen: true, ..ClipConfig::default() };
        Self { id: format!("screen-{seed}"), clip: Clip::new(config) }
    }

    fn has(&self, target: usize, frame: usize) -> bool {
        target == 0 && frame < self.clip.frames()
    }
}

impl Sequence for ScreenClip {
    fn id(&self) -> &str {
        &self.id
    }

    fn frames(&self) -> usize {
        self.clip.frames()
    }

    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }

    fn targets(&self) -> usize {
        1
    }

    fn truth(&self, target: usize, frame: usize, _: Modality) -> Option<BBox> {
        let seen = self.has(target, frame) && self.clip.visible(frame) >= Self::SHARES.1;
        seen.then(|| self.clip.truth(frame))
    }

    fn annotated(&self, target: usize, frame: usize, _: Modality) -> bool {
        let between = Self::SHARES.0..Self::SHARES.1;
        self.has(target, frame) && !between.contains(&self.clip.visible(frame))
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        if frame >= self.clip.frames() {
            return Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality });
        }
        let mut drawn = Drawn::default();
        self.clip.render(frame, modality, &mut drawn);
        let Drawn { width, height, channels, data } = drawn;
        Ok(Picture { width, height, channels, data })
    }
}

fn table(rows: &[Row]) -> String {
    let mut text = String::new();
    let share = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.3}"));
    let delay = |d: &Delay| {
        let median = d.median_frames.map_or("-".into(), |m| m.to_string());
        format!("{} of {}, median {median}", d.came, d.changes)
    };
    for Row { protocol, summary: s } in rows {
        let _ = writeln!(
            text,
            "{protocol}: {} sequences, {} frames visible, {} absent",
            s.sequences, s.visible, s.absent
        );
        for (what, value) in [
            ("AUROC of the score", share(s.auroc)),
            ("false locks (absent, tracking)", share(s.false_lock_rate)),
            ("false reports (or uncertain)", share(s.false_report_rate)),
            ("missed (visible, no box)", share(s.missed_rate)),
            ("absence noticed", delay(&s.noticed)),
            ("lost", delay(&s.lost)),
            ("found again", delay(&s.redetected)),
            ("of these by the scan", s.found_by_scan.to_string()),
        ] {
            let _ = writeln!(text, "  {what:<32} {value}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn behind_the_screen_the_target_is_absent_and_elsewhere_when_it_returns() {
        let clip = ScreenClip::new(7);
        let state: String = (0..clip.frames())
            .map(|f| match clip.truth(0, f, Modality::Rgb) {
                Some(_) => 'v',
                None if clip.absent(0, f, Modality::Rgb) => 'a',
                None => '?',
            })
            .collect();
        let count = |c| state.matches(c).count();
        println!("{state}");
        // One absence, longer than it takes to be lost; half-hidden frames on both sides.
        assert!(count('a') > 60 && count('v') > 50 && (2..60).contains(&count('?')), "{state}");
        assert!(state.starts_with("vvvv") && state.ends_with("vvvv"), "{state}");
        let runs: Vec<&str> = state.split('a').filter(|s| !s.is_empty()).collect();
        assert_eq!(runs.len(), 2, "{state}");
        let (gone, back) = (state.find('a'), state.rfind('a'));
        let (gone, back) = (gone.expect("absent"), back.expect("absent"));
        let moved = clip.clip.truth(back).x - clip.clip.truth(gone).x;
        assert!(moved > 50.0, "{moved}");
        assert!(clip.picture(clip.frames(), Modality::Rgb).is_err());
    }

    /// What the truth says is what is drawn: the target changes no pixel of a frame it is absent in.
    #[test]
    fn a_hidden_target_is_not_seen_in_either_sensor() {
        let clip = ScreenClip::new(3);
        let hidden: Vec<usize> =
            (0..clip.frames()).filter(|&f| clip.absent(0, f, Modality::Rgb)).collect();
        let spot = |frame: usize, sensor: Modality| {
            let p = clip.picture(frame, sensor).expect("drawn");
            let b = clip.clip.truth(frame);
            let (cx, cy) = b.centre();
            let at = (cy as usize * p.width + cx as usize) * p.channels;
            u32::from(p.data[at])
        };
        // The body is the warmest thing there; boards are as cold as the air.
        let seen = spot(0, Modality::Thermal);
        for &frame in [hidden.first(), hidden.last()].into_iter().flatten() {
            assert!(spot(frame, Modality::Thermal) + 40 < seen, "frame {frame}");
        }
    }

    #[test]
    fn a_seed_is_asked_for() {
        let e = open("rendered:x").expect_err("no number").to_string();
        assert!(e.contains("rendered:7"), "{e}");
    }
}
