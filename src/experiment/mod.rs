//! Experiments: configuration -> plan of runs -> workers -> artefacts.
//!
//! | question | module |
//! |---|---|
//! | which options are there, and what may they be | [`config`] |
//! | what are worlds and runs called | [`names`] |
//! | which runs does a configuration mean | [`plan`] |
//! | how are they carried out, many at a time | [`runner`] |
//! | what does a run leave behind | [`artefacts`], [`exhibits`], [`tensorboard`] |
//! | what does an unfinished one go on from | [`checkpoint`] |
//! | who may work on a run, and what stops it | [`lock`], [`stop`] |
//! | how does a sweep go to Slurm | [`slurm`] |

pub mod artefacts;
pub mod checkpoint;
pub mod config;
pub mod exhibits;
pub mod lock;
pub mod names;
pub mod plan;
pub mod runner;
pub mod slurm;
pub mod stop;
pub mod tensorboard;
