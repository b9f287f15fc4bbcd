//! Chores of the workspace: `cargo xtask torch`, `python`, `wheel`, `speed`, `scaling`, `oracle`,
//! `certificates`, `results`.
//!
//! Nothing here is needed to build, test or use the program. `torch` provides libtorch, a C++ library of
//! 480 MB that cargo cannot fetch, and runs a cargo command with the feature `torch`: it fetches the
//! library once for all checkouts of one user and links it into this one (`.cargo/config.toml` and
//! `build.rs` at the root do the rest).

mod cache;
mod libtorch;
mod oracle;
mod python;
mod results;
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
    /// Provide libtorch, then run a cargo command with the feature `torch`: `torch build --release`
    Torch {
        /// The cargo command and its arguments; without one, libtorch is only provided
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        command: Vec<OsString>,
    },
    /// Test the Python package, in an environment that is made for it in target/python
    Python {
        /// Passed on to pytest, such as a file or `-k NAME`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        passed_on: Vec<OsString>,
    },
    /// Build the Python package for others: a wheel and its sources, in target/wheels
    Wheel,
    /// Measure what training costs against its sizes; results go to results/speed
    Scaling,
    /// Compute the oracle of lava-point over noise and control steps, in about 40 minutes; the table goes to
    /// results/oracle
    Oracle,
    /// Compute the certificates of lava-point that come with the program and are not there yet, for every scene; they go to
    /// configs/oracle.json
    Certificates,
    /// Write results/README.md from its template and the committed tables, and check the claims of docs/claims.md
    Results,
    /// Measure the speed of training and its parts; the table goes to target/speed.md
    Speed {
        /// Passed on to the benchmarks, such as a filter of their names: `rollout`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        passed_on: Vec<OsString>,
    },
}

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
    match verb {
        Verb::Torch { command } => {
            provide_libtorch(&repository)?;
            if command.is_empty() {
                return Ok(ExitCode::SUCCESS);
            }
            cargo(&repository, &with_feature(command))
        }
        Verb::Python { passed_on } => {
            python::test(&repository, &speed::target(&repository), &passed_on)
        }
        Verb::Wheel => python::wheel(&repository, &speed::target(&repository)),
        Verb::Scaling => with_program(&repository, scaling::measure),
        Verb::Oracle => with_program(&repository, oracle::measure),
        Verb::Results => {
            results::write(&repository)?;
            results::check_claims(&repository)?;
            Ok(ExitCode::SUCCESS)
        }
        Verb::Certificates => with_program(&repository, oracle::certify),
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

/// Builds the program, and measures with it.
fn with_program(
    repository: &Path,
    measure: impl FnOnce(&Path, &Path) -> Result<()>,
) -> Result<ExitCode> {
    let code = cargo(repository, &["build", "--release"].map(OsString::from))?;
    if code == ExitCode::SUCCESS {
        measure(repository, &speed::target(repository))?;
    }
    Ok(code)
}

/// A cargo command with the feature `torch`, which is put after the command's own name: what follows
/// `--` is not cargo's.
fn with_feature(mut command: Vec<OsString>) -> Vec<OsString> {
    let feature = ["--features", "cvar-game/torch"].map(OsString::from);
    command.splice(1..1, feature);
    command
}

/// The root of the checkout. Cargo reports where this crate is now, also after the checkout moved.
fn repository() -> Result<PathBuf> {
    let manifest = std::env::var_os("CARGO_MANIFEST_DIR")
        .context("run this by cargo: `cargo xtask VERB` inside the repository")?;
    let root = Path::new(&manifest).parent().context("xtask has no folder above it")?;
    Ok(root.to_path_buf())
}

/// Makes sure that there is a libtorch, ours or the user's, and a compiler for its bindings.
fn provide_libtorch(repository: &Path) -> Result<()> {
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

/// Runs cargo in the repository and returns its exit code.
fn cargo(repository: &Path, arguments: &[OsString]) -> Result<ExitCode> {
    let mut command = cargo_command(repository);
    command.args(arguments);
    finish(command)
}

/// Cargo, to be run in the repository.
fn cargo_command(repository: &Path) -> Command {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(program);
    command.current_dir(repository);
    forget_this_package(&mut command);
    command
}

/// Takes the variables of this package from a command, which `cargo run` gave this process. Left in place they would
/// differ from those of a plain build and could make cargo build things twice.
fn forget_this_package(command: &mut Command) {
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(&name);
        }
    }
}

fn finish(mut command: Command) -> Result<ExitCode> {
    let program = command.get_program().to_string_lossy().into_owned();
    let status = command.status().with_context(|| format!("{program} could not be started"))?;
    match status.code() {
        Some(code) => Ok(ExitCode::from(u8::try_from(code).unwrap_or(1))),
        None => bail!("{program} was stopped by a signal"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_feature_is_given_to_cargo_and_not_to_the_tests() {
        let arguments =
            Arguments::parse_from(["cargo xtask", "torch", "test", "--release", "--", "--ignored"]);
        let Verb::Torch { command } = arguments.verb else { panic!("not the verb `torch`") };
        let expected = ["test", "--features", "cvar-game/torch", "--release", "--", "--ignored"];
        assert_eq!(with_feature(command), expected);
    }

    #[test]
    fn the_command_line_is_well_formed() {
        <Arguments as clap::CommandFactory>::command().debug_assert();
    }
}
