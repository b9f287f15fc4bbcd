//! Why a run failed, as messages for its user.

use super::config::ConfigError;
use crate::exact::ExactError;
use crate::exact::yardstick::YardstickError;
use crate::learn::method::TrainError;
use crate::learn::weights::WeightsError;
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
    /// A yardstick cannot be computed.
    #[error(transparent)]
    Yardstick(#[from] YardstickError),
    /// The program has no such world.
    #[error("this program has no world {0}; `cvar-game envs` lists its worlds")]
    UnknownWorld(String),
    /// The program has no such method.
    #[error("this program has no method {0}; `cvar-game config --default` lists its methods")]
    UnknownMethod(String),
    /// The constants are not those of the world.
    #[error(transparent)]
    Constants(#[from] ConfigError),
    /// The world has no yardstick.
    #[error("nothing is known about the optimum of {0}: it is not finite and has no oracle")]
    NoYardstick(String),
    /// The world's states are not finitely many.
    #[error(
        "single changes of a policy are known in finite worlds only, such as lava-grid, not in {0}"
    )]
    NotFinite(&'static str),
    /// The weights are not those of the run.
    #[error("final.safetensors does not fit the run: {0}")]
    Weights(#[from] WeightsError),
    /// The weights were not kept.
    #[error(
        "{0} is not there; `pack` keeps the weights of the first seed of each row, and `pack --weights all` those of all"
    )]
    NoWeights(String),
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// The error of the system.
        source: io::Error,
    },
    /// The output accepts no more.
    #[error("cannot write the steps: {0}")]
    Output(io::Error),
    /// There was a request to stop, or another process works on it.
    #[error("not finished yet; start it again to continue from its last checkpoint")]
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
