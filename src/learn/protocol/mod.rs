//! The life of a run behind its configuration: train, keep the weights, judge, and show step by step.
//!
//! | question | module |
//! |---|---|
//! | what happens in a run | [`run`] |
//! | how is a trained pair judged | [`evaluation`] |
//! | what is played for the figures | [`exhibits`] |
//! | how are its steps written out | [`steps`] |
//! | why does a run fail | [`failure`] |

pub mod evaluation;
pub mod exhibits;
pub mod failure;
pub mod run;
pub mod steps;
