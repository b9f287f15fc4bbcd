//! The command line program: parse, run, and say in one line what went wrong.

mod cli;

use clap::Parser;
use std::process::ExitCode;

/// libtorch allocates a tensor per operation; with small networks glibc's malloc is a third of the
/// time of an update. `override` makes the libraries use this one as well.
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
