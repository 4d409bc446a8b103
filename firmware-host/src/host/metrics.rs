//! Figures of a run in the text format of Prometheus. The loop only sets numbers; text is made when
//! somebody asks.

use super::http::{Access, Handler, Method, Request, Responder, Server};
use super::output::{Event, EventKind, FrameRecord, Losses, Output, SourceInfo, Views};
use super::source::Counters;
use super::zones::Zones;
use crate::error::HostError;
use crate::switch::{Condition, Reason};
use std::fmt::{self, Write as _};
use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Instant;
use tsda_runtime::TrackState;

/// Upper limits of the latency histogram, in seconds.
const LIMITS: [f64; 12] =
    [0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.1, 0.25, 1.0];
/// Latencies that quantiles are taken of.
const RECENT: usize = 1024;

const REASONS: [&str; 5] = ["command", "failure", "recovered", "schedule", "scene"];
const STATES: [&str; 5] = ["idle", "tracking", "uncertain", "searching", "lost"];
const FAULTS: [Condition; 7] = [
    Condition::Late,
    Condition::Gone,
    Condition::Damaged,
    Condition::Frozen,
    Condition::Dark,
    Condition::Saturated,
    Condition::Shutter,
];

#[derive(Debug, Default)]
struct PerSource {
    frames: AtomicU64,
    /// In the order of [`Counters`]' fields.
    counters: [AtomicU64; 6],
    faults: [AtomicU64; FAULTS.len()],
}

const COUNTERS: [(&str, &str); 6] = [
    ("delivered", "Pictures delivered to the loop."),
    ("skipped", "Pictures passed over because a newer one was there."),
    ("missing", "Pictures missing in the driver's numbering."),
    ("damaged", "Pictures marked as damaged, or too short."),
    ("restarts", "Restarts of the stream after an error."),
    ("unplugged", "Times the device went away."),
];

/// All figures; shared between the loop and who asks.
#[derive(Debug)]
pub struct Metrics {
    sources: Vec<(SourceInfo, PerSource)>,
    start: Instant,
    predicted: AtomicU64,
    active: AtomicU64,
    state: AtomicU64,
    score: AtomicU32,
    confidence: AtomicU32,
    fps: AtomicU32,
    last: AtomicU64,
    buckets: [AtomicU64; LIMITS.len() + 1],
    micros: AtomicU64,
    recent: Box<[AtomicU32]>,
    switches: [AtomicU64; REASONS.len()],
    selected: AtomicU64,
    refused: AtomicU64,
    allocations: AtomicU64,
    zones: Option<Arc<Zones>>,
    outputs: OnceLock<Vec<(String, Losses)>>,
}

