//! Learning: one PPO for both players, the alternating game of Algorithm 1, and all that needs a network
//! to be evaluated.
//!
//! | question | module |
//! |---|---|
//! | the alternating loop | [`train`] |
//! | PPO and its loss | [`ppo`] |
//! | The price of budget in the antagonist's gradient | [`price`] |
//! | what a network's outputs mean | [`head`] |
//! | one step of the game | [`contest`] |
//! | what a player sees | [`pair`] |
//! | what training goes on from | [`checkpoint`] |
//! | how a trained pair is judged | [`protocol`] |
//!
//! A crate of its own, so that the program that solves the worlds and reports starts without loading
//! libtorch and builds without having it; this crate is empty without its feature `torch`.

#![cfg(feature = "torch")]

pub mod adam;
pub mod arena;
pub mod checkpoint;
pub mod contest;
pub mod gae;
pub mod head;
pub mod network;
pub mod pair;
pub mod play;
pub mod ppo;
pub mod price;
pub mod protocol;
pub mod rollout;
pub mod train;
pub mod trajectories;
pub mod verbs;
pub mod weights;
