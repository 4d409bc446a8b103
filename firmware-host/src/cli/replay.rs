//! `tsda replay`.

use crate::error::{EXIT_CHECK_FAILED, EXIT_OK, HostError};
use crate::replay;
use clap::Args;
use std::path::PathBuf;

/// Arguments of `tsda replay`.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// Script (JSON): runs with what is expected in every frame
    #[arg(value_name = "SCRIPT.json")]
    pub script: PathBuf,
    /// Score maps and boxes of the frames [default: the script's name with .safetensors]
    #[arg(long, value_name = "FILE.safetensors")]
    pub tensors: Option<PathBuf>,
    /// Print everything found as JSON
    #[arg(long)]
    pub json: bool,
}

pub(super) fn run(args: &ReplayArgs) -> Result<u8, HostError> {
    let report = replay::replay(&args.script, args.tensors.as_deref())?;
    if args.json {
        let text = serde_json::to_string_pretty(&report)
            .map_err(|e| HostError::Encode { path: args.script.clone(), reason: e.to_string() })?;
        println!("{text}");
    } else {
        print!("{report}");
    }
    Ok(if report.passed() { EXIT_OK } else { EXIT_CHECK_FAILED })
}
