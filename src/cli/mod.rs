//! The command line.
//!
//! Exit codes: 0 done, 1 a run failed, 2 bad input or usage, 75 stopped by SIGTERM and 130 by SIGINT,
//! with checkpoints written: the same command continues.
//! Answers go to standard output, progress and errors to standard error.

mod answer;
pub mod args;
mod progress;
mod summary;
mod verbs;

use crate::experiment::registry::Registry;
use anyhow::Result;
use clap::Parser;
use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

/// Exit code of usage errors and bad input.
const BAD_INPUT: u8 = 2;

/// The whole program, with the worlds and methods of a registry: reads the command line and carries it
/// out.
pub fn main(registry: &Registry) -> ExitCode {
    exit_code(verbs::run(registry, args::Cli::parse(), None))
}

/// The same for a program that another one hosts, such as an interpreter: its command line, which begins with
/// the path that starts it again. Returns the exit code.
pub fn hosted(registry: &Registry, command: &[OsString]) -> u8 {
    let program = command.first().map(Path::new);
    let code = exit_code(verbs::run(registry, args::Cli::parse_from(command), program));
    // A code cannot be read, only compared.
    (0..=u8::MAX).find(|&number| ExitCode::from(number) == code).unwrap_or(BAD_INPUT)
}

/// The exit code of a result; an error is reported in one line.
fn exit_code(result: Result<ExitCode>) -> ExitCode {
    result.unwrap_or_else(|error| {
        answer::note(format!("error: {}", one_line(&error)));
        ExitCode::from(BAD_INPUT)
    })
}

/// An error and its causes in one line.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        // Most errors of the library contain their cause.
        if !line.contains(&cause) {
            line = if line.is_empty() { cause } else { format!("{line}: {cause}") };
        }
    }
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}
