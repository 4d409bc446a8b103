//! Which engine a command runs the bundle on: arguments shared by the commands.

use crate::error::HostError;
use clap::Args;
use tsda_runtime::engine::EngineChoice;

/// `--engine` and `--threads` of a command that tracks.
#[derive(Clone, Debug, Default, Args)]
pub struct EngineArgs {
    /// native, tract, ort, ort:cuda or ort:tensorrt; options follow after commas, such as
    /// ort:tensorrt,fp16,cache=DIR (docs/engines.md)
    #[arg(long, value_name = "ENGINE", default_value_t)]
    pub engine: EngineChoice,
    /// Threads per operation inside the engine, 0 for one per core [default: 1]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
}

impl EngineArgs {
    /// What was chosen.
    ///
    /// # Errors
    /// When the engine cannot work on that many threads.
    pub fn choice(&self) -> Result<EngineChoice, HostError> {
        let Some(threads) = self.threads else { return Ok(self.engine.clone()) };
        self.engine.clone().with_threads(threads).map_err(|e| HostError::Argument {
            what: format!("--threads {threads}"),
            reason: e.to_string(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        engine: EngineArgs,
    }

    fn parse(args: &[&str]) -> Result<EngineArgs, clap::Error> {
        Program::try_parse_from([&["program"], args].concat()).map(|p| p.engine)
    }

    #[test]
    fn the_engine_is_read_from_the_arguments() {
        let choice = |args: &[&str]| parse(args).expect("parses").choice();
        assert_eq!(choice(&[]).expect("default"), EngineChoice::default());
        assert_eq!(choice(&["--engine", "tract"]).expect("tract").to_string(), "tract");
        assert!(choice(&["--engine", "tract", "--threads", "1"]).is_ok());
        assert_eq!(choice(&["--threads", "4"]).expect("native").to_string(), "native,threads=4");
        let error = choice(&["--engine", "tract", "--threads", "4"]);
        let error = error.expect_err("tract has one thread").to_string();
        assert!(error.contains("--threads 4") && error.contains("one thread"), "{error}");
        let error = parse(&["--engine", "abacus"]).expect_err("no such engine").to_string();
        assert!(error.contains("`abacus`") && error.contains("tract"), "{error}");
    }

    #[cfg(feature = "ort")]
    #[test]
    fn threads_go_to_the_engine() {
        let args = ["--engine", "ort:cuda,device=1", "--threads", "0"];
        let choice = parse(&args).expect("parses").choice().expect("fits");
        assert_eq!(choice.to_string(), "ort:cuda,threads=0,device=1");
    }
}