fn add(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

fn get(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}

fn put(number: &AtomicU32, value: f32) {
    number.store(value.to_bits(), Ordering::Relaxed);
}

fn value(number: &AtomicU32) -> f32 {
    f32::from_bits(number.load(Ordering::Relaxed))
}

impl Metrics {
    /// Nothing counted yet.
    pub fn new(sources: &[SourceInfo], zones: Option<Arc<Zones>>) -> Self {
        Self {
            sources: sources.iter().map(|s| (s.clone(), PerSource::default())).collect(),
            start: Instant::now(),
            predicted: AtomicU64::default(),
            active: AtomicU64::default(),
            state: AtomicU64::default(),
            score: AtomicU32::new(f32::NAN.to_bits()),
            confidence: AtomicU32::new(f32::NAN.to_bits()),
            fps: AtomicU32::default(),
            last: AtomicU64::default(),
            buckets: Default::default(),
            micros: AtomicU64::default(),
            recent: (0..RECENT).map(|_| AtomicU32::default()).collect(),
            switches: Default::default(),
            selected: AtomicU64::default(),
            refused: AtomicU64::default(),
            allocations: AtomicU64::default(),
            zones,
            outputs: OnceLock::new(),
        }
    }

    /// Names the outputs whose losses are reported; only the first call counts.
    pub fn watch(&self, outputs: Vec<(String, Losses)>) {
        let _ = self.outputs.set(outputs);
    }

    fn frame(&self, record: &FrameRecord, views: &Views<'_>) {
        for (i, (_, source)) in self.sources.iter().enumerate() {
            if i == record.source {
                add(&source.frames);
            }
            let Some(c) = views.counters(i) else { continue };
            let Counters { delivered, skipped, missing, damaged, restarts, unplugged } = c;
            let values = [delivered, skipped, missing, damaged, restarts, unplugged];
            for (counter, value) in source.counters.iter().zip(values) {
                counter.store(value, Ordering::Relaxed);
            }
        }
        let target = record.target.as_ref();
        let state = match target.map(|t| t.state) {
            None => 0,
            Some(TrackState::Tracking) => 1,
            Some(TrackState::Uncertain) => 2,
            Some(TrackState::Searching) => 3,
            Some(TrackState::Lost) => 4,
        };
        self.state.store(state, Ordering::Relaxed);
        self.active.store(record.source as u64, Ordering::Relaxed);
        self.allocations.fetch_add(record.allocations, Ordering::Relaxed);
        put(&self.score, target.map_or(f32::NAN, |t| t.score));
        put(&self.confidence, target.and_then(|t| t.confidence).unwrap_or(f32::NAN));
        let now = self.start.elapsed().as_micros() as u64;
        let before = self.last.swap(now, Ordering::Relaxed);
        if before > 0 {
            let gap = (now.saturating_sub(before) as f32 / 1e6).max(1e-6);
            let fps = value(&self.fps);
            put(
                &self.fps,
                if fps == 0.0 { 1.0 / gap } else { fps + (1.0 / gap - fps) * gap.min(1.0) },
            );
        }
        if record.condition != Condition::Good {
            add(&self.predicted);
            return;
        }
        let seconds = record.latency.as_secs_f64();
        let bucket = LIMITS.iter().position(|l| seconds <= *l).unwrap_or(LIMITS.len());
        let slot = self.buckets.iter().map(get).sum::<u64>() as usize % RECENT;
        add(&self.buckets[bucket]);
        let micros = record.latency.as_micros();
        self.micros.fetch_add(micros as u64, Ordering::Relaxed);
        // 0 marks a place that was never used.
        self.recent[slot].store(micros.clamp(1, u32::MAX.into()) as u32, Ordering::Relaxed);
    }

    fn event(&self, event: &Event) {
        match &event.kind {
            EventKind::Switched { reason, .. } => add(&self.switches[match reason {
                Reason::Command => 0,
                Reason::Failure(_) => 1,
                Reason::Recovered => 2,
                Reason::Schedule => 3,
                Reason::Scene { .. } => 4,
            }]),
            EventKind::Lost { source, condition } => {
                let fault = FAULTS.iter().position(|f| f == condition);
                if let (Some((_, source)), Some(fault)) = (self.sources.get(*source), fault) {
                    add(&source.faults[fault]);
                }
            }
            EventKind::Selected { .. } => add(&self.selected),
            EventKind::Refused { .. } => add(&self.refused),
            _ => {}
        }
    }

    /// All figures as text.
    pub fn text(&self) -> String {
        let mut out = Text(String::with_capacity(8192));
        out.head("tsda_build_info", "gauge", "The program.");
        out.line("tsda_build_info", &[("version", env!("CARGO_PKG_VERSION"))], 1.0);
        out.one(
            "tsda_uptime_seconds",
            "gauge",
            "Time since the start.",
            self.start.elapsed().as_secs_f64(),
        );
        self.sources_text(&mut out);
        out.one(
            "tsda_predicted_frames_total",
            "counter",
            "Records without a usable picture.",
            get(&self.predicted) as f64,
        );
        out.one(
            "tsda_frame_rate",
            "gauge",
            "Records per second, over about a second.",
            value(&self.fps).into(),
        );
        out.one(
            "tsda_score",
            "gauge",
            "Score of the target; NaN without one.",
            value(&self.score).into(),
        );
        out.one(
            "tsda_confidence",
            "gauge",
            "Probability that the box is right; NaN where unknown.",
            value(&self.confidence).into(),
        );
        out.head("tsda_state", "gauge", "1 for the state of the tracker.");
        for (i, state) in STATES.iter().enumerate() {
            out.line("tsda_state", &[("state", state)], f64::from(get(&self.state) == i as u64));
        }
        out.head("tsda_switches_total", "counter", "Sensor changes.");
        for (reason, n) in REASONS.iter().zip(&self.switches) {
            out.line("tsda_switches_total", &[("reason", reason)], get(n) as f64);
        }
        out.one("tsda_selections_total", "counter", "Targets taken.", get(&self.selected) as f64);
        out.one(
            "tsda_refused_total",
            "counter",
            "Commands and frames that could not be followed.",
            get(&self.refused) as f64,
        );
        self.latency_text(&mut out);
        out.one(
            "tsda_loop_allocations_total",
            "counter",
            "Allocations of the loop's thread.",
            get(&self.allocations) as f64,
        );
        if let Some(outputs) = self.outputs.get() {
            out.head("tsda_output_dropped_total", "counter", "Items an output lost.");
            for (name, losses) in outputs {
                out.line("tsda_output_dropped_total", &[("output", name)], losses.count() as f64);
            }
        }
        if let Some(zones) = &self.zones {
            out.head("tsda_temperature_celsius", "gauge", "Thermal zones of the machine.");
            for (name, celsius) in zones.readings() {
                out.line("tsda_temperature_celsius", &[("zone", name)], celsius.into());
            }
            out.one(
                "tsda_throttled",
                "gauge",
                "1 while frames are left out because it is too warm.",
                f64::from(zones.hot()),
            );
        }
        if let Some(bytes) = resident() {
            out.one("process_resident_memory_bytes", "gauge", "Resident memory.", bytes as f64);
        }
        out.0
    }

    fn sources_text(&self, out: &mut Text) {
        out.head("tsda_frames_total", "counter", "Records.");
        for (info, source) in &self.sources {
            out.line("tsda_frames_total", &[("source", &info.name)], get(&source.frames) as f64);
        }
        out.head("tsda_active_source", "gauge", "1 for the source in use.");
        for (i, (info, _)) in self.sources.iter().enumerate() {
            let active = f64::from(get(&self.active) == i as u64);
            out.line("tsda_active_source", &[("source", &info.name)], active);
        }
        for (i, (name, help)) in COUNTERS.iter().enumerate() {
            let name = format!("tsda_source_{name}_total");
            out.head(&name, "counter", help);
            for (info, source) in &self.sources {
                out.line(&name, &[("source", &info.name)], get(&source.counters[i]) as f64);
            }
        }
        out.head("tsda_camera_faults_total", "counter", "Times a source became unusable.");
        for (info, source) in &self.sources {
            for (fault, n) in FAULTS.iter().zip(&source.faults) {
                let labels = [("source", info.name.as_str()), ("kind", fault.as_str())];
                out.line("tsda_camera_faults_total", &labels, get(n) as f64);
            }
        }
    }

    fn latency_text(&self, out: &mut Text) {
        let name = "tsda_latency_seconds";
        out.head(name, "histogram", "From a usable picture being there to its record.");
        let mut sum = 0;
        for (i, bucket) in self.buckets.iter().enumerate() {
            sum += get(bucket);
            let limit = LIMITS.get(i).map_or("+Inf".to_owned(), f64::to_string);
            out.line("tsda_latency_seconds_bucket", &[("le", &limit)], sum as f64);
        }
        out.line("tsda_latency_seconds_sum", &[], get(&self.micros) as f64 / 1e6);
        out.line("tsda_latency_seconds_count", &[], sum as f64);
        let mut recent: Vec<u32> =
            self.recent.iter().map(|v| v.load(Ordering::Relaxed)).filter(|v| *v > 0).collect();
        recent.sort_unstable();
        let name = "tsda_latency_recent_seconds";
        out.head(name, "gauge", "Quantiles of the latest 1024 latencies.");
        for (label, q) in [("0.5", 0.5), ("0.95", 0.95), ("0.99", 0.99), ("1", 1.0)] {
            let at = (recent.len() as f64 * q).ceil() as usize;
            let v = recent.get(at.saturating_sub(1)).map_or(f64::NAN, |v| f64::from(*v) / 1e6);
            out.line(name, &[("quantile", label)], v);
        }
    }
}

/// Resident memory of this process.
fn resident() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// The text being written.
struct Text(String);

impl Text {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        let _ = write!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}\n");
    }

    fn line(&mut self, name: &str, labels: &[(&str, &str)], value: f64) {
        self.0 += name;
        for (i, (key, text)) in labels.iter().enumerate() {
            let _ = write!(self.0, "{}{key}=\"{}\"", if i == 0 { '{' } else { ',' }, Escaped(text));
        }
        if !labels.is_empty() {
            self.0.push('}');
        }
        let _ = match value {
            v if v.is_nan() => writeln!(self.0, " NaN"),
            v => writeln!(self.0, " {v}"),
        };
    }

    fn one(&mut self, name: &str, kind: &str, help: &str, value: f64) {
        self.head(name, kind, help);
        self.line(name, &[], value);
    }
}

