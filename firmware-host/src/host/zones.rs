//! How warm the machine is: its thermal zones, read on a thread of their own, and frames left out
//! while it is too warm.

use super::config::TemperatureConfig;
use crate::error::HostError;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::thread;
use std::time::Duration;

/// A zone that cannot be read.
const UNKNOWN: i32 = i32::MIN;

#[derive(Debug)]
struct Zone {
    name: String,
    file: PathBuf,
    /// Thousandths of a degree.
    milli: AtomicI32,
}

/// The zones with their latest readings.
#[derive(Debug)]
pub struct Zones {
    zones: Vec<Zone>,
    limit: Option<(f32, f32)>,
    slow: Duration,
    hot: AtomicBool,
}

impl Zones {
    /// Finds the zones and reads them.
    ///
    /// # Errors
    /// When a key makes no sense, or there is no zone though a limit is set.
    pub fn open(config: &TemperatureConfig, path: &Path) -> Result<Self, HostError> {
        let refuse = |key: &str, reason: String| HostError::Argument {
            what: format!("process.temperature.{key}"),
            reason,
        };
        if !(0.05..=3600.0).contains(&config.every_s) {
            return Err(refuse(
                "every_s",
                format!("{} is not 0.05 to 3600 seconds", config.every_s),
            ));
        }
        if !(0.1..=10_000.0).contains(&config.rate) {
            return Err(refuse("rate", format!("{} frames per second", config.rate)));
        }
        if config.limit.is_some_and(|l| !l.is_finite())
            || !(0.0..100.0).contains(&config.hysteresis)
        {
            return Err(refuse("limit", "limit and hysteresis are degrees Celsius".into()));
        }
        let mut zones = Vec::new();
        let mut folders: Vec<PathBuf> = fs::read_dir(path)
            .into_iter()
            .flatten()
            .filter_map(|e| Some(e.ok()?.path()))
            .filter(|p| {
                p.file_name().is_some_and(|n| n.to_string_lossy().starts_with("thermal_zone"))
            })
            .collect();
        folders.sort();
        for folder in folders {
            let name = folder.file_name().map(|n| n.to_string_lossy().into_owned());
            let kind = fs::read_to_string(folder.join("type")).unwrap_or_default();
            let name = format!("{} {}", name.unwrap_or_default(), kind.trim());
            let file = folder.join("temp");
            zones.push(Zone { name: name.trim().into(), file, milli: AtomicI32::new(UNKNOWN) });
        }
        if zones.is_empty() && config.limit.is_some() {
            let reason = format!("{} has no thermal_zone, so no limit can be kept", path.display());
            return Err(refuse("path", reason));
        }
        let found = Self {
            zones,
            limit: config.limit.map(|l| (l, l - config.hysteresis)),
            slow: Duration::from_secs_f64(1.0 / config.rate),
            hot: AtomicBool::new(false),
        };
        found.read();
        Ok(found)
    }

    /// Reads all zones.
    pub fn read(&self) {
        let mut warmest = None;
        for zone in &self.zones {
            // Zones of switched-off parts answer with an error.
            let milli = fs::read_to_string(&zone.file).ok().and_then(|t| t.trim().parse().ok());
            zone.milli.store(milli.unwrap_or(UNKNOWN), Ordering::Relaxed);
            warmest = warmest.max(milli);
        }
        if let (Some((above, below)), Some(milli)) = (self.limit, warmest) {
            let celsius = milli as f32 / 1e3;
            if celsius > above {
                self.hot.store(true, Ordering::Relaxed);
            } else if celsius < below {
                self.hot.store(false, Ordering::Relaxed);
            }
        }
    }

    /// Reads them from time to time, for as long as somebody else holds them.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn follow(self: &Arc<Self>, every: Duration) -> Result<(), HostError> {
        let zones = Arc::downgrade(self);
        let work = move || loop {
            thread::sleep(every);
            match zones.upgrade() {
                Some(zones) => zones.read(),
                None => return,
            }
        };
        let started = thread::Builder::new().name("tsda-zones".into()).spawn(work);
        started.map(drop).map_err(|source| HostError::Create { path: "tsda-zones".into(), source })
    }

    /// Name and degrees Celsius of every zone that can be read.
    pub fn readings(&self) -> impl Iterator<Item = (&str, f32)> {
        self.zones.iter().filter_map(|z| {
            let milli = z.milli.load(Ordering::Relaxed);
            (milli != UNKNOWN).then(|| (z.name.as_str(), milli as f32 / 1e3))
        })
    }

    /// The warmest zone, in degrees Celsius.
    pub fn warmest(&self) -> Option<f32> {
        self.readings().map(|r| r.1).reduce(f32::max)
    }

    /// Whether it is too warm.
    pub fn hot(&self) -> bool {
        self.hot.load(Ordering::Relaxed)
    }

    /// Least time between two tracked frames, while it is too warm.
    pub fn pause(&self) -> Option<Duration> {
        self.hot().then_some(self.slow)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_left_out_between_two_limits() {
        let dir = tempfile::tempdir().expect("temp");
        let set = |zone: u32, milli: &str| {
            let folder = dir.path().join(format!("thermal_zone{zone}"));
            fs::create_dir_all(&folder).expect("folder");
            fs::write(folder.join("type"), "cpu-thermal\n").expect("type");
            fs::write(folder.join("temp"), milli).expect("temp");
        };
        fs::create_dir(dir.path().join("cooling_device0")).expect("folder");
        set(0, "41000\n");
        set(1, "not now");
        let config =
            TemperatureConfig { limit: Some(80.0), rate: 4.0, ..TemperatureConfig::default() };
        let zones = Zones::open(&config, dir.path()).expect("zones");
        assert_eq!(zones.readings().collect::<Vec<_>>(), [("thermal_zone0 cpu-thermal", 41.0)]);
        for (milli, hot) in
            [("79900", false), ("80500", true), ("78000", true), ("x", true), ("74900", false)]
        {
            set(0, milli);
            zones.read();
            assert_eq!(zones.hot(), hot, "{milli}");
        }
        set(1, "90000");
        zones.read();
        assert_eq!(zones.pause(), Some(Duration::from_millis(250)), "the warmest counts");
    }

    #[test]
    fn a_limit_needs_a_zone() {
        let dir = tempfile::tempdir().expect("temp");
        let mut config = TemperatureConfig::default();
        assert_eq!(Zones::open(&config, dir.path()).expect("only reported").warmest(), None);
        config.limit = Some(80.0);
        let error = Zones::open(&config, dir.path()).expect_err("no zone").to_string();
        assert!(error.contains("process.temperature.path"), "{error}");
        config.rate = 0.0;
        assert!(Zones::open(&config, dir.path()).is_err());
    }
}
