//! The figures of a benchmark: percentiles, ratios, JSON and a table.

use super::crops::CropTime;
use super::{FRAME, Loaded, Pool, Round, STAGES, Sample};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// The value below which this share of the values lies (nearest rank); 0 of none.
pub fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let rank = (share * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
}

/// A whole benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Bundle measured.
    pub bundle: String,
    /// Model of the processor.
    pub cpu: String,
    /// Cores that this process may use.
    pub cores: usize,
    /// Best instruction set that the native engine has kernels for.
    pub isa: Option<&'static str>,
    /// Whether checks of the debug profile are on, which makes every figure too high.
    pub debug_build: bool,
    /// Frames per engine.
    pub frames: usize,
    /// In the order they were asked for.
    pub engines: Vec<Row>,
    /// The crop sampler by itself.
    pub crops: Vec<CropTime>,
}

/// An engine on a number of threads.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// As it is named on the command line, without threads.
    pub engine: String,
    /// Threads asked for.
    pub threads: usize,
    /// Why there are no figures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unavailable: Option<String>,
    /// Figures, unless it is unavailable.
    #[serde(flatten)]
    pub figures: Option<Figures>,
}

/// Percentiles of one stage over all frames, in milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Times {
    /// Median by the clock.
    pub wall_ms_p50: f64,
    /// 95th percentile by the clock.
    pub p95: f64,
    /// 99th percentile by the clock.
    pub p99: f64,
    /// Median of the processor time of all threads.
    pub cpu_ms_p50: f64,
    /// Its 95th percentile.
    pub cpu_ms_p95: f64,
    /// Its 99th percentile.
    pub cpu_ms_p99: f64,
}

/// What was measured.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Figures {
    /// Name of the network.
    pub preset: String,
    /// Instruction set of the kernels, where the engine tells.
    pub isa: Option<String>,
    /// Of the whole frame, without memory writes.
    #[serde(flatten)]
    pub frame: Times,
    /// Allocations of Rust code per frame, memory write included.
    pub allocs_per_frame: f64,
    /// Bytes asked for in them.
    pub bytes_per_frame: f64,
    /// Those of the allocations that reached the system's allocator.
    pub system_allocs_per_frame: f64,
    /// Peak memory of a process with this engine alone, in 10^6 bytes.
    pub peak_rss_mb: Option<f64>,
    /// From the file to a tracker that is ready.
    pub load_ms: f64,
    /// The same in processor time.
    pub load_cpu_ms: f64,
    /// Pool that the engine allocates from.
    pub pool: Option<Pool>,
    /// Median processor time over that of the first row.
    pub cpu_ratio: f64,
    /// Median time by the clock over that of the first row.
    pub wall_ratio: f64,
    /// Parts of a frame; `template` is a memory write, on top of `frame`.
    pub stages: BTreeMap<&'static str, Times>,
}

impl Figures {
    /// From what a worker answered.
    pub fn new(loaded: &Loaded, rounds: &[Round]) -> Self {
        let samples: Vec<&Sample> = rounds.iter().flat_map(|r| &r.frames).collect();
        let stages: BTreeMap<_, _> = STAGES
            .iter()
            .enumerate()
            .map(|(stage, &name)| {
                let mut wall: Vec<f64> = samples.iter().filter_map(|s| s.wall[stage]).collect();
                let mut cpu: Vec<f64> = samples.iter().filter_map(|s| s.cpu[stage]).collect();
                let times = Times {
                    wall_ms_p50: quantile(&mut wall, 0.5),
                    p95: quantile(&mut wall, 0.95),
                    p99: quantile(&mut wall, 0.99),
                    cpu_ms_p50: quantile(&mut cpu, 0.5),
                    cpu_ms_p95: quantile(&mut cpu, 0.95),
                    cpu_ms_p99: quantile(&mut cpu, 0.99),
                };
                (name, times)
            })
            .collect();
        let frames = samples.len().max(1) as f64;
        let per_frame = |of: fn(&Round) -> u64| rounds.iter().map(of).sum::<u64>() as f64 / frames;
        let last = rounds.last();
        Self {
            preset: loaded.preset.clone(),
            isa: loaded.isa.clone(),
            frame: stages.get(STAGES[FRAME]).copied().unwrap_or_default(),
            allocs_per_frame: per_frame(|r| r.allocations),
            bytes_per_frame: per_frame(|r| r.bytes),
            system_allocs_per_frame: per_frame(|r| r.system),
            peak_rss_mb: last.and_then(|r| r.peak_rss).map(|b| b as f64 / 1e6),
            load_ms: loaded.load_ms,
            load_cpu_ms: loaded.load_cpu_ms,
            pool: last.and_then(|r| r.pool),
            cpu_ratio: 1.0,
            wall_ratio: 1.0,
            stages,
        }
    }
}

impl Report {
    /// Fills in the ratios.
    pub fn compare(&mut self) {
        let Some(base) = self.engines.iter().find_map(|r| r.figures.as_ref()).map(|f| f.frame)
        else {
            return;
        };
        let ratio = |a: f64, b: f64| if b > 0.0 { a / b } else { 1.0 };
        for figures in self.engines.iter_mut().filter_map(|r| r.figures.as_mut()) {
            figures.cpu_ratio = ratio(figures.frame.cpu_ms_p50, base.cpu_ms_p50);
            figures.wall_ratio = ratio(figures.frame.wall_ms_p50, base.wall_ms_p50);
        }
    }

