//! The half of the command line program that trains and plays; `cvar-game` starts it.

use clap::Parser;
use cvar_game::cli;
use cvar_learn::verbs;
use std::process::ExitCode;

/// libtorch allocates a tensor per operation. `override` makes the libraries use this allocator as
/// well.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    cli::tell(verbs::run(cli::Cli::parse()))
}
