use super::*;
use crate::spec::{ModelSpec, TrackerParams};
use crate::tracker::MotionPrior;
use proptest::prelude::*;

fn manifest<'a>() -> Manifest<'a> {
    Manifest {
        name: "test",
        spec: ModelSpec::NANO,
        tracker: TrackerParams::default(),
        trained_on: TrainedOn { rgb: true, thermal: true, cross_modal: true },
        calibration: Some(ScoreCalibration { slope: 4.0, bias: -2.0 }),
        provenance: Provenance { trainer: "t 0.1", seed: 7, ..Default::default() },
        figures: heapless::Vec::from_slice(&[Figure { name: "AUC", value: 0.5 }]).unwrap(),
        licence: "MIT",
        card: "# card",
        sections: heapless::Vec::new(),
        precision: None,
        motion: None,
    }
}

/// The smallest possible writer, independent of the real one in the export crate.
fn write(mut manifest: Manifest<'_>, sections: &[(SectionKind, &[u8])]) -> Vec<u8> {
    let mut body_start = 0;
    loop {
        let mut at = body_start;
        manifest.sections.clear();
        for (kind, bytes) in sections {
            at = align_up(at).unwrap();
            let length = bytes.len() as u64;
            let section = Section { kind: *kind, offset: at, length, crc: crc32(bytes) };
            manifest.sections.push(section).unwrap();
            at += length;
        }
        let encoded = postcard::to_stdvec(&manifest).unwrap();
        let end = (HEADER_LEN + encoded.len()) as u64;
        if end == body_start {
            return assemble(&encoded, &manifest.sections, sections);
        }
        body_start = end;
    }
}

fn assemble(encoded: &[u8], table: &[Section], sections: &[(SectionKind, &[u8])]) -> Vec<u8> {
    let mut out = header(encoded).unwrap().to_vec();
    out.extend_from_slice(encoded);
    for (entry, (_, bytes)) in table.iter().zip(sections) {
        out.resize(entry.offset as usize, 0);
        out.extend_from_slice(bytes);
    }
    out
}

const SECTIONS: [(SectionKind, &[u8]); 4] = [
    (SectionKind::FeaturesOnnx, b"features"),
    (SectionKind::PredictOnnx(1), b"p1"),
    (SectionKind::PredictOnnx(2), b"predict two"),
    (SectionKind::Weights, &[9; 200]),
];

fn sample() -> Vec<u8> {
    write(manifest(), &SECTIONS)
}

#[test]
fn what_was_written_is_read() {
    let bytes = sample();
    let bundle = Bundle::parse(&bytes).unwrap();
    assert_eq!(bundle.manifest().name, "test");
    assert_eq!(bundle.manifest().card, "# card");
    assert_eq!(bundle.manifest().figures[0].value, 0.5);
    for (kind, body) in SECTIONS {
        assert_eq!(bundle.section(kind), Some(body), "{kind}");
    }
    assert_eq!(bundle.predict_kinds().collect::<Vec<_>>(), [1, 2]);
    assert_eq!(bundle.section(SectionKind::Probe), None);
    let missing = bundle.require(SectionKind::Probe).unwrap_err();
    assert_eq!(missing, BundleError::Missing(SectionKind::Probe));
    assert!(missing.to_string().contains("probe.bin"));
}

#[test]
fn empty_sections_and_no_sections_are_fine() {
    let bytes = write(manifest(), &[]);
    assert_eq!(Bundle::parse(&bytes).unwrap().predict_kinds().count(), 0);
    let bytes = write(manifest(), &[(SectionKind::Weights, b""), (SectionKind::Probe, b"x")]);
    assert_eq!(Bundle::parse(&bytes).unwrap().section(SectionKind::Weights), Some(&b""[..]));
}

