use super::*;
use proptest::prelude::*;

/// A sequence with chosen truth; pictures carry frame number and sensor in their first pixel.
struct Made {
    rgb: Vec<Option<BBox>>,
    thermal: Vec<Option<BBox>>,
    modalities: Vec<Modality>,
}

impl Sequence for Made {
    fn id(&self) -> &str {
        "made"
    }
    fn frames(&self) -> usize {
        self.rgb.len()
    }
    fn modalities(&self) -> &[Modality] {
        &self.modalities
    }
    fn targets(&self) -> usize {
        1
    }
    fn truth(&self, _: usize, frame: usize, modality: Modality) -> Option<BBox> {
        match modality {
            Modality::Rgb => self.rgb[frame],
            Modality::Thermal => self.thermal[frame],
        }
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        let data = vec![frame as u8 + 100 * modality as u8];
        Ok(Picture { width: 1, height: 1, channels: 1, data })
    }
}

/// Notes what it is shown; fails on the picture `fail_on`.
#[derive(Default)]
struct Recorder {
    shown: Vec<(u8, Modality, Option<BBox>)>,
    fail_on: Option<u8>,
}

impl TrackerUnderTest for Recorder {
    fn name(&self) -> &str {
        "recorder"
    }
    fn init(&mut self, p: &Picture, b: BBox, m: Modality) -> Result<(), TrackerError> {
        self.shown.push((p.data[0], m, Some(b)));
        Ok(())
    }
    fn update(&mut self, p: &Picture, m: Modality) -> Result<(BBox, f32), TrackerError> {
        if self.fail_on == Some(p.data[0]) {
            return Err(TrackerError::new("no more"));
        }
        self.shown.push((p.data[0], m, None));
        Ok((BBox::new(0.0, 0.0, 1.0, 1.0), 0.5))
    }
}

#[test]
fn every_protocol_shows_its_sensors_and_reads_its_own_name() {
    for (text, pattern) in [
        ("rgb2t", "RTTTTTTT"),
        ("t2rgb", "TRRRRRRR"),
        ("switch:1", "RTRTRTRT"),
        ("switch:3", "RTTTRRRT"),
        ("rgb", "RRRRRRRR"),
        ("t", "TTTTTTTT"),
    ] {
        let protocol: Protocol = text.parse().unwrap();
        assert_eq!(protocol.to_string(), text);
        let got: String =
            (0..8).map(|i| if protocol.modality(i) == Modality::Rgb { 'R' } else { 'T' }).collect();
        assert_eq!(got, pattern, "{text}");
        for i in 0..8 {
            assert!(protocol.needs().contains(&protocol.modality(i)));
        }
    }
    assert_eq!("switch".parse(), Ok(Protocol::Switch { every: 200 }));
    for text in ["", "RGB2T", "switch:", "switch200", "switch:0", "switch:-1", "switch:x", "t2t"] {
        assert_eq!(text.parse::<Protocol>(), Err(UnknownProtocol(text.into())));
    }
}

proptest! {
    #[test]
    fn switches_come_every_n_frames(every in 1usize..30, i in 1usize..300) {
        let p = Protocol::Switch { every };
        let changed = p.modality(i) != p.modality(i + 1);
        prop_assert_eq!(changed, i % every == 0);
    }
}

fn made(n: usize) -> Made {
    let b = |x: usize| Some(BBox::new(x as f32, 0.0, 5.0, 5.0));
    Made {
        rgb: (0..n).map(b).collect(),
        thermal: (0..n).map(|i| b(i + 50)).collect(),
        modalities: vec![Modality::Rgb, Modality::Thermal],
    }
}

#[test]
fn runs_start_at_the_first_annotated_frame_of_the_first_sensor() {
    let mut seq = made(6);
    seq.rgb[0] = None;
    seq.rgb[1] = None;
    seq.thermal[4] = None;
    let mut recorder = Recorder::default();
    let r = run(&seq, 0, Protocol::RgbToThermal, &mut recorder).unwrap();
    assert_eq!((r.start, r.predicted.len(), r.label().as_str()), (2, 4, "made"));
    // Truth follows the sensor that is active.
    assert_eq!(r.truth[0], seq.rgb[2]);
    assert_eq!(r.truth[1..], seq.thermal[3..]);
    assert_eq!(r.predicted[0], seq.rgb[2].unwrap());
    assert_eq!(
        recorder.shown,
        [
            (2, Modality::Rgb, seq.rgb[2]),
            (103, Modality::Thermal, None),
            (104, Modality::Thermal, None),
            (105, Modality::Thermal, None)
        ]
    );
    assert_eq!(r.scores(FirstFrame::Excluded).unwrap().frames, 2);
    assert_eq!(run(&seq, 0, Protocol::Thermal, &mut recorder).unwrap().start, 0);
}

#[test]
fn what_keeps_a_run_from_finishing_is_named() {
    let mut only_rgb = made(3);
    only_rgb.modalities.pop();
    let e = run(&only_rgb, 0, Protocol::Switch { every: 2 }, &mut Recorder::default());
    assert!(matches!(e, Err(EvalError::MissingSensor { modality: Modality::Thermal, .. })));
    assert!(run(&only_rgb, 0, Protocol::Rgb, &mut Recorder::default()).is_ok());

    let mut absent = made(3);
    absent.thermal = vec![None; 3];
    let e = run(&absent, 0, Protocol::ThermalToRgb, &mut Recorder::default()).unwrap_err();
    assert_eq!(e.to_string(), "sequence made, target 0: no thermal box to start from");

    let mut failing = Recorder { fail_on: Some(102), ..Recorder::default() };
    let e = run(&made(4), 0, Protocol::RgbToThermal, &mut failing).unwrap_err();
    assert_eq!(e.to_string(), "recorder on sequence made, frame 2: no more");
}
