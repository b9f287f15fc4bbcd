//! Exact yardsticks: the right answer on a finite world, without sampling and without networks.
//!
//! | question | file |
//! |---|---|
//! | which MDPs, and what must their state remember | [`mdp`] |
//! | what is the law of J under a policy, with or without an antagonist | [`law`], [`policy`] |
//! | what is the best attainable CVaR, V*(eta) | [`optimum`] |
//! | what is the worst antagonist of a policy | [`antagonist`] |
//! | what is the best response to an antagonist that no longer learns | [`response`] |
//! | what would the budget-augmented programme report | [`chow`] |
//! | how good can a policy without a clock be | [`stationary`] |
//! | how far is a trained policy from the optimum | [`certificate`] |
//! | what is a policy of any method to an exact solver | [`table`] |
//! | all of it in any finite world | [`finite`] |
//! | what can be attained on the point mass, where nothing is exact, and what cannot | [`oracle`] |
//! | what single changes of a policy are worth | [`changes`] |
//! | all of it for any world, by one interface | [`yardstick`] |
//! | what does an episode of the best policy look like | [`mod@walk`] |
//! | how far is a computation that takes minutes | [`mod@watch`] |
//!
//! Symbols: budget eta >= 1, risk level alpha = 1/eta, return J, threshold w, time t, state s, outcome
//! of chance o, perturbation delta_t(o). Rewards and returns are in the world's reward units.

pub mod antagonist;
pub mod certificate;
pub mod changes;
pub mod chow;
pub mod finite;
pub mod law;
pub mod mdp;
pub mod optimum;
pub mod oracle;
pub mod policy;
pub mod response;
pub mod stationary;
pub mod table;
pub mod walk;
pub mod watch;
pub mod yardstick;

/// Why a yardstick cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ExactError {
    /// The risk level is out of range.
    #[error("alpha must lie in (0, 1], got {0}")]
    Alpha(f64),
    /// The budget is out of range.
    #[error("the budget eta must be a finite number of at least 1, got {0}")]
    Eta(f64),
    /// The MDP makes no sense.
    #[error("not a valid MDP: {0}")]
    Mdp(String),
    /// The accumulated rewards, states and steps are too many.
    #[error(
        "the world is too large to be solved exactly: more than {} combinations of time, \
         accumulated reward and state",
        mdp::MAX_NODES
    )]
    TooLarge,
    /// Action probabilities that are no law.
    #[error("the action probabilities {row:?} of state {state} are no law")]
    Policy {
        /// The state.
        state: usize,
        /// What was given.
        row: Vec<f64>,
    },
    /// A table of action probabilities of the wrong shape.
    #[error("a table of {found:?} times, states and actions does not fit a world of {expected:?}")]
    Table {
        /// Times, states and actions of the table.
        found: [usize; 3],
        /// Those of the world.
        expected: [usize; 3],
    },
    /// The exact worst-case antagonist depends on the reward accumulated so far.
    #[error(
        "the exact worst-case antagonist of {0} depends on the reward accumulated so far, which time \
         and state do not say"
    )]
    Levels(&'static str),
    /// The exact worst-case antagonist exists for deterministic policies only.
    #[error("the exact worst-case antagonist is defined for deterministic policies only")]
    Stochastic,
    /// The world has no finite model.
    #[error("{0} has no finite model: its states, actions or outcomes are not finitely many")]
    NotFinite(&'static str),
    /// The world's constants are out of range.
    #[error(transparent)]
    Config(#[from] lava_envs::ConfigError),
}

fn require_alpha(alpha: f64) -> Result<(), ExactError> {
    // A NaN fails both comparisons.
    if alpha > 0.0 && alpha <= 1.0 { Ok(()) } else { Err(ExactError::Alpha(alpha)) }
}

/// alpha = 1/eta.
fn require_eta(eta: f64) -> Result<f64, ExactError> {
    if eta >= 1.0 && eta.is_finite() { Ok(1.0 / eta) } else { Err(ExactError::Eta(eta)) }
}
