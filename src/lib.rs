//! Risk-sensitive reinforcement learning by games, with exact yardsticks.
//!
//! A protagonist learns to reach a goal past lava. An antagonist reweights the probabilities of
//! chance within a multiplicative budget eta over the whole trajectory. At equilibrium a deterministic
//! protagonist maximises CVaR_alpha of its return at alpha = 1/eta (arXiv 2109.09470); a stochastic one need
//! not, unless its own draw is chance as well (`docs/game.md`).

pub mod cli;
pub mod exact;
pub mod experiment;
pub mod files;
pub mod game;
pub mod learn;
pub mod report;
