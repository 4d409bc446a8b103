//! Opens what `[output]` and `[process]` name.

use super::config::HostConfig;
use super::control::Commands;
use super::http::Access;
use super::json::JsonLines;
use super::mavlink::Mavlink;
use super::mcap::Recorder;
use super::metrics::{Metrics, MetricsOutput};
use super::notify::Notify;
use super::output::{Output, SourceInfo};
use super::preview::Preview;
use super::sys;
use super::zones::Zones;
use crate::error::HostError;
use std::io::Write as _;
use std::sync::Arc;
use std::time::Duration;

/// Opens all outputs. `commands` is for those that also take commands, `zones` for the figures.
///
/// # Errors
/// Names the key, address or file that cannot be used.
pub fn open(
    config: &HostConfig,
    sources: &[SourceInfo],
    commands: &Commands,
    zones: Option<&Arc<Zones>>,
) -> Result<Vec<Box<dyn Output>>, HostError> {
    let given = &config.output;
    let mut outputs: Vec<Box<dyn Output>> = vec![Box::new(JsonLines::log(sources.to_vec())?)];
    for json in &given.json {
        outputs.push(Box::new(JsonLines::open(json, sources.to_vec())?));
    }
    if let Some(notify) = Notify::from_env()? {
        outputs.push(Box::new(notify));
    }
    let metrics =
        given.metrics.as_ref().map(|_| Arc::new(Metrics::new(sources, zones.map(Arc::clone))));
    if let Some(preview) = &given.preview {
        let file = preview.token_file.as_ref().map(|p| config.path(p));
        let token = preview.token.as_deref();
        let access = Access::new("output.preview", &preview.bind, token, file.as_deref())?;
        let shared = metrics.clone();
        let (sources, commands) = (sources.to_vec(), commands.clone());
        outputs.push(Box::new(Preview::open(preview, access, sources, commands, shared)?));
    }
    if let Some(mavlink) = &given.mavlink {
        let output = Mavlink::open(mavlink, sources.to_vec(), commands.clone())?;
        outputs.push(Box::new(output));
    }
    if let Some(mcap) = &given.mcap {
        outputs.push(Box::new(Recorder::open(mcap, config.path(&mcap.dir), sources.to_vec())?));
    }
    if let (Some(plan), Some(metrics)) = (&given.metrics, metrics) {
        let access = match &plan.bind {
            Some(bind) => {
                let file = plan.token_file.as_ref().map(|p| config.path(p));
                let token = plan.token.as_deref();
                Some(Access::new("output.metrics", bind, token, file.as_deref())?)
            }
            None if plan.token.is_some() || plan.token_file.is_some() => {
                return Err(HostError::Argument {
                    what: "output.metrics.token".into(),
                    reason: "belongs to a bind of its own; the preview has its token".into(),
                });
            }
            None if given.preview.is_some() => None,
            None => {
                return Err(HostError::Argument {
                    what: "output.metrics.bind".into(),
                    reason: "has to be given where there is no preview whose address is used"
                        .into(),
                });
            }
        };
        metrics.watch(outputs.iter().map(|o| (o.name().to_owned(), o.losses().clone())).collect());
        outputs.push(Box::new(MetricsOutput::open(metrics, access)?));
    }
    Ok(outputs)
}

/// Opens the thermal zones, where they are asked for.
///
/// # Errors
/// See [`Zones::open`].
pub fn zones(config: &HostConfig) -> Result<Option<Arc<Zones>>, HostError> {
    let Some(plan) = &config.process.temperature else { return Ok(None) };
    let zones = Arc::new(Zones::open(plan, &config.path(&plan.path))?);
    zones.follow(Duration::from_secs_f64(plan.every_s))?;
    Ok(Some(zones))
}

/// Memory and priority for the calling thread, which is to run the loop. What is not permitted is
/// said on standard error; the run goes on without.
///
/// # Errors
/// When the priority is out of range.
pub fn prepare(config: &HostConfig) -> Result<(), HostError> {
    let process = &config.process;
    let warn = |what: &str, error: std::io::Error, hint: &str| {
        let _ = writeln!(std::io::stderr(), "tsda: warning: {what} failed: {error}; {hint}");
    };
    if let Some(priority) = process.sched_fifo {
        if !(1..=99).contains(&priority) {
            return Err(HostError::Argument {
                what: "process.sched_fifo".into(),
                reason: format!("{priority} is not between 1 and 99"),
            });
        }
        if let Err(e) = sys::real_time(priority) {
            warn("sched_fifo", e, "LimitRTPRIO or CAP_SYS_NICE is needed (docs/deploy)");
        }
    }
    if process.mlockall
        && let Err(e) = sys::lock_memory()
    {
        warn("mlockall", e, "LimitMEMLOCK=infinity or CAP_IPC_LOCK is needed (docs/deploy)");
    }
    Ok(())
}
