//! What is known of the target before its frame is looked at: it has hardly moved since the last one,
//! and it is about as large.
//!
//! The reference tracker knows nothing of it: every cell of the map is as good as any other, and a
//! box is taken as it comes (spec 3.5). A network that was trained on little cannot tell the target
//! from its neighbour by looks alone, so small models may bring a prior with them. Without one, and
//! always in the `tomp*` presets, the arithmetic is the reference's.

use super::Target;
use crate::geometry::{BBox, Yx};
use crate::spec::SpecError;
use serde::{Deserialize, Serialize};

/// How much the last frame says about the next one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionPrior {
    /// Share of a score that depends on the distance from where the target was, in `[0, 1)`: scores
    /// are multiplied by `1 - window + window * h`, where `h`, a raised cosine in both directions,
    /// is 1 there and 0 half a map away. Fades with every frame the target is missing. 0 is off.
    pub window: f32,
    /// Share of a change of size that is taken over at once, in `(0, 1]`. All of it in the frame
    /// that finds a missing target. 1 is off.
    pub size_rate: f32,
}

impl MotionPrior {
    /// Checks both figures.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<(), SpecError> {
        if !(0.0..1.0).contains(&self.window) {
            let (field, want) = ("motion.window", "at least 0 and below 1");
            return Err(SpecError { field, value: self.window, want });
        }
        if !(self.size_rate > 0.0 && self.size_rate <= 1.0) {
            let (field, want) = ("motion.size_rate", "above 0 and at most 1");
            return Err(SpecError { field, value: self.size_rate, want });
        }
        Ok(())
    }

    /// Neither figure has an effect.
    pub const OFF: Self = Self { window: 0.0, size_rate: 1.0 };

    /// Factor of a cell's score; `previous` is the target's offset from the middle of the map
    /// `(side, side)` in cells before this frame.
    pub(super) fn weight(
        &self,
        target: &Target,
        side: usize,
        previous: Yx,
    ) -> impl Fn(usize, usize) -> f32 + Copy + use<> {
        // Every frame without the target is one more it may have moved in.
        let window = self.window / (1.0 + target.missing() as f32);
        let half = side as f32 * 0.5;
        let middle = (side as f32 - 1.0) * 0.5;
        let near = move |cell: usize, previous: f32| {
            let away = ((cell as f32 - middle - previous) / half).clamp(-1.0, 1.0);
            0.5 + 0.5 * libm::cosf(core::f32::consts::PI * away)
        };
        move |row, col| {
            if window == 0.0 {
                return 1.0;
            }
            1.0 - window + window * near(row, previous.y) * near(col, previous.x)
        }
    }

    /// A found box with its size damped; its centre stays.
    pub(super) fn damp(&self, target: &Target, found: &BBox) -> BBox {
        if target.missing() > 0 || self.size_rate >= 1.0 {
            return *found;
        }
        let size = target.size();
        let w = size.x + self.size_rate * (found.w - size.x);
        let h = size.y + self.size_rate * (found.h - size.y);
        BBox::new(found.x + (found.w - w) * 0.5, found.y + (found.h - h) * 0.5, w, h)
    }
}

/// `WINDOW,SIZE_RATE`, for example `0.3,1`.
impl core::str::FromStr for MotionPrior {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wanted = "two numbers are wanted, WINDOW,SIZE_RATE, for example 0.3,1";
        let (window, size_rate) = text.split_once(',').ok_or(wanted)?;
        let number = |text: &str| text.trim().parse::<f32>().map_err(|_| wanted);
        let prior = Self { window: number(window)?, size_rate: number(size_rate)? };
        prior.validate().map_err(|e| e.want)?;
        Ok(prior)
    }
}

impl core::fmt::Display for MotionPrior {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{},{}", self.window, self.size_rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::ModelSpec;

    const PRIOR: MotionPrior = MotionPrior { window: 0.4, size_rate: 0.25 };

    fn target() -> Target {
        Target::new(&BBox::new(10.0, 20.0, 40.0, 20.0), &ModelSpec::NANO)
    }

    #[test]
    fn weights_fall_from_where_the_target_was_and_fade_with_missing_frames() {
        let mut target = target();
        let weight = PRIOR.weight(&target, 10, Yx::new(0.5, -1.5));
        assert!((weight(5, 3) - 1.0).abs() < 1e-6, "middle (4.5, 4.5) plus the offset");
        assert!(weight(5, 4) < 1.0 && weight(5, 5) < weight(5, 4) && weight(6, 3) < 1.0);
        for row in 0..10 {
            for col in 0..10 {
                assert!((0.6 - 1e-6..=1.0 + 1e-6).contains(&weight(row, col)), "{row} {col}");
            }
        }
        assert!((weight(9, 9) - 0.6).abs() < 0.05, "half a map away: {}", weight(9, 9));
        target.miss();
        target.step(crate::localise::Flag::NotFound, 0.0, &crate::spec::TrackerParams::default());
        let later = PRIOR.weight(&target, 10, Yx::new(0.5, -1.5));
        assert!(later(9, 9) > weight(9, 9) + 0.1);
        assert_eq!(MotionPrior::OFF.weight(&target, 10, Yx::default())(0, 0), 1.0);
    }

    #[test]
    fn sizes_follow_slowly_and_centres_at_once() {
        let mut target = target();
        let found = BBox::new(30.0, 40.0, 80.0, 40.0);
        assert_eq!(PRIOR.damp(&target, &found), BBox::new(45.0, 47.5, 50.0, 25.0));
        target.step(crate::localise::Flag::NotFound, 0.0, &crate::spec::TrackerParams::default());
        assert_eq!(PRIOR.damp(&target, &found), found, "found again: taken as it is");
    }

    #[test]
    fn figures_out_of_range_are_named() {
        let cases = [(1.0, 0.5, "motion.window"), (-0.1, 0.5, "motion.window")];
        let sizes = [(0.3, 0.0, "motion.size_rate"), (0.3, 1.1, "motion.size_rate")];
        let nan = [(f32::NAN, 0.5, "motion.window"), (0.3, f32::NAN, "motion.size_rate")];
        for (window, size_rate, field) in cases.into_iter().chain(sizes).chain(nan) {
            assert_eq!(MotionPrior { window, size_rate }.validate().unwrap_err().field, field);
        }
        PRIOR.validate().unwrap();
    }

    #[test]
    fn it_is_written_and_read_as_two_numbers() {
        use std::string::ToString as _;
        assert_eq!(PRIOR.to_string(), "0.4,0.25");
        assert_eq!(" 0.4, 0.25 ".parse(), Ok(PRIOR));
        for text in ["", "0.4", "0.4;1", "a,b", "1,1", "0.3,0", "0.3,1,2"] {
            assert!(text.parse::<MotionPrior>().is_err(), "{text}");
        }
    }
}