/// A label's value.
struct Escaped<'a>(&'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in self.0.chars() {
            match c {
                '\\' => f.write_str("\\\\")?,
                '"' => f.write_str("\\\"")?,
                '\n' => f.write_str("\\n")?,
                c => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

impl Handler for Metrics {
    fn handle(&self, request: &Request, to: &mut Responder<'_>) -> io::Result<()> {
        if (request.method, request.path.as_str()) != (Method::Get, "/metrics") {
            return to.outcome(Err((404, "there is only /metrics".into())));
        }
        to.reply(200, "text/plain; version=0.0.4; charset=utf-8", "", self.text().as_bytes())
    }
}

/// Feeds [`Metrics`], and serves them at an address of their own.
#[derive(Debug)]
pub struct MetricsOutput {
    name: String,
    metrics: Arc<Metrics>,
    losses: Losses,
    server: Option<Server>,
}

impl MetricsOutput {
    /// `access`: where to serve; without it somebody else does.
    ///
    /// # Errors
    /// When the address is taken.
    pub fn open(metrics: Arc<Metrics>, access: Option<Access>) -> Result<Self, HostError> {
        let handler: Arc<dyn Handler> = Arc::<Metrics>::clone(&metrics);
        let server = access.map(|a| Server::start(a, handler)).transpose()?;
        let name = match &server {
            Some(server) => format!("metrics at http://{}/metrics", server.address()),
            None => "metrics at /metrics of the preview".into(),
        };
        Ok(Self { name, metrics, losses: Losses::default(), server })
    }
}

impl Output for MetricsOutput {
    fn name(&self) -> &str {
        &self.name
    }

    fn frame(&mut self, record: &FrameRecord, views: &Views<'_>) {
        self.metrics.frame(record, views);
    }

    fn event(&mut self, event: &Event) {
        self.metrics.event(event);
    }

    fn losses(&self) -> &Losses {
        &self.losses
    }

    fn finish(&mut self) {
        self.server = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;
    use tsda_runtime::Modality;

    fn record(millis: u64) -> FrameRecord {
        FrameRecord {
            frame: 0,
            at: Duration::ZERO,
            capture: None,
            source: 0,
            size: (8, 8),
            sequence: 0,
            condition: Condition::Good,
            target: None,
            latency: Duration::from_millis(millis),
            tracking: Duration::ZERO,
            skipped: 0,
            allocations: 0,
        }
    }

    /// Every line of the text: name, labels, value.
    fn parse(text: &str) -> Vec<(String, String, f64)> {
        let (mut typed, mut samples) = (Vec::new(), Vec::new());
        for line in text.lines() {
            if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (name, kind) = rest.split_once(' ').expect("kind");
                assert!(["counter", "gauge", "histogram"].contains(&kind), "{line}");
                assert!(kind != "counter" || name.ends_with("_total"), "{line}");
                assert!(!typed.contains(&name.to_owned()), "twice: {line}");
                typed.push(name.to_owned());
                continue;
            }
            if line.starts_with("# HELP ") {
                continue;
            }
            let (head, value) = line.rsplit_once(' ').expect("value");
            let (name, labels) = head.split_once('{').unwrap_or((head, "}"));
            let labels = labels.strip_suffix('}').expect("closed");
            let of = typed.last().expect("typed before used");
            let rest = name.strip_prefix(of.as_str()).expect("samples of a name stand together");
            assert!(["", "_bucket", "_sum", "_count"].contains(&rest), "{line}");
            let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
            assert!(name.chars().all(word), "{line}");
            samples.push((name.to_owned(), labels.to_owned(), value.parse().expect("number")));
        }
        samples
    }

    #[test]
    fn the_text_is_in_the_format_and_right() {
        let sources = [SourceInfo { name: "a \"quoted\\ one\n".into(), sensor: Modality::Rgb }];
        let metrics = Metrics::new(&sources, None);
        metrics.watch(vec![("json to stdout".into(), Losses::default())]);
        for millis in 1..=100 {
            metrics.frame(&record(millis), &Views(&[]));
        }
        let reason = Reason::Failure(Condition::Gone);
        for kind in [
            EventKind::Switched { from: 0, to: 0, reason },
            EventKind::Lost { source: 0, condition: Condition::Gone },
        ] {
            metrics.event(&Event { at: Duration::ZERO, frame: 0, kind });
        }
        let text = metrics.text();
        let samples = parse(&text);
        let of = |name: &str, labels: &str| {
            let found = samples.iter().find(|s| s.0 == name && s.1 == labels);
            found.unwrap_or_else(|| panic!("{name} {labels} in {text}")).2
        };
        let source = r#"source="a \"quoted\\ one\n""#;
        assert_eq!(of("tsda_frames_total", source), 100.0);
        assert_eq!(of("tsda_latency_seconds_bucket", "le=\"0.01\""), 10.0);
        assert_eq!(of("tsda_latency_seconds_bucket", "le=\"+Inf\""), 100.0);
        assert_eq!(of("tsda_latency_seconds_count", ""), 100.0);
        assert!((of("tsda_latency_seconds_sum", "") - 5.05).abs() < 1e-9);
        assert_eq!(of("tsda_latency_recent_seconds", "quantile=\"0.99\""), 0.099);
        assert_eq!(of("tsda_switches_total", "reason=\"failure\""), 1.0);
        assert_eq!(of("tsda_camera_faults_total", &format!("{source},kind=\"gone\"")), 1.0);
        assert_eq!(of("tsda_output_dropped_total", "output=\"json to stdout\""), 0.0);
        assert!(of("tsda_score", "").is_nan());
        assert!(of("process_resident_memory_bytes", "") > 1e6);
        let buckets: Vec<f64> =
            samples.iter().filter(|s| s.0.ends_with("_bucket")).map(|s| s.2).collect();
        assert!(buckets.is_sorted() && buckets.len() == LIMITS.len() + 1);
    }
}
