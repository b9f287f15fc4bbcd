//! Learning: one PPO for both players, and the alternating game of Algorithm 1.
//!
//! | question | module |
//! |---|---|
//! | the alternating loop | [`train`] |
//! | PPO and its loss | `ppo` |
//! | what a network's outputs mean | `head` |
//! | one step of the game | `contest` |
//! | what a player sees | `pair` |

pub mod options;

#[cfg(feature = "torch")]
pub mod adam;
#[cfg(feature = "torch")]
pub mod arena;
#[cfg(feature = "torch")]
pub mod contest;
#[cfg(feature = "torch")]
pub mod gae;
#[cfg(feature = "torch")]
pub mod head;
#[cfg(feature = "torch")]
pub mod network;
#[cfg(feature = "torch")]
pub mod pair;
#[cfg(feature = "torch")]
pub mod play;
#[cfg(feature = "torch")]
pub mod ppo;
#[cfg(feature = "torch")]
pub mod rollout;
#[cfg(feature = "torch")]
pub mod train;
#[cfg(feature = "torch")]
pub mod trajectories;
#[cfg(feature = "torch")]
pub mod weights;