#[test]
fn other_files_and_versions_are_told_apart() {
    assert_eq!(Bundle::parse(b"\x89PNG\r\n\x1a\n").unwrap_err(), BundleError::Magic);
    assert!(matches!(
        Bundle::parse(b"").unwrap_err(),
        BundleError::Truncated { part: Part::Header, needed: 24, len: 0 }
    ));
    // The version counts even when the header of the newer format is checked in another way.
    let mut bytes = sample();
    bytes[8..12].copy_from_slice(&(VERSION + 1).to_le_bytes());
    let error = Bundle::parse(&bytes).unwrap_err();
    assert_eq!(error, BundleError::Newer { found: VERSION + 1 });
    assert!(error.to_string().contains("update the program"));
}

#[test]
fn a_damaged_section_is_named() {
    let bytes = sample();
    let bundle = Bundle::parse(&bytes).unwrap();
    for entry in &bundle.manifest().sections {
        let part = Part::Section(entry.kind);
        let mut altered = bytes.clone();
        altered[entry.offset as usize] ^= 1;
        assert_eq!(Bundle::parse(&altered).unwrap_err(), BundleError::Checksum { part });
        let cut = &bytes[..(entry.offset + entry.length - 1) as usize];
        let needed = entry.offset + entry.length;
        assert_eq!(
            Bundle::parse(cut).unwrap_err(),
            BundleError::Truncated { part, needed, len: needed - 1 }
        );
    }
}

#[test]
fn contradicting_tables_are_refused() {
    let crc = crc32(b"");
    let at = |offset, length, kind| Section { kind, offset, length, crc };
    let weights = SectionKind::Weights;
    let cases: [(&str, Vec<Section>); 4] = [
        ("multiple of 64", vec![at(1030, 0, weights)]),
        ("overlaps", vec![at(0, 0, weights)]),
        ("beyond 64 bits", vec![at(u64::MAX - 63, 100, weights)]),
        ("twice", vec![at(1024, 0, weights), at(1024, 0, weights)]),
    ];
    for (want, table) in cases {
        let mut m = manifest();
        m.sections = heapless::Vec::from_slice(&table).unwrap();
        let encoded = postcard::to_stdvec(&m).unwrap();
        let mut bytes = header(&encoded).unwrap().to_vec();
        bytes.extend_from_slice(&encoded);
        bytes.resize(1024, 0);
        let error = Bundle::parse(&bytes).unwrap_err().to_string();
        assert!(error.contains(want) && error.contains("weights.bin"), "{want}: {error}");
    }
}

#[test]
fn a_bad_spec_is_refused_although_every_checksum_is_right() {
    let mut m = manifest();
    m.spec.heads = 5;
    let error = Bundle::parse(&write(m, &SECTIONS)).unwrap_err();
    assert!(matches!(error, BundleError::Spec(e) if e.field == "heads"));
    let mut m = manifest();
    m.tracker.lost_after = 0;
    let error = Bundle::parse(&write(m, &SECTIONS)).unwrap_err();
    assert!(error.to_string().contains("lost_after"));
}

#[test]
fn bytes_after_the_end_and_in_the_padding_are_refused() {
    let mut bytes = sample();
    bytes.push(0);
    assert!(matches!(Bundle::parse(&bytes).unwrap_err(), BundleError::Trailing { .. }));
    let mut bytes = sample();
    let first = Bundle::parse(&bytes).unwrap().manifest().sections[0];
    bytes[first.offset as usize + first.length as usize] = 1;
    assert!(matches!(Bundle::parse(&bytes).unwrap_err(), BundleError::Padding { .. }));
}

#[test]
fn every_truncation_is_an_error() {
    let bytes = sample();
    for len in 0..bytes.len() {
        assert!(Bundle::parse(&bytes[..len]).is_err(), "cut at {len}");
    }
}

#[test]
fn file_errors_name_the_file() {
    let path = "no/such/folder/model.tsda";
    let error = BundleFile::open(path).unwrap_err().to_string();
    assert!(error.contains("model.tsda"), "{error}");
    let error = BundleFile::from_bytes(path, b"text".to_vec()).unwrap_err().to_string();
    assert!(error.contains("model.tsda") && error.contains("not a .tsda"), "{error}");
    let file = BundleFile::from_bytes(path, sample()).unwrap();
    assert_eq!(file.bundle().unwrap().manifest().name, "test");
}

