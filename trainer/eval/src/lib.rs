//! Datasets, protocols and metrics for cross-modal tracking, without a training framework.
//!
//! * [`dataset`]: one [`dataset::Sequence`] trait over every folder layout; frames decoded lazily.
//!   The trainer's sampler reads the same loaders.
//! * [`pseudo`]: clips with exact truth out of registered stills.
//! * [`protocol`]: which sensor a frame comes from (`rgb2t`, `t2rgb`, `switch:20`, ..), and
//!   [`protocol::TrackerUnderTest`], what can be evaluated.
//! * [`evaluate()`]: a whole dataset, several sequences at a time; the same figures on any number of
//!   threads. [`evaluate_all`] keeps finished sequences in a [`store::ResultStore`], takes up those
//!   of an earlier run and goes on past failures; [`run_summary`] puts it all into files.
//! * [`metrics`]: SR@0.5, success AUC, PR@20, normalised precision, mean IoU; the same by the rules of
//!   each benchmark's toolkit; time to recover after a sensor switch.
//! * [`observe()`], [`presence()`], [`calibrate()`]: whether a tracker knows that its target is gone and
//!   finds it again; scores turned into probabilities.
//! * [`truth`], [`results`], [`attributes`], [`compare`]: results of any tracker, read from text,
//!   scored against any truth and put side by side in a [`report_data::ReportData`].
//! * [`baselines`]: a static box and template matching, what a tracker has to beat.
//! * [`summary`], [`otb`]: JSON, Markdown and OTB text.
//!
//! # Example
//! ```no_run
//! use tsda_eval::baselines::StaticBox;
//! use tsda_eval::protocol::Protocol;
//! use tsda_eval::summary::{Summary, markdown};
//! use tsda_eval::{Options, dataset, evaluate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let data = dataset::open("pseudo:data/pairs@val")?;
//! let mut runs = Vec::new();
//! for protocol in Protocol::CROSS_MODAL {
//!     runs.push(evaluate(
//!         &data,
//!         protocol,
//!         &|| Ok(Box::new(StaticBox::default())),
//!         Options { threads: 2, ..Options::default() },
//!         &|p| eprintln!("{}/{} {}: {:.2}", p.done, p.total, p.result.label(), p.scores.sr50),
//!     )?);
//! }
//! let summary = Summary::of(&runs)?;
//! summary.write_json("static-box.json".as_ref())?;
//! println!("{}", markdown(&[summary]));
//! # Ok(())
//! # }
//! ```
//! A bundle's tracker goes the same way, wrapped in a [`RuntimeTracker`].

pub mod attributes;
pub mod baselines;
pub mod boxes;
pub mod calibrate;
pub mod compare;
pub mod dataset;
pub mod distribution;
pub mod evaluate;
pub mod fingerprint;
pub mod metrics;
pub mod observe;
pub mod otb;
pub mod presence;
pub mod protocol;
pub mod pseudo;
pub mod report;
pub mod report_data;
pub mod results;
mod rng;
pub mod run_summary;
pub mod runtime;
pub mod store;
pub mod summary;
pub mod tables;
pub mod truth;

pub use calibrate::calibrate;
pub use evaluate::{Evaluation, Options, Progress, evaluate, evaluate_all};
pub use observe::observe;
pub use presence::presence;
pub use runtime::RuntimeTracker;
