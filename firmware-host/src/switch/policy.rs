//! When to change sensors: by command, on failure, by the clock, by what the pictures look like.

use super::{Condition, Watch};
use std::time::Duration;

/// Why a sensor was changed.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Reason {
    /// Somebody asked for it.
    Command,
    /// The active sensor cannot be used.
    Failure(Condition),
    /// The preferred sensor can be used again.
    Recovered,
    /// The plan says so.
    Schedule,
    /// The watched sensor's figure crossed its limit.
    Scene {
        /// The figure, in `[0, 1]`.
        value: f32,
    },
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Command => f.write_str("command"),
            Self::Failure(c) => write!(f, "failure: {c}"),
            Self::Recovered => f.write_str("recovered"),
            Self::Schedule => f.write_str("schedule"),
            Self::Scene { value } => write!(f, "scene: {value:.3}"),
        }
    }
}

/// Which figure of the scene decides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SceneMeasure {
    /// Mean level.
    #[default]
    Brightness,
    /// Standard deviation of the level.
    Contrast,
}

/// Changing by what a sensor sees, with hysteresis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePlan {
    /// Sensor whose pictures decide; used while they are good.
    pub watch: usize,
    /// Sensor to use otherwise.
    pub otherwise: usize,
    /// The figure.
    pub measure: SceneMeasure,
    /// Below this the other is used.
    pub below: f32,
    /// Above this the watched one is used again.
    pub above: f32,
    /// How long the figure has to stay there.
    pub hold: Duration,
}

/// Changing when a sensor fails.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FailurePlan {
    /// How long without a usable picture before another sensor is used. An unplugged camera is not
    /// waited for.
    pub after: Duration,
    /// How long the preferred sensor has to be good again before it is used again; `None`: stay.
    pub return_after: Option<Duration>,
}

/// All there is to decide by. Failure comes first, then the schedule, then the scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SwitchPlan {
    /// Sensor to begin with, and to come back to.
    pub preferred: usize,
    /// On failure.
    pub failure: Option<FailurePlan>,
    /// Time of the run and sensor, in the order of time.
    pub schedule: Vec<(Duration, usize)>,
    /// The next sensor in turn, every so often.
    pub every: Option<Duration>,
    /// By what is seen.
    pub scene: Option<ScenePlan>,
}

/// The health of all sensors, wherever they live.
struct Watches<'f, 'w> {
    sensors: usize,
    get: &'f dyn Fn(usize) -> &'w Watch,
}

impl<'w> Watches<'_, 'w> {
    fn get(&self, sensor: usize) -> Option<&'w Watch> {
        (sensor < self.sensors).then(|| (self.get)(sensor))
    }
}

/// The plan and where it stands.
#[derive(Clone, Debug)]
pub struct Policy {
    plan: SwitchPlan,
    /// Off after a command chose a sensor, until told to decide again.
    automatic: bool,
    next: usize,
    turns: u32,
    /// Since when the figure is beyond the limit that matters now.
    beyond: Option<Duration>,
    /// Since when the preferred sensor is good while a failure keeps another one active.
    back: Option<Duration>,
    failed_over: bool,
}

impl Policy {
    /// At the beginning of a run.
    pub fn new(plan: SwitchPlan) -> Self {
        Self {
            plan,
            automatic: true,
            next: 0,
            turns: 0,
            beyond: None,
            back: None,
            failed_over: false,
        }
    }

    /// Whether the plan decides; off, only commands and failures do.
    pub fn set_automatic(&mut self, on: bool) {
        (self.automatic, self.failed_over) = (on, false);
        (self.beyond, self.back) = (None, None);
    }

    /// Another sensor to use from now on, and why. `watches(i)` is the health of sensor `i` of
    /// `sensors`.
    pub fn decide<'w>(
        &mut self,
        now: Duration,
        active: usize,
        sensors: usize,
        watches: impl Fn(usize) -> &'w Watch,
    ) -> Option<(usize, Reason)> {
        let watches = Watches { sensors, get: &watches };
        // Read even when a failure comes first, so that no entry takes effect long after its time.
        let planned = self.scheduled(now, active, sensors);
        if let Some(change) = self.failure(now, active, &watches) {
            return Some(change);
        }
        if !self.automatic || self.failed_over {
            return None;
        }
        let usable = |to: usize| {
            to != active && watches.get(to).is_some_and(|w| w.condition(now) == Condition::Good)
        };
        if let Some(to) = planned.filter(|to| usable(*to)) {
            return Some((to, Reason::Schedule));
        }
        self.scene(now, active, &watches).filter(|(to, _)| usable(*to))
    }

    fn scheduled(&mut self, now: Duration, active: usize, sensors: usize) -> Option<usize> {
        let mut to = None;
        while let Some((_, sensor)) = self.plan.schedule.get(self.next).filter(|(at, _)| now >= *at)
        {
            to = Some(*sensor);
            self.next += 1;
        }
        if let Some(every) = self.plan.every
            && now >= every.saturating_mul(self.turns + 1)
        {
            self.turns += 1;
            to = Some((active + 1) % sensors.max(1));
        }
        to
    }

    fn failure(
        &mut self,
        now: Duration,
        active: usize,
        watches: &Watches<'_, '_>,
    ) -> Option<(usize, Reason)> {
        let FailurePlan { after, return_after } = self.plan.failure?;
        let good = |i: usize| watches.get(i).is_some_and(|w| w.condition(now) == Condition::Good);
        let condition = watches.get(active)?.condition(now);
        if condition != Condition::Good {
            let bad_for = watches.get(active)?.bad_for(now);
            if bad_for < after && condition != Condition::Gone {
                return None;
            }
            // The preferred one, else the first that works.
            let preferred = self.plan.preferred;
            let to = std::iter::once(preferred)
                .chain(0..watches.sensors)
                .find(|i| *i != active && good(*i))?;
            self.failed_over = true;
            self.back = None;
            return Some((to, Reason::Failure(condition)));
        }
        if !self.failed_over {
            return None;
        }
        let preferred = self.plan.preferred;
        if active == preferred {
            self.failed_over = false;
            return None;
        }
        let return_after = return_after?;
        if !good(preferred) {
            self.back = None;
            return None;
        }
        let since = *self.back.get_or_insert(now);
        if now.saturating_sub(since) < return_after {
            return None;
        }
        (self.failed_over, self.back) = (false, None);
        Some((preferred, Reason::Recovered))
    }

    fn scene(
        &mut self,
        now: Duration,
        active: usize,
        watches: &Watches<'_, '_>,
    ) -> Option<(usize, Reason)> {
        let plan = self.plan.scene?;
        let watch = watches.get(plan.watch)?;
        let condition = watch.condition(now);
        // A dark picture is what this is about; a late one says nothing.
        if !matches!(condition, Condition::Good | Condition::Dark | Condition::Saturated) {
            self.beyond = None;
            return None;
        }
        let value = match plan.measure {
            SceneMeasure::Brightness => watch.scene().brightness,
            SceneMeasure::Contrast => watch.scene().contrast,
        };
        let (crossed, to) = if active == plan.watch {
            (value < plan.below, plan.otherwise)
        } else {
            (value > plan.above && condition == Condition::Good, plan.watch)
        };
        if !crossed {
            self.beyond = None;
            return None;
        }
        let since = *self.beyond.get_or_insert(now);
        if now.saturating_sub(since) < plan.hold {
            return None;
        }
        self.beyond = None;
        Some((to, Reason::Scene { value }))
    }
}
