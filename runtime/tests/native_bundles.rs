//! The native engine on whole bundles: the stored probe of the shipped model, and of any bundles
//! named in `TSDA_BUNDLES` (paths, separated by `:`).
#![cfg(feature = "native")]

use tsda_runtime::bundle::{Bundle, BundleFile, SectionKind};
use tsda_runtime::engine::native::{Isa, NativeEngine, NativeOptions};
use tsda_runtime::probe::{self, Probe};

/// The bundles to test; the shipped one is always there.
fn bundles() -> Vec<BundleFile> {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda").to_owned();
    let more = std::env::var("TSDA_BUNDLES").unwrap_or_default();
    let paths = std::iter::once(shipped).chain(more.split(':').map(str::to_owned));
    paths
        .filter(|path| !path.is_empty())
        .filter_map(|path| {
            if !std::path::Path::new(&path).exists() {
                println!("skipped: no {path}");
                return None;
            }
            Some(BundleFile::open(&path).unwrap())
        })
        .collect()
}

fn engine(bundle: &Bundle<'_>, threads: usize, isa: Option<Isa>) -> Option<NativeEngine> {
    let options = NativeOptions { threads, isa, ..NativeOptions::default() };
    match NativeEngine::with_options(bundle, options) {
        Err(e) if e.to_string().contains("this processor has no") => None,
        other => Some(other.unwrap()),
    }
}

#[test]
fn the_stored_probe_comes_out_with_every_instruction_set_and_several_threads() {
    for file in bundles() {
        let bundle = file.bundle().unwrap();
        let spec = bundle.manifest().spec;
        let stored = Probe::parse(bundle.require(SectionKind::Probe).unwrap(), &spec).unwrap();
        let sets = [Isa::Scalar, Isa::Avx2, Isa::Avx512, Isa::Neon];
        let runs = sets.map(|isa| (Some(isa), 1)).into_iter().chain([(None, 2), (None, 3)]);
        for (isa, threads) in runs {
            let Some(mut engine) = engine(&bundle, threads, isa) else { continue };
            if threads == 2 {
                println!("{}", engine.plan_summary());
            }
            let report = probe::run(&mut engine, &stored).unwrap();
            println!("{}: {isa:?}, {threads} threads: {report:?}", bundle.manifest().name);
            assert!(report.max() <= 2e-5, "{isa:?}, {threads} threads: {report:?}");
        }
    }
}
