//! The command line program: parse, run, and say in one line what went wrong.

mod cli;

use clap::Parser;
use std::process::ExitCode;

/// libtorch allocates a tensor per operation. `override` makes the libraries use this allocator as
/// well.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    match cli::run(cli::Cli::parse()) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {}", cli::one_line(&error));
            ExitCode::from(cli::BAD_INPUT)
        }
    }
}
