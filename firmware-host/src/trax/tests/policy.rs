//! The choice between two sensors.

use super::super::policy::shows_nothing;
use super::*;
use crate::frames::Decoded;
use crate::picture::Picture;
use crate::render::{Clip, ClipConfig};
use tsda_runtime::{Modality, TrackState};

fn grey(f: impl Fn(usize) -> u8) -> Decoded {
    Decoded::Eight(Picture { width: 32, height: 32, channels: 1, data: (0..1024).map(f).collect() })
}

fn good() -> Decoded {
    grey(|i| (i * 7 % 251) as u8)
}

fn flat() -> Decoded {
    grey(|_| 128)
}

#[test]
fn words_of_the_command_line() {
    for (text, want) in [
        ("color", Some(Channels::Color)),
        ("ir", Some(Channels::Ir)),
        ("color,ir", Some(Channels::Both)),
        ("ir;color;", Some(Channels::Both)),
        ("color+ir", Some(Channels::Both)),
        ("depth", None),
        ("color,color", None),
        ("", None),
    ] {
        assert_eq!(text.parse::<Channels>().ok(), want, "{text}");
    }
    for text in ["color", "ir", "auto", "switch:1", "switch:200"] {
        assert_eq!(text.parse::<SensorPolicy>().expect(text).to_string(), text);
    }
    for text in ["", "rgb", "switch", "switch:0", "switch:-1", "switch:x"] {
        let e = text.parse::<SensorPolicy>().expect_err(text);
        assert!(e.contains("switch:N"), "{e}");
    }
}

fn picks(policy: &str, frames: usize, color: impl Fn(usize) -> Result<Decoded, u8>) -> String {
    let mut chooser = Chooser::new(policy.parse().expect("policy"));
    (0..frames)
        .map(|i| {
            let pick = chooser.pick(|c| if c == Channel::Color { color(i) } else { Ok(good()) });
            chooser.note(TrackState::Tracking);
            match pick {
                Ok((Channel::Color, _)) => 'c',
                Ok((Channel::Ir, _)) => 'i',
                Err(_) => '!',
            }
        })
        .collect()
}

#[test]
fn policies_choose() {
    assert_eq!(picks("color", 4, |_| Ok(flat())), "cccc");
    assert_eq!(picks("ir", 4, |_| Ok(good())), "iiii");
    assert_eq!(picks("switch:3", 8, |_| Ok(good())), "ccciiicc");
    assert_eq!(picks("auto", 4, |_| Ok(good())), "cccc");
    // A good sensor is kept, also when the other one recovers.
    assert_eq!(picks("auto", 6, |i| Ok(if i == 2 { flat() } else { good() })), "cciiii");
    assert_eq!(picks("auto", 3, |i| if i == 1 { Err(1) } else { Ok(good()) }), "cii");
    // Who asked for one sensor gets its error.
    assert_eq!(picks("color", 3, |i| if i == 1 { Err(1) } else { Ok(good()) }), "c!c");
}

#[test]
fn auto_takes_what_there_is() {
    let mut chooser = Chooser::new(SensorPolicy::Auto);
    let both_flat = chooser.pick(|_| Ok::<_, u8>(flat())).expect("flat");
    assert_eq!(both_flat.0, Channel::Color, "no reason to change");
    let mut chooser = Chooser::new(SensorPolicy::Auto);
    let only = chooser.pick(|c| if c == Channel::Ir { Ok(flat()) } else { Err(1u8) });
    assert_eq!(only.expect("dull").0, Channel::Ir);
    assert_eq!(chooser.pick(|_| Err::<Decoded, _>(7u8)).expect_err("none"), 7);
}

#[test]
fn auto_tries_the_other_sensor_when_the_target_stays_away() {
    let mut chooser = Chooser::new(SensorPolicy::Auto);
    let mut picked = String::new();
    for i in 0..14 {
        let (channel, _) = chooser.pick(|_| Ok::<_, u8>(good())).expect("good");
        picked.push(if channel == Channel::Ir { 'i' } else { 'c' });
        chooser.note(if i < 2 { TrackState::Tracking } else { TrackState::Searching });
    }
    assert_eq!(picked, "ccccccciiiiicc", "5 frames of patience each");
}

#[test]
fn night_is_told_from_day() {
    let clip = Clip::new(ClipConfig::default());
    let seen = |frame, modality| {
        let mut picture = Picture::default();
        clip.render(frame, modality, &mut picture);
        Decoded::Eight(picture)
    };
    // It is darkest in the middle; then the camera turns up its gain.
    let (night, last) = (clip.frames() / 2, clip.frames() - 1);
    assert!(!shows_nothing(Channel::Color, &seen(0, Modality::Rgb)));
    assert!(shows_nothing(Channel::Color, &seen(night, Modality::Rgb)), "night has fallen");
    for frame in [0, night, last] {
        assert!(!shows_nothing(Channel::Ir, &seen(frame, Modality::Thermal)), "{frame}");
    }
    // A warm spot on a cold background is a good thermal picture and a useless visible one.
    let spot = grey(|i| if i % 32 / 8 == 1 && i / 32 / 8 == 1 { 120 } else { 2 });
    assert!(!shows_nothing(Channel::Ir, &spot) && shows_nothing(Channel::Color, &spot));
    let raw = |spread: u16| {
        let data = (0..64u16).flat_map(|i| (30_000 + i * spread / 63).to_le_bytes()).collect();
        Decoded::sixteen(8, 8, data).expect("raw")
    };
    assert!(shows_nothing(Channel::Ir, &raw(4)) && !shows_nothing(Channel::Ir, &raw(600)));
}
