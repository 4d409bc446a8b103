//! What every exact re-arrangement of spec 4.2 and 4.3 saves, in multiply-accumulates and in time.
//!
//! ```text
//! cargo bench --workspace --profile dev --bench rearrangements -- [NETWORK ..] [--rounds N] [--write DIR]
//! ```
//!
//! Networks: `small`, `nano`, `tomp50`, `tomp101`; all when none is named. The graph as the
//! reference runs it and every step from there to the exported one are recorded, loaded into tract
//! and run in turns, so that a busy machine slows all of them alike; the table shows medians of the
//! processor time of one run (wall time where the system does not tell). `--write` leaves the graphs
//! as ONNX files, to time them in other engines.

#[path = "../../trainer/src/model/tests/as_written.rs"]
mod as_written;

use anyhow::{Context as _, bail};
use as_written::{AsWritten, Rearranged, Template, Weights};
use burn::tensor::Tensor;
use std::path::PathBuf;
use std::time::Instant;
use tract_onnx::prelude::{
    Framework as _, InferenceModelExt as _, IntoRunnable as _, TValue, TypedSimpleState,
};
use tsda_export::network;
use tsda_export::onnx::{ExportError, Graph, Recorder, Storage, encode, macs, optimise, record};
use tsda_runtime::bundle::SectionKind;
use tsda_runtime::{Backbone, ModelSpec};
use tsda_trainer::model::{SlotForm, TrackerNet};

fn spec(name: &str) -> Option<ModelSpec> {
    // The configuration of the golden figures.
    let small = ModelSpec {
        backbone: Backbone::ResNet { base_channels: 16, blocks: [2, 2, 3] },
        crop: 144,
        search_factor: 5.0,
        width: 64,
        heads: 4,
        feed_forward: 128,
        ltrb_hidden: 16,
        ..ModelSpec::NANO
    };
    if name == "small" { Some(small) } else { ModelSpec::preset(name) }
}

/// One way to compute the same thing.
struct Variant {
    name: &'static str,
    graph: Graph,
    /// Multiply-accumulates.
    macs: u64,
}

impl Variant {
    /// As recorded or simplified; multiply-accumulates are those of `graph` as it is given.
    fn new(name: &'static str, graph: Graph) -> Self {
        let macs = macs::count(&graph).iter().map(|n| n.macs).sum();
        Self { name, graph, macs }
    }

    /// Counts what was written down, then simplifies as every exported graph is.
    fn simplified(name: &'static str, graph: Graph) -> Self {
        let mut variant = Self::new(name, graph);
        optimise(&mut variant.graph);
        variant
    }
}

/// The network and its weights by name.
struct Subject {
    net: TrackerNet,
    spec: ModelSpec,
    weights: Weights,
}

impl Subject {
    fn new(spec: ModelSpec) -> anyhow::Result<Self> {
        let net = network::untrained(&spec, 7)?;
        let weights = tsda_trainer::import::state_dict(&net)
            .iter()
            .map(|(name, t)| (name.to_string(), (t.shape.clone(), t.values.clone())))
            .collect();
        Ok(Self { net, spec, weights })
    }

