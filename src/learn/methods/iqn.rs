//! The method `iqn`: implicit quantile networks (Dabney, Ostrovski, Silver & Munos, ICML 2018), the distributional
//! method whose policy aims at CVaR. A network is given a level tau and answers with the tau-quantile `Z_tau(s, a)` of
//! what is left of the return; it learns off-policy, from a replay, with a target network and the quantile Huber loss.
//! Networks and gradients are libtorch's: it needs the feature `torch`.
//!
//! In each state the published policy (`risk = "iterated"`) takes the action with the best CVaR of what is left,
//!
//! ```text
//! a*(s) = argmax_a E[ Z_tau(s, a) ],    tau ~ U(0, alpha),
//! ```
//!
//! and backups follow it. What that optimises is iterated: the CVaR of what is left is taken anew at each step, which is
//! not the CVaR of the return. The repair (`risk = "static"`) carries a threshold along the trajectory, as Baeuerle & Ott
//! (2011) show that it must be and as Lim & Malik (NeurIPS 2022) do in distributional learning. With w_0 at the start,
//!
//! ```text
//! w_{t+1} = (w_t - r_t) / gamma,    a*(s, w) = argmax_a E[ min(Z_tau(s, w, a), w) ],    tau ~ U(0, 1),
//! w_0     = argmax_w { w - (1/alpha) E[(w - Z_tau(s_0, w, a*))^+] }.
//! ```
//!
//! The network sees the threshold. How it moves is known, so that a step from the replay is learned from at any
//! threshold. As in [`super::augmented`], the steps of a running episode earn alike, and the time says what an episode
//! has earned. What is not as published: levels of the policy are midpoints of equal shares of their interval, not
//! draws, so that it is deterministic; a share of the levels may lie in the tail (`tail`), with weights that make up for
//! it; and in a world of pushes in the plane the policy chooses among 16 full pushes and none.

#[cfg(feature = "torch")]
pub mod quantiles;
#[cfg(feature = "torch")]
mod replay;
#[cfg(feature = "torch")]
mod training;

use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::TrainOptions;
use serde::Deserialize;

/// The method `iqn`.
#[derive(Debug, Clone, Copy)]
pub struct Iqn;

/// What the policy maximises in each step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Risk {
    /// CVaR of what is left from this step on.
    Iterated,
    /// The mean of what is left up to the threshold that is carried along.
    Static,
}

/// The options of the method.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Options {
    /// What the policy maximises.
    pub risk: Risk,
    /// Cosines n of the embedding of a level.
    pub cosines: usize,
    /// Levels N = N' of a sample in the loss.
    pub levels: usize,
    /// Levels K of the policy.
    pub policy_levels: usize,
    /// Share of the levels of loss and policy that are in the tail (0, alpha).
    pub tail: f64,
    /// kappa of the quantile Huber loss.
    pub kappa: f64,
    /// Adam's learning rate at the first gradient step.
    pub learning_rate: f64,
    /// Adam's learning rate at the last one; linear in between.
    pub learning_rate_final: f64,
    /// Samples of a gradient step.
    pub minibatch: usize,
    /// Environment steps per gradient step.
    pub steps_per_gradient: u64,
    /// Gradient steps after which the target network is a copy of the network.
    pub target_every: u64,
    /// Steps that the replay holds.
    pub replay: usize,
    /// Share of random actions at the end of exploration; at the beginning all are.
    pub exploration: f64,
    /// Share of the run over which exploration falls.
    pub exploration_until: f64,
}

impl Method for Iqn {
    const NAME: &'static str = "iqn";
    const METRICS: &'static [Metric] = &[
        Metric { column: "budget", tag: "charts/budget" },
        Metric { column: "threshold", tag: "charts/threshold" },
        Metric { column: "mean_return", tag: "charts/episodic_return" },
        Metric { column: "mean_length", tag: "charts/episodic_length" },
        Metric { column: "goal", tag: "charts/goal" },
        Metric { column: "lava", tag: "charts/lava" },
        Metric { column: "exploration", tag: "charts/exploration" },
        Metric { column: "quantile_loss", tag: "losses/quantile_loss" },
        Metric { column: "gradient_norm", tag: "losses/gradient_norm" },
    ];
    const DEFAULTS: &'static str = "\
# What the policy maximises in each step: \"iterated\", the CVaR of what is left, as published, or \"static\", the mean of
# what is left up to a threshold that is carried along the trajectory.
# One of: \"iterated\", \"static\"
risk = \"iterated\"
# Cosines of the embedding of a level.
# Range: [1, 1024]
cosines = 64
# Levels of a sample in the loss, of the network and of the target each.
# Range: [1, 1024]
levels = 8
# Levels of the policy.
# Range: [1, 1024]
policy_levels = 32
# Share of the levels, in the loss and in a static policy, that are in the tail (0, alpha). With 0, as published, the
# worst hundredth of the returns is one level in a hundred; a static policy of so few levels cannot see it.
# Range: [0, 0.9]
tail = 0.0
# kappa of the quantile Huber loss. Published as 1; differences below it count with their squares, which for returns as
# small as ours would fit expectiles.
# Range: (0, 1000]
kappa = 0.05
# Adam's learning rate at the first gradient step.
# Range: (0, 1]
learning_rate = 0.0005
# Adam's learning rate at the last one; linear in between.
# Range: [0, 1]
learning_rate_final = 0.0005
# Samples of a gradient step.
# Range: [1, 65536]
minibatch = 32
# Environment steps per gradient step.
# Range: [1, 1000000]
steps_per_gradient = 4
# Gradient steps after which the target network is a copy of the network.
# Range: [1, 1000000]
target_every = 500
# Steps that the replay holds.
# Range: [1, 10000000]
replay = 50000
# Share of random actions at the end of exploration; at the beginning all are.
# Range: [0, 1]
exploration = 0.05
# Share of the run over which exploration falls.
# Range: (0, 1]
exploration_until = 0.3
";

    fn check<W: Arena>(options: &TrainOptions, own: &toml::Table) -> Result<(), String> {
        if cfg!(not(feature = "torch")) {
            return Err("the method `iqn` needs a program built with the feature `torch`; run `cargo xtask \
                        torch build --release`, or leave it out"
                .to_owned());
        }
        let Options { risk, .. } = Options::read(own);
        if risk == Risk::Static && !options.protagonist.time_aware {
            return Err("method.iqn.risk = \"static\" needs the time, which says what an episode has earned; \
                        use train.protagonist.time_aware = true"
                .to_owned());
        }
        Ok(())
    }

    #[cfg(feature = "torch")]
    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(training::IqnTraining::new(world, setting))
    }

    #[cfg(feature = "torch")]
    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(training::IqnPlayers::new(world, setting))
    }

    #[cfg(not(feature = "torch"))]
    fn begin<'a, W: Arena>(_: W, _: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        unreachable!("`check` refuses it")
    }

    #[cfg(not(feature = "torch"))]
    fn players<W: Arena>(_: &W, _: &Setting<'_>) -> Box<dyn Players<W>> {
        unreachable!("`check` refuses it")
    }
}

impl Options {
    /// The options in the section `[method.iqn]`.
    ///
    /// # Panics
    /// If they were not checked with the configuration.
    pub fn read(own: &toml::Table) -> Self {
        own.clone().try_into().expect("the configuration was checked")
    }
}
