use super::*;
use crate::picture::Picture;

fn drawn(clip: &Clip, frame: usize, modality: Modality) -> Picture {
    let mut out = Picture::default();
    clip.render(frame, modality, &mut out);
    out
}

fn mean(p: &Picture) -> f32 {
    p.data.iter().map(|v| f32::from(*v)).sum::<f32>() / p.data.len() as f32
}

/// Mean of the first channel over a box.
fn mean_in(p: &Picture, b: BBox) -> f32 {
    let (mut sum, mut n) = (0.0, 0.0f32);
    for y in b.y.max(0.0) as usize..(b.bottom() as usize).min(p.height) {
        for x in b.x.max(0.0) as usize..(b.right() as usize).min(p.width) {
            sum += f32::from(p.data[(y * p.width + x) * p.channels]);
            n += 1.0;
        }
    }
    sum / n.max(1.0)
}

#[test]
fn the_same_seed_draws_the_same_bytes() {
    let clip = Clip::new(ClipConfig::default());
    for modality in [Modality::Rgb, Modality::Thermal] {
        let a = drawn(&clip, 40, modality);
        assert_eq!(a, drawn(&Clip::new(ClipConfig::default()), 40, modality));
        let other = Clip::new(ClipConfig { seed: 8, ..ClipConfig::default() });
        assert_ne!(a, drawn(&other, 40, modality));
    }
}

#[test]
fn the_target_stays_inside_and_grows() {
    let clip = Clip::new(ClipConfig::default());
    for i in 0..clip.frames() {
        let b = clip.truth(i);
        assert!(b.x > 2.0 && b.y > 2.0 && b.right() < 318.0 && b.bottom() < 238.0, "{i}: {b:?}");
    }
    let (first, last) = (clip.truth(0), clip.truth(clip.frames() - 1));
    assert!(last.h > first.h * 1.15 && last.x > first.x + 60.0, "{first:?} {last:?}");
}

#[test]
fn a_person_is_warm_and_the_night_is_dark() {
    let clip = Clip::new(ClipConfig::default());
    let (dusk, night) = (drawn(&clip, 0, Modality::Rgb), drawn(&clip, 50, Modality::Rgb));
    assert!(mean(&dusk) > 2.0 * mean(&night), "{} {}", mean(&dusk), mean(&night));
    for frame in [0, 48, 95] {
        let heat = drawn(&clip, frame, Modality::Thermal);
        let body = clip.truth(frame);
        let core = BBox::new(body.x + body.w * 0.35, body.y, body.w * 0.3, body.h * 0.6);
        assert!(mean_in(&heat, core) > mean(&heat) + 40.0, "frame {frame}");
    }
}

/// The analytic box against the pixels: draw with and without the target and compare.
#[test]
fn truth_is_the_tight_box_of_what_is_drawn() {
    let clip = Clip::new(ClipConfig::default());
    let mut without = clip.clone();
    without.target.start.0 += 500.0;
    for frame in [0, 20, 95] {
        let (a, b) =
            (drawn(&clip, frame, Modality::Thermal), drawn(&without, frame, Modality::Thermal));
        let (mut lo, mut hi) = ((usize::MAX, usize::MAX), (0, 0));
        for y in 0..a.height {
            for x in 0..a.width {
                if a.data[y * a.width + x].abs_diff(b.data[y * a.width + x]) > 8 {
                    lo = (lo.0.min(x), lo.1.min(y));
                    hi = (hi.0.max(x + 1), hi.1.max(y + 1));
                }
            }
        }
        let seen = BBox::new(lo.0 as f32, lo.1 as f32, (hi.0 - lo.0) as f32, (hi.1 - lo.1) as f32);
        let iou = seen.iou(&clip.truth(frame));
        assert!(iou > 0.85, "frame {frame}: drawn {seen:?}, truth {:?}", clip.truth(frame));
    }
}