    fn reference(&self, r: &Recorder) -> AsWritten<'_> {
        AsWritten { spec: self.spec, weights: &self.weights, device: r.device().clone() }
    }

    fn exported(&self, form: SlotForm, kind: SectionKind) -> anyhow::Result<Graph> {
        let graphs = network::graphs_as(&self.net, form)?;
        let found = graphs.into_iter().find(|g| g.kind == kind);
        Ok(found.with_context(|| format!("no {kind}"))?.graph)
    }

    /// Crop to head feature.
    fn features(&self) -> anyhow::Result<Vec<Variant>> {
        let side = self.spec.crop_side();
        let written = record("features", "", |r| {
            let crop = r.input("crop", [1, 3, side, side], "")?;
            let reference = self.reference(r);
            r.output("feature", reference.head_feature(reference.backbone(crop)), "")
        })?;
        // Not simplified, which would fold its batch norms.
        let written = Variant::new("as written, batch norms apart", written);
        let folded = self.exported(SlotForm::Tokens, SectionKind::FeaturesOnnx)?;
        Ok(vec![written, Variant::new("batch norms folded (4.3.5)", folded)])
    }

    /// Head feature of the search crop and `count` templates to maps.
    fn predictions(&self, count: u8) -> anyhow::Result<Vec<Variant>> {
        let both = Rearranged { short_row: true, ..Rearranged::default() };
        let decoder = Rearranged { memory_space: true, value_only: true, ..both };
        let kind = SectionKind::PredictOnnx(count);
        Ok(vec![
            Variant::simplified("as written", self.written(count)?),
            Variant::simplified(
                "template tokens kept (4.2)",
                self.with_tokens(count, Rearranged::default())?,
            ),
            Variant::simplified(
                "second row without mask (4.3.1, 2)",
                self.with_tokens(count, both)?,
            ),
            Variant::simplified(
                "decoder in memory space (4.3.3, 4)",
                self.with_tokens(count, decoder)?,
            ),
            Variant::new("one product for q, k, v (4.2)", self.exported(SlotForm::Tokens, kind)?),
            Variant::new(
                "first layer's kept (4.2, 4.3.8)",
                self.exported(SlotForm::Projected, kind)?,
            ),
        ])
    }

    /// Everything in every frame, templates from their backbone features.
    fn written(&self, count: u8) -> Result<Graph, ExportError> {
        let (c, f) = (self.spec.backbone.out_channels(), self.spec.map_side());
        record("predict", "", |r| {
            let mut templates = Vec::new();
            for i in 0..count {
                templates.push(Template {
                    feature: r.input(&format!("feature{i}"), [1, c, f, f], "")?,
                    label: r.input(&format!("label{i}"), [f, f], "")?,
                    ltrb: r.input(&format!("ltrb{i}"), [4, f, f], "")?,
                });
            }
            let tokens = self.reference(r).template_tokens(&templates, 2);
            self.finish(r, tokens, Rearranged::default())
        })
    }

    fn with_tokens(&self, count: u8, with: Rearranged) -> Result<Graph, ExportError> {
        let (cells, d) = (self.spec.cells(), usize::from(self.spec.width));
        record("predict", "", |r| {
            let tokens = (0..count)
                .map(|i| r.input(&format!("template{i}"), [1, cells, d], ""))
                .collect::<Result<Vec<_>, _>>()?;
            self.finish(r, Tensor::cat(tokens, 1), with)
        })
    }

    fn finish(
        &self,
        r: &mut Recorder,
        templates: Tensor<3>,
        with: Rearranged,
    ) -> Result<(), ExportError> {
        let (d, f) = (usize::from(self.spec.width), self.spec.map_side());
        let search = r.input("feature", [1, d, f, f], "")?;
        let (scores, ltrb) = self.reference(r).predict(templates, search, with);
        r.output("scores", scores, "")?;
        r.output("ltrb", ltrb, "")
    }

    /// Attention of the first encoder layer alone, two templates, from its queries, keys and
    /// values: whole, and with the block of templates among themselves kept from the memory write
    /// as sums that are not normalised yet, their largest logits and their totals (4.3.8).
    fn first_attention(&self) -> anyhow::Result<Vec<Variant>> {
        let (heads, n) = (usize::from(self.spec.heads), self.spec.cells());
        let (depth, t, l) = (usize::from(self.spec.width) / heads, 2 * n, 3 * n);
        let softmax = burn::tensor::activation::softmax::<3>;
        let whole = record("whole", "", |r| {
            let q = r.input("q", [heads, l, depth], "")?;
            let k = r.input("k", [heads, depth, l], "")?;
            let v = r.input("v", [heads, l, depth], "")?;
            r.output("mixed", softmax(q.matmul(k), 2).matmul(v), "")
        })?;
        let kept = record("kept", "", |r| {
            let q = r.input("q", [heads, l, depth], "")?;
            let k = r.input("k", [heads, depth, l], "")?;
            let v = r.input("v", [heads, l, depth], "")?;
            let sums = r.input("sums", [heads, t, depth], "")?;
            let largest = r.input("largest", [heads, t, 1], "")?;
            let totals = r.input("totals", [heads, t, 1], "")?;
            let search = softmax(q.clone().narrow(1, t, n).matmul(k.clone()), 2).matmul(v.clone());
            let logits = q.narrow(1, 0, t).matmul(k.narrow(2, t, n));
            let top = Tensor::cat(vec![logits.clone().max_dim(2), largest.clone()], 2).max_dim(2);
            let powers = (logits - top.clone()).exp();
            let before = (largest - top).exp();
            let totals = powers.clone().sum_dim(2) + totals * before.clone();
            let sums = powers.matmul(v.narrow(1, t, n)) + sums * before;
            r.output("mixed", Tensor::cat(vec![sums / totals, search], 1), "")
        })?;
        Ok(vec![
            Variant::simplified("first attention, whole", whole),
            Variant::simplified("templates among themselves kept", kept),
        ])
    }
}

/// A variant in tract, with inputs of noise.
struct Loaded {
    state: TypedSimpleState,
    inputs: Vec<TValue>,
    /// Runs in a row per measurement.
    repeats: usize,
    /// Milliseconds per run.
    times: Vec<f64>,
}

/// Milliseconds that a measurement takes at least: processor time comes in steps of a few.
const SHORTEST: f64 = 200.0;