proptest! {
    #[test]
    fn every_flipped_byte_is_an_error(at in any::<proptest::sample::Index>(), mask in 1u8..) {
        let mut bytes = sample();
        let at = at.index(bytes.len());
        bytes[at] ^= mask;
        prop_assert!(Bundle::parse(&bytes).is_err(), "byte {}", at);
    }

    #[test]
    fn noise_behind_a_valid_header_never_panics(noise in proptest::collection::vec(any::<u8>(), 0..400)) {
        let mut bytes = header(&noise).unwrap().to_vec();
        bytes.extend_from_slice(&noise);
        prop_assert!(Bundle::parse(&bytes).is_err());
    }
}

#[test]
fn another_calibration_leaves_every_section_as_it_was() {
    let old = sample();
    let bundle = Bundle::parse(&old).unwrap();
    let sections: Vec<_> = bundle.sections().collect();
    assert_eq!(sections.len(), SECTIONS.len());
    for calibration in [None, Some(ScoreCalibration { slope: 9.0, bias: -5.5 })] {
        let manifest = Manifest { calibration, ..bundle.manifest().clone() };
        let new = encode(&manifest, &sections).unwrap();
        let new = Bundle::parse(&new).unwrap();
        assert_eq!(new.manifest().calibration, calibration);
        assert_eq!(new.sections().collect::<Vec<_>>(), sections);
    }
    let upside_down = Some(ScoreCalibration { slope: -1.0, bias: 0.0 });
    let manifest = Manifest { calibration: upside_down, ..bundle.manifest().clone() };
    let error = encode(&manifest, &sections).unwrap_err().to_string();
    assert!(error.contains("calibration.slope"), "{error}");
}

fn precision<'a>() -> Precision<'a> {
    Precision {
        numbers: Numbers::Int8,
        layers: 40,
        kept: 3,
        data: "pairs, train",
        frames: 100,
        from_crc: 7,
        losses: heapless::Vec::from_slice(&[Loss { name: "SR0.5", before: 0.6, after: 0.59 }])
            .unwrap(),
    }
}

#[test]
fn precision_and_motion_stand_behind_the_manifest() {
    let narrow = Manifest { precision: Some(precision()), ..manifest() };
    let bytes = encode(&narrow, &SECTIONS).unwrap();
    assert_eq!(bytes[8], 2, "older programs must not take it for a network of floats");
    let bundle = Bundle::parse(&bytes).unwrap();
    assert_eq!(bundle.manifest().precision, Some(precision()));
    assert_eq!(bundle.section(SectionKind::Weights), Some(&[9; 200][..]));
    assert!(bundle.manifest().probe_tolerance() > manifest().probe_tolerance());
    // Every cut and every changed byte of header and manifest is noticed.
    let end = bundle.manifest().sections[0].offset as usize;
    for at in 0..end {
        let mut other = bytes.clone();
        other[at] ^= 1;
        assert!(Bundle::parse(&other).is_err(), "byte {at}");
        assert!(Bundle::parse(&bytes[..at]).is_err(), "cut at {at}");
    }
    let motion = Some(MotionPrior { window: 0.3, size_rate: 0.5 });
    for precision in [None, Some(precision())] {
        let bytes = encode(&Manifest { precision, motion, ..manifest() }, &SECTIONS).unwrap();
        assert_eq!(bytes[8], 2);
        assert_eq!(Bundle::parse(&bytes).unwrap().manifest().motion, motion);
    }
    let wide = Some(MotionPrior { window: 2.0, size_rate: 0.5 });
    let error = encode(&Manifest { motion: wide, ..manifest() }, &SECTIONS).unwrap_err();
    assert!(error.to_string().contains("motion.window"), "{error}");
    // Bundles without one stay what older programs read.
    let plain = encode(&manifest(), &SECTIONS).unwrap();
    assert_eq!(plain[8], 1);
    assert_eq!(Bundle::parse(&plain).unwrap().manifest().precision, None);
}
