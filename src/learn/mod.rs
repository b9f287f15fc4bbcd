//! Learning: one PPO for both players, the methods that train with it, and how any policy is played.
//!
//! | question | module |
//! |---|---|
//! | Algorithm 1, the alternating loop | [`methods::game`] |
//! | what a method is | [`method`] |
//! | whose turn an update is, and at which budget | [`schedule`] |
//! | methods without an antagonist | [`solo`] |
//! | what a policy and an opponent are, however they were trained | [`policy`] |
//! | one step of the game in a batch, and whole episodes | [`vector_game`], [`play`] |
//! | PPO and its loss | [`ppo`], [`gae`] |
//! | what a network's outputs mean | [`head`] |
//! | the antagonist, and the families that it may use | [`family`] |
//! | how its gradient counts the budget that it spends | [`budget_sensitivity`] |
//! | what the protagonist's gradient owes to the budget | [`price`] |
//! | what the players see | [`observation`] |
//! | networks, their engines and their files | [`network`], [`device`], [`weights`] |
//! | what training continues from | [`state`] |

pub mod adam;
pub mod arena;
pub mod budget_sensitivity;
pub mod device;
pub mod family;
pub mod gae;
pub mod head;
pub mod inputs;
pub mod method;
pub mod methods;
pub mod network;
pub mod observation;
pub mod options;
pub mod pair;
pub mod plane;
pub mod play;
pub mod policy;
pub mod ppo;
pub mod price;
pub mod rollout;
pub mod schedule;
pub mod solo;
pub mod state;
pub mod trajectories;
pub mod truncated_normal;
pub mod vector_game;
pub mod weights;
