//! Experiments: configuration -> plan of runs -> workers -> artefacts.
//!
//! | question | module |
//! |---|---|
//! | which options are there, and what may they be | [`config`] |
//! | what are worlds and runs called | [`names`] |
//! | which runs does a configuration mean | [`plan`] |
//! | how are they carried out, many at a time | [`runner`] |
//! | which files does a run write | [`artefacts`], [`figure_data`], [`tensorboard`] |
//! | where are the files of finished runs | [`archive`] |
//! | what is a trained opponent to an exact solver | [`frozen`] |
//! | what does an unfinished one continue from | [`checkpoint`] |
//! | who may work on a run, and what stops it | [`lock`], [`stop`] |
//! | how is a sweep submitted to Slurm | [`slurm`] |

pub mod archive;
pub mod artefacts;
pub mod checkpoint;
pub mod clock;
pub mod config;
pub mod evaluation;
pub mod failure;
pub mod figure_data;
pub mod frozen;
pub mod growing_file;
pub mod lock;
pub mod names;
pub mod plan;
pub mod progress_file;
pub mod registry;
pub mod run;
pub mod runner;
pub mod slurm;
pub mod steps;
pub mod stop;
pub mod tensorboard;
pub mod words;
