//! The command line program.

use cvar_game::{cli, experiment::registry};
use std::process::ExitCode;

/// libtorch allocates a tensor per operation. `override` makes the libraries use this allocator as
/// well.
#[cfg(feature = "torch")]
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    cli::main(registry::standard())
}
