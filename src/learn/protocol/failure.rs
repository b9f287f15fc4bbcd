//! Why a run failed, in the words that its user reads.

use crate::train::TrainError;
use crate::weights::WeightsError;
use cvar_game::exact::ExactError;
use cvar_game::exact::oracle::OracleError;
use std::io;
use std::path::Path;

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Training stopped.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The world refuses its constants.
    #[error(transparent)]
    World(#[from] lava_envs::ConfigError),
    /// A yardstick refuses the world.
    #[error(transparent)]
    Exact(#[from] ExactError),
    /// The oracle refuses the world, or cannot keep its certificate.
    #[error(transparent)]
    Oracle(#[from] OracleError),
    /// The weights are not those of the run.
    #[error("final.safetensors does not fit the run: {0}")]
    Weights(#[from] WeightsError),
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// What the system says.
        source: io::Error,
    },
    /// The output takes no more.
    #[error("cannot write the steps: {0}")]
    Output(io::Error),
    /// It was asked to stop, or another process works on it.
    #[error("not finished yet; start it again to go on from its last checkpoint")]
    Unfinished,
    /// There is no such antagonist.
    #[error("{0}")]
    NoOpponent(&'static str),
    /// The antagonist broke its budget: an error of this program.
    #[error(
        "the antagonist broke its budget: prod delta / eta reached {use_of_budget}, \
         |E[delta] - 1| reached {normalisation_error}; please report this with the run's config.toml"
    )]
    Budget {
        /// max prod delta / eta.
        use_of_budget: f64,
        /// max |`E[delta]` - 1|.
        normalisation_error: f64,
    },
}

impl RunError {
    /// An error about a file of the run.
    pub fn file(path: &Path) -> impl FnOnce(io::Error) -> RunError + '_ {
        move |source| RunError::File { path: path.display().to_string(), source }
    }
}
