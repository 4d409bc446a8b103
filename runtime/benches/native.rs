//! Native engine against tract and ONNX Runtime, in one run, interleaved.
//!
//! ```text
//! cargo bench -p tsda-runtime --features native,tract,ort --bench native -- [BUNDLE..] [--rounds N]
//! ```
//!
//! Without bundles the shipped `models/nano.tsda` is measured. Engines that are not compiled in, or
//! whose library is not found (`TSDA_ORT_LIB`), are left out. CPU time is that of all threads of the
//! process; on a machine that does other things besides, it and its ratios are what to look at.

use std::time::Instant;
use tsda_runtime::bundle::{Bundle, BundleFile};
use tsda_runtime::probe::crop_input;
use tsda_runtime::{Engine, EngineError};

/// One measured call, in milliseconds.
#[derive(Clone, Copy)]
struct Sample {
    wall: f64,
    cpu: f64,
}

/// CPU time of the process in milliseconds.
#[cfg(target_os = "linux")]
fn cpu_ms() -> f64 {
    #[repr(C)]
    struct Time {
        seconds: i64,
        nanoseconds: i64,
    }
    #[allow(unsafe_code)]
    unsafe extern "C" {
        fn clock_gettime(clock: i32, time: *mut Time) -> i32;
    }
    const PROCESS: i32 = 2;
    let mut time = Time { seconds: 0, nanoseconds: 0 };
    // SAFETY: the function fills in the struct it is given, whose layout is that of a 64-bit Linux.
    #[allow(unsafe_code)]
    unsafe {
        clock_gettime(PROCESS, &mut time);
    }
    time.seconds as f64 * 1e3 + time.nanoseconds as f64 * 1e-6
}

#[cfg(not(target_os = "linux"))]
fn cpu_ms() -> f64 {
    f64::NAN
}

fn measure(calls: usize, mut call: impl FnMut()) -> Sample {
    let (cpu, wall) = (cpu_ms(), Instant::now());
    (0..calls).for_each(|_| call());
    let n = calls as f64;
    Sample { wall: wall.elapsed().as_secs_f64() * 1e3 / n, cpu: (cpu_ms() - cpu) / n }
}

const STAGES: [&str; 4] = ["features", "template", "predict 1", "predict all"];

struct Contender {
    name: String,
    engine: Box<dyn Engine>,
    load: Sample,
    samples: [Vec<Sample>; 4],
}

type Loader<'b> = Box<dyn Fn() -> Result<Box<dyn Engine>, EngineError> + 'b>;

fn loaders<'b>(bundle: &'b Bundle<'b>) -> Vec<(String, Loader<'b>)> {
    let mut all: Vec<(String, Loader<'b>)> = Vec::new();
    #[cfg(feature = "native")]
    {
        use tsda_runtime::engine::native::{Isa, NativeEngine, NativeOptions};
        let isas = std::env::var("TSDA_ISA").unwrap_or_default();
        let mut native = |name: String, threads, isa| {
            let options = NativeOptions { threads, isa, ..NativeOptions::default() };
            let load = move || Ok(Box::new(NativeEngine::with_options(bundle, options)?) as _);
            all.push((name, Box::new(load)));
        };
        native("native 1T".into(), 1, None);
        native("native 2T".into(), 2, None);
        for isa in [Isa::Avx2, Isa::Scalar, Isa::Neon] {
            if isas.split(',').any(|name| name == isa.name()) {
                native(format!("native 1T {}", isa.name()), 1, Some(isa));
            }
        }
    }
    #[cfg(feature = "ort")]
    for threads in [1, 2] {
        use tsda_runtime::engine::ort::OrtEngine;
        let load = move || Ok(Box::new(OrtEngine::with_threads(bundle, threads)?) as _);
        all.push((format!("ort {threads}T"), Box::new(load)));
    }
    #[cfg(feature = "tract")]
    {
        use tsda_runtime::engine::TractEngine;
        let load = || Ok(Box::new(TractEngine::from_bundle(bundle)?) as _);
        all.push(("tract 1T".into(), Box::new(load)));
    }
    all
}

fn median(samples: &[Sample], of: impl Fn(&Sample) -> f64, share: f64) -> f64 {
    let mut values: Vec<f64> = samples.iter().map(of).collect();
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share) as usize]
}

fn bench(path: &str, rounds: usize) -> Result<(), Box<dyn std::error::Error>> {
    let file = BundleFile::open(path)?;
    let bundle = file.bundle()?;
    let spec = bundle.manifest().spec;
    let templates = usize::from(spec.templates);
    let mut contenders = Vec::new();
    for (name, load) in loaders(&bundle) {
        let mut loaded = None;
        let time = measure(1, || loaded = Some(load()));
        match loaded {
            Some(Ok(engine)) => {
                let samples = std::array::from_fn(|_| Vec::new());
                contenders.push(Contender { name, engine, load: time, samples });
            }
            Some(Err(e)) => println!("left out: {name}: {e}"),
            None => {}
        }
    }
    // A first round to warm up; it also says how many calls make a sample of some length.
    let mut calls = [1; 4];
    for round in 0..=rounds {
        for c in &mut contenders {
            let engine = &mut *c.engine;
            crop_input(&spec, round % 3, engine.crop_mut());
            let mut failed = None;
            let mut note = |r: Result<(), EngineError>| failed = r.err().or(failed.take());
            let samples = [
                measure(calls[0], || note(engine.features())),
                measure(calls[1], || {
                    for slot in 0..templates {
                        note(engine.write_template(slot));
                    }
                }),
                measure(calls[2], || note(engine.predict(1).map(drop))),
                measure(calls[3], || note(engine.predict(templates).map(drop))),
            ];
            if let Some(e) = failed {
                return Err(e.into());
            }
            if round > 0 {
                c.samples.iter_mut().zip(samples).for_each(|(all, s)| all.push(s));
            } else if c.name.starts_with("native 1T") {
                calls = samples.map(|s| (10.0 / s.wall).clamp(1.0, 50.0) as usize);
            }
        }
    }

    println!("\n{} ({rounds} rounds; template: all {templates} slots)", bundle.manifest().name);
    println!(
        "{:<18}{:>10}{:>10} |{}",
        "",
        "load wall",
        "load cpu",
        STAGES.map(|s| format!("{:>13}{:>9}{:>9}{:>7}", s, "cpu p50", "cpu p10", "x")).join(" |")
    );
    for c in &contenders {
        let mut line = format!("{:<18}{:>10.1}{:>10.1} |", c.name, c.load.wall, c.load.cpu);
        for (stage, samples) in c.samples.iter().enumerate() {
            let cpu = |s: &Sample| s.cpu;
            let p50 = median(samples, cpu, 0.5);
            let base = median(&contenders[0].samples[stage], cpu, 0.5);
            let wall = median(samples, |s| s.wall, 0.5);
            let p10 = median(samples, cpu, 0.1);
            line += &format!("{wall:>13.3}{p50:>9.3}{p10:>9.3}{:>7.2} |", p50 / base);
        }
        println!("{line}");
    }
    println!("wall p50, cpu p50, cpu p10 in ms; x: cpu p50 over that of the first line");
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut rounds = 15;
    let mut bundles = Vec::new();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match &*arg {
            "--rounds" => rounds = args.next().ok_or("--rounds needs a number")?.parse()?,
            // What cargo adds by itself.
            "--bench" => {}
            _ => bundles.push(arg),
        }
    }
    if bundles.is_empty() {
        bundles.push(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda").into());
    }
    bundles.iter().try_for_each(|path| bench(path, rounds))
}