impl Loaded {
    fn new(graph: &Graph) -> anyhow::Result<Self> {
        let onnx = encode(graph, Storage::Inline);
        let model = tract_onnx::onnx().model_for_read(&mut &*onnx)?;
        let state = model.into_optimized()?.into_runnable()?.spawn()?;
        let mut seed = 1u32;
        let mut noise = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 8) as f32 / (1u32 << 24) as f32 - 0.5
        };
        let inputs = graph.inputs.iter().map(|port| {
            let dims = graph.dims(port.value);
            let values: Vec<f32> = (0..dims.iter().product()).map(|_| noise()).collect();
            tract_onnx::prelude::Tensor::from_shape(dims, &values).map(TValue::from)
        });
        Ok(Self { state, inputs: inputs.collect::<Result<_, _>>()?, repeats: 1, times: Vec::new() })
    }

    /// Finds out how many runs make a measurement long enough.
    fn warm_up(&mut self) -> anyhow::Result<()> {
        loop {
            self.measure()?;
            let last = self.times.pop().unwrap_or_default() * self.repeats as f64;
            if last >= SHORTEST || self.repeats >= 10_000 {
                return Ok(());
            }
            self.repeats *= 2;
        }
    }

    fn measure(&mut self) -> anyhow::Result<()> {
        let start = Clock::now();
        for _ in 0..self.repeats {
            self.state.run(self.inputs.iter().cloned().collect())?;
        }
        self.times.push(start.milliseconds() / self.repeats as f64);
        Ok(())
    }

    fn median(&self) -> f64 {
        let mut times = self.times.clone();
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied().unwrap_or(f64::NAN)
    }
}

/// Processor time of this thread, or wall time.
enum Clock {
    Processor(u64),
    Wall(Instant),
}

impl Clock {
    fn now() -> Self {
        processor_time().map_or_else(|| Self::Wall(Instant::now()), Self::Processor)
    }

    fn milliseconds(&self) -> f64 {
        match self {
            Self::Processor(start) => {
                processor_time().unwrap_or_default().saturating_sub(*start) as f64 * 1e-6
            }
            Self::Wall(start) => start.elapsed().as_secs_f64() * 1e3,
        }
    }
}

/// Nanoseconds that this thread has run, where Linux tells.
fn processor_time() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_whitespace().next()?.parse().ok()
}

struct Args {
    networks: Vec<String>,
    rounds: usize,
    write: Option<PathBuf>,
}

fn args() -> anyhow::Result<Args> {
    let mut args = Args { networks: Vec::new(), rounds: 5, write: None };
    let mut given = std::env::args().skip(1);
    while let Some(arg) = given.next() {
        match arg.as_str() {
            // What cargo itself adds.
            "--bench" => {}
            "--rounds" => args.rounds = given.next().context("--rounds N")?.parse()?,
            "--write" => args.write = Some(given.next().context("--write DIR")?.into()),
            name if spec(name).is_some() => args.networks.push(arg),
            other => bail!("`{other}` is no network; small, nano, tomp50 and tomp101 are"),
        }
    }
    if args.networks.is_empty() {
        args.networks = ["small", "nano", "tomp50", "tomp101"].map(String::from).to_vec();
    }
    Ok(args)
}

fn compare(title: &str, file: &str, variants: &[Variant], args: &Args) -> anyhow::Result<()> {
    if let Some(dir) = &args.write {
        std::fs::create_dir_all(dir)?;
        for (i, variant) in variants.iter().enumerate() {
            let onnx = encode(&variant.graph, Storage::Inline);
            std::fs::write(dir.join(format!("{file}-{i}.onnx")), onnx)?;
        }
    }
    let mut loaded =
        variants.iter().map(|v| Loaded::new(&v.graph)).collect::<anyhow::Result<Vec<_>>>()?;
    for variant in &mut loaded {
        variant.warm_up()?;
    }
    for _ in 0..args.rounds {
        for variant in &mut loaded {
            variant.measure()?;
        }
    }
    println!("\n{title}\n");
    println!("| form | million MAC | to the first | ms | to the first |");
    println!("|---|---:|---:|---:|---:|");
    let first = (variants[0].macs as f64, loaded[0].median());
    for (variant, run) in variants.iter().zip(&loaded) {
        let (macs, ms) = (variant.macs as f64, run.median());
        let digits = if ms < 100.0 { 2 } else { 0 };
        println!(
            "| {} | {:.1} | {:.3} | {ms:.digits$} | {:.3} |",
            variant.name,
            macs * 1e-6,
            macs / first.0,
            ms / first.1
        );
    }
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let args = args()?;
    println!("tract, one thread; medians of {} rounds", args.rounds);
    for name in &args.networks {
        let spec = spec(name).context("checked before")?;
        let subject = Subject::new(spec)?;
        if matches!(spec.backbone, Backbone::ResNet { .. }) {
            let title = format!("{name}: features");
            compare(&title, &format!("{name}-features"), &subject.features()?, &args)?;
        }
        // The head of ToMP-50 is that of ToMP-101.
        if name == "tomp50" && args.networks.iter().any(|n| n == "tomp101") {
            continue;
        }
        for count in 1..=spec.templates {
            let title = format!("{name}: predict, {count} template(s)");
            let file = format!("{name}-predict{count}");
            compare(&title, &file, &subject.predictions(count)?, &args)?;
        }
        let title = format!("{name}: attention of the first layer, two templates");
        let file = format!("{name}-attention");
        compare(&title, &file, &subject.first_attention()?, &args)?;
    }
    Ok(())
}
