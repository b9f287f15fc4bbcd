//! Lets what is built here find libtorch at run time, with no `LD_LIBRARY_PATH`.
//!
//! torch-sys tells the linker where libtorch lies, but a dependency cannot put a run path into the
//! binaries of the crates above it. So this script finds the same folder in the same order (see
//! torch-sys' own build script) and writes it into every binary, test, bench and example. It also
//! says what to do when there is no libtorch yet.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// What torch-sys reads to choose a libtorch.
const VARIABLES: [&str; 3] = ["LIBTORCH_USE_PYTORCH", "LIBTORCH_LIB", "LIBTORCH"];

/// Makes Python say where its torch keeps the libraries, without loading them.
const PYTORCH_FOLDER: &str =
    "import importlib.util as u; print(u.find_spec('torch').submodule_search_locations[0])";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var_os("CARGO_FEATURE_TORCH").is_none() {
        return;
    }
    for variable in VARIABLES {
        println!("cargo::rerun-if-env-changed={variable}");
    }

    let folder = match library_folder() {
        Ok(folder) => folder,
        Err(message) => {
            println!("cargo::error={message}");
            return;
        }
    };
    // One file rather than the folder: cargo would look at each of its ten thousand headers.
    println!("cargo::rerun-if-changed={}", folder.join("libtorch_cpu.so").display());
    match fs::canonicalize(folder.join("libtorch_cpu.so")) {
        // The canonical path: a binary goes on working when the repository moves or `.libtorch`
        // comes to point elsewhere.
        Ok(library) => {
            let folder = library.parent().unwrap_or(&folder);
            println!("cargo::rustc-link-arg=-Wl,-rpath,{}", folder.display());
        }
        Err(_) if on_other_platform() => {}
        Err(_) => println!(
            "cargo::error=no libtorch in {}; run `cargo xtask setup` (or set LIBTORCH to one of \
             your own, or build without training: --no-default-features)",
            folder.display()
        ),
    }
}

/// The folder that torch-sys links from.
fn library_folder() -> Result<PathBuf, String> {
    if env::var_os("LIBTORCH_USE_PYTORCH").is_some() {
        return pytorch_folder().map(|torch| torch.join("lib"));
    }
    let root = env::var_os("LIBTORCH_LIB").or_else(|| env::var_os("LIBTORCH"));
    // `.cargo/config.toml` sets LIBTORCH; a build from outside the repository does not read it.
    let root = root.map_or_else(|| PathBuf::from("../../.libtorch"), PathBuf::from);
    Ok(root.join("lib"))
}

/// The folder of Python's torch, by the Python that torch-sys would ask.
fn pytorch_folder() -> Result<PathBuf, String> {
    let python = if env::var_os("VIRTUAL_ENV").is_some() { "python" } else { "python3" };
    let answer = Command::new(python).args(["-c", PYTORCH_FOLDER]).output();
    match answer {
        Ok(answer) if answer.status.success() => {
            Ok(Path::new(String::from_utf8_lossy(&answer.stdout).trim()).to_path_buf())
        }
        _ => Err(format!(
            "LIBTORCH_USE_PYTORCH is set, but `{python}` has no torch; install torch 2.13.0 there, \
             or unset it and run `cargo xtask setup`"
        )),
    }
}

/// Whether libtorch's libraries have other names than on Linux; run paths are then the user's.
fn on_other_platform() -> bool {
    env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "linux")
}
