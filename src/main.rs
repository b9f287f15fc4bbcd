//! The command line program. It is not linked to libtorch, whose loading takes a third of a second:
//! what needs the networks is handed over to `cvar-game-torch` beside it.

use clap::Parser;
use cvar_game::cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    cli::tell(cli::run(cli::Cli::parse()))
}
