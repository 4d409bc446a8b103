//! The tracker on the board: frames in, boxes and pictures out.
//!
//! The pieces of the program `tsda`, in the order a frame meets them:
//! 1. [`frames`]: folders, lists that mix sensors, Y4M on a pipe; [`sequence`]: clips with known
//!    boxes; [`render`]: the clip the project draws itself.
//! 2. [`model`]: the embedded bundle or one from a file, and the tracker built from it on the
//!    engine of [`engine`]'s arguments; [`redetect`]: whether a lost target's frame is scanned.
//! 3. [`track`]: drives a tracker on any engine through a source into outputs.
//! 4. [`video`]: GIF, page, PNG files, strip; [`metrics`]: figures against known boxes.
//!    [`bench`]: what a frame costs.
//! 5. [`replay`]: scripted runs, to check the tracker frame by frame.
//! 6. [`trax`]: sessions with the VOT toolkit.
//! 7. [`host`]: the program on a board (`tsda run`); [`switch`]: when and how sensors are changed;
//!    [`thermal`]: thermal cameras; `camera` (feature `camera`): V4L2.
//! 8. [`cli`]: the commands; [`error`]: one error type with its exit codes; [`output`]: files that
//!    appear whole or not at all.

pub mod bench;
#[cfg(feature = "camera")]
pub mod camera;
pub mod cli;
pub mod engine;
pub mod error;
pub mod frames;
pub mod host;
pub mod metrics;
pub mod model;
pub mod output;
pub mod picture;
pub mod redetect;
pub mod render;
pub mod replay;
pub mod sequence;
pub mod switch;
pub mod thermal;
pub mod track;
pub mod trax;
pub mod video;
