//! Chores of the workspace: `cargo xtask setup`, `test`, `bench`, `ablations`, `speed`, `scaling`.
//!
//! Training needs libtorch, a C++ library of 480 MB that cargo cannot fetch. `setup` fetches it
//! once for all checkouts of one user and links it into this one; after that plain `cargo build`,
//! `cargo test` and `cargo run` work with no environment variable (`.cargo/config.toml` and
//! `build.rs` at the root do the rest). The other verbs run `setup` first, then cargo.

mod ablations;
mod cache;
mod libtorch;
mod scaling;
mod speed;
mod tools;
mod wheels;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::SystemTime;

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};

use crate::libtorch::{Choice, Environment};

#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", arg_required_else_help = true)]
#[command(about = "Chores of the workspace")]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// Provide libtorch: fetch it once into the user's cache and link it here as .libtorch
    Setup,
    /// Set up, then run the tests of the whole workspace
    Test {
        /// Passed on to `cargo test --workspace`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        passed_on: Vec<OsString>,
    },
    /// Set up, then run the quick benchmark (configs/quick.toml) with the release build
    Bench {
        /// Passed on to `cvar-game bench`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        passed_on: Vec<OsString>,
    },
    /// Set up, then run what configs/paper.toml is compared with; results go to results/ablations
    Ablations {
        /// One of them; without it, all that are not there yet
        only: Option<String>,
    },
    /// Set up, then measure what training costs against its sizes; results go to results/speed
    Scaling,
    /// Set up, then measure the speed of training and its parts; the table goes to target/speed.md
    Speed {
        /// Passed on to the benchmarks, such as a filter of their names: `rollout`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        passed_on: Vec<OsString>,
    },
}

/// Builds both programs.
const BUILD: [&str; 3] = ["build", "--release", "--bins"];

fn main() -> ExitCode {
    match run(Arguments::parse().verb) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(verb: Verb) -> Result<ExitCode> {
    let repository = repository()?;
    set_up(&repository)?;
    match verb {
        Verb::Setup => Ok(ExitCode::SUCCESS),
        Verb::Test { passed_on } => cargo(&repository, &["test", "--workspace"], &passed_on),
        Verb::Bench { passed_on } => {
            // `cargo run` alone would build one of the two programs.
            let code = cargo(&repository, &BUILD, &[])?;
            if code != ExitCode::SUCCESS {
                return Ok(code);
            }
            let bench = ["--", "bench", "--config", "configs/quick.toml"];
            let run = ["run", "--release", "--bin", "cvar-game"];
            cargo(&repository, &[run, bench].concat(), &passed_on)
        }
        Verb::Ablations { only } => {
            let code = cargo(&repository, &BUILD, &[])?;
            if code != ExitCode::SUCCESS {
                return Ok(code);
            }
            ablations::run(&repository, &speed::target(&repository), only.as_deref())
        }
        Verb::Scaling => {
            let code = cargo(&repository, &BUILD, &[])?;
            if code == ExitCode::SUCCESS {
                scaling::measure(&repository, &speed::target(&repository))?;
            }
            Ok(code)
        }
        Verb::Speed { passed_on } => {
            let target = speed::target(&repository);
            let start = SystemTime::now();
            let mut command = cargo_command(&repository);
            command.args(speed::CARGO).arg("--").args(passed_on);
            command.env("CRITERION_HOME", target.join("criterion"));
            let code = finish(command)?;
            if code == ExitCode::SUCCESS {
                speed::report(&target, start)?;
            }
            Ok(code)
        }
    }
}

/// The root of the checkout. Cargo says where this crate lies now, also after the checkout moved.
fn repository() -> Result<PathBuf> {
    let manifest = std::env::var_os("CARGO_MANIFEST_DIR")
        .context("run this by cargo: `cargo xtask VERB` inside the repository")?;
    let root = Path::new(&manifest).parent().context("xtask has no folder above it")?;
    Ok(root.to_path_buf())
}

/// Makes sure that there is a libtorch, whoever's, and a compiler to bind it.
fn set_up(repository: &Path) -> Result<()> {
    let environment = Environment::of_this_process(repository);
    match libtorch::choose(&environment) {
        Choice::Ours => {
            tools::check_platform()?;
            tools::check_cxx_compiler()?;
            let folder = cache::provide(&cache::root(&environment)?)?;
            cache::link(&folder, &environment.link)?;
        }
        choice => {
            println!("{}", libtorch::check_users(&choice, &environment)?);
            tools::check_cxx_compiler()?;
        }
    }
    Ok(())
}

/// Runs cargo in the repository and hands on its exit code.
fn cargo(repository: &Path, arguments: &[&str], passed_on: &[OsString]) -> Result<ExitCode> {
    let mut command = cargo_command(repository);
    command.args(arguments).args(passed_on);
    finish(command)
}

/// Cargo, to be run in the repository.
fn cargo_command(repository: &Path) -> Command {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(program);
    command.current_dir(repository);
    // `cargo run` gave this process variables of its own package. Left in place they would differ
    // from those of a plain build and could make cargo build things twice.
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(&name);
        }
    }
    command
}

fn finish(mut command: Command) -> Result<ExitCode> {
    let status = command.status().context("cargo could not be started")?;
    match status.code() {
        Some(code) => Ok(ExitCode::from(u8::try_from(code).unwrap_or(1))),
        None => bail!("cargo was stopped by a signal"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_after_the_verb_are_passed_on() {
        let arguments =
            Arguments::parse_from(["cargo xtask", "test", "--release", "--", "--nocapture"]);
        let Verb::Test { passed_on } = arguments.verb else { panic!("not the verb `test`") };
        assert_eq!(passed_on, ["--release", "--", "--nocapture"]);
    }

    #[test]
    fn the_command_line_is_well_formed() {
        <Arguments as clap::CommandFactory>::command().debug_assert();
    }
}