    /// For people.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{}: {} frames per engine; {}, {} cores, {}\n",
            self.bundle,
            self.frames,
            self.cpu,
            self.cores,
            self.isa.unwrap_or("no native engine")
        );
        if self.debug_build {
            text += "debug checks are on: build with --release for figures that count\n";
        }
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "\n{:<22} {:>8} {:>8} {:>8} {:>8} {:>6} {:>6} {:>9} {:>10} {:>8} {:>8}",
            "milliseconds",
            "cpu p50",
            "wall p50",
            "p95",
            "p99",
            "cpu x",
            "wall x",
            "allocs",
            "bytes",
            "RSS MB",
            "load"
        );
        for row in &self.engines {
            let name = format!("{} {}T", row.engine, row.threads);
            let Some(f) = &row.figures else { continue };
            let rss = f.peak_rss_mb.map_or_else(|| "-".into(), |mb| format!("{mb:.1}"));
            let _ = writeln!(
                text,
                "{name:<22} {:>8.2} {:>8.2} {:>8.2} {:>8.2} {:>6.2} {:>6.2} {:>9.0} {:>10.0} \
                 {rss:>8} {:>8.1}",
                f.frame.cpu_ms_p50,
                f.frame.wall_ms_p50,
                f.frame.p95,
                f.frame.p99,
                f.cpu_ratio,
                f.wall_ratio,
                f.allocs_per_frame,
                f.bytes_per_frame,
                f.load_ms,
            );
        }
        let _ = writeln!(text, "\n{:<22} {}", "cpu p50 by stage", {
            STAGES.map(|s| format!("{s:>9}")).join("")
        });
        for row in &self.engines {
            let Some(f) = &row.figures else { continue };
            let name = format!("{} {}T", row.engine, row.threads);
            let stage = |s: &str| f.stages.get(s).map_or(0.0, |t| t.cpu_ms_p50);
            let cells = STAGES.map(|s| format!("{:>9.3}", stage(s))).join("");
            let _ = writeln!(text, "{name:<22} {cells}");
            if let Some(pool) = &f.pool {
                let _ = writeln!(
                    text,
                    "{:<22}   {pool}; {:.0} allocations per frame by the system",
                    "", f.system_allocs_per_frame
                );
            }
        }
        text += "\nframe: crop to box; template: a memory write, on top of it; x: over the first \
                 row; allocations: those of Rust code\n\n";
        for c in &self.crops {
            let _ = writeln!(
                text,
                "crop of {:.0} px from {} {}x{}: {:.3} ms",
                c.area, c.format, c.width, c.height, c.wall_ms_p50
            );
        }
        for row in &self.engines {
            if let Some(reason) = &row.unavailable {
                let _ = writeln!(text, "not measured: {} {}T: {reason}", row.engine, row.threads);
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_by_nearest_rank() {
        let mut values: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(
            [0.5, 0.95, 0.99, 1.0].map(|s| quantile(&mut values, s)),
            [50.0, 95.0, 99.0, 100.0]
        );
        assert_eq!((quantile(&mut [], 0.5), quantile(&mut [7.0], 0.01)), (0.0, 7.0));
    }

    #[test]
    fn figures_leave_out_what_did_not_happen() {
        let sample = |ms: f64, template: Option<f64>| {
            let stages = [
                Some(0.1 * ms),
                Some(0.5 * ms),
                Some(0.3 * ms),
                Some(0.1 * ms),
                Some(ms),
                template,
            ];
            Sample { wall: stages, cpu: stages.map(|s| s.map(|v| 2.0 * v)) }
        };
        let rounds = [
            Round {
                frames: vec![sample(10.0, None), sample(30.0, Some(4.0))],
                allocations: 6,
                bytes: 90,
                ..Round::default()
            },
            Round {
                frames: vec![sample(20.0, None)],
                system: 3,
                peak_rss: Some(5_000_000),
                ..Round::default()
            },
        ];
        let f = Figures::new(&Loaded::default(), &rounds);
        assert_eq!((f.frame.wall_ms_p50, f.frame.cpu_ms_p50, f.frame.p99), (20.0, 40.0, 30.0));
        assert_eq!(f.stages["template"].wall_ms_p50, 4.0);
        assert_eq!(
            (f.allocs_per_frame, f.bytes_per_frame, f.system_allocs_per_frame),
            (2.0, 30.0, 1.0)
        );
        assert_eq!(f.peak_rss_mb, Some(5.0));
        let row = |figures| Row { engine: "e".into(), threads: 1, unavailable: None, figures };
        let slow = Figures {
            frame: Times { cpu_ms_p50: 60.0, wall_ms_p50: 10.0, ..f.frame },
            ..f.clone()
        };
        let mut report = Report {
            bundle: "b".into(),
            cpu: "c".into(),
            cores: 1,
            isa: None,
            debug_build: false,
            frames: 3,
            engines: vec![row(None), row(Some(f)), row(Some(slow))],
            crops: Vec::new(),
        };
        report.compare();
        let ratios =
            |i: usize| report.engines[i].figures.as_ref().map(|f| (f.cpu_ratio, f.wall_ratio));
        assert_eq!((ratios(1), ratios(2)), (Some((1.0, 1.0)), Some((1.5, 0.5))));
    }
}
