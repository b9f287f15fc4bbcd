//! Gives the program its commit, the mark of its checkpoints and the path of libtorch.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// All on which the bits of training and the contents of a checkpoint depend.
const TRAINING: [&str; 5] =
    ["envs/src", "src/game", "src/learn", "src/experiment/checkpoint.rs", "Cargo.lock"];

/// What torch-sys reads to choose a libtorch.
const VARIABLES: [&str; 3] = ["LIBTORCH_USE_PYTORCH", "LIBTORCH_LIB", "LIBTORCH"];

/// Makes Python print the folder of its torch, without loading torch.
const PYTORCH_FOLDER: &str =
    "import importlib.util as u; print(u.find_spec('torch').submodule_search_locations[0])";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    set_the_commit();
    set_the_build();
    if env::var_os("CARGO_FEATURE_TORCH").is_some() {
        link_libtorch();
    }
}

/// Gives the program the mark of a checkpoint: a hash of all on which the bits of training depend.
///
/// A program continues a checkpoint only if the marks are equal. So the mark covers the sources of
/// training, the versions of the crates, the kind of networks, the compiler and the target; reports,
/// figures and the command line may change without an effect on it.
fn set_the_build() {
    let mut hash = DefaultHasher::new();
    let mut paths = TRAINING.map(PathBuf::from).to_vec();
    while let Some(path) = paths.pop() {
        println!("cargo::rerun-if-changed={}", path.display());
        if path.is_dir() {
            let entries = fs::read_dir(&path).into_iter().flatten().flatten();
            let mut inside: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
            inside.sort();
            paths.append(&mut inside);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            let source = fs::read_to_string(&path).ok();
            (&path, source.map(|source| code(&source))).hash(&mut hash);
        } else {
            (&path, fs::read(&path).ok()).hash(&mut hash);
        }
    }
    env::var_os("CARGO_FEATURE_TORCH").is_some().hash(&mut hash);
    env::var_os("TARGET").hash(&mut hash);
    compiler().hash(&mut hash);
    println!("cargo::rustc-env=CVAR_GAME_BUILD={:016x}", hash.finish());
}

/// The version of the compiler, as it prints it.
fn compiler() -> Option<Vec<u8>> {
    let output = Command::new(env::var_os("RUSTC")?).arg("--version").output().ok()?;
    output.status.success().then_some(output.stdout)
}

/// The lines of a source that can change what it computes: without comments, blank lines and the unit
/// tests at its end.
///
/// It reads lines, not Rust. A line of a string that begins with `//` is lost too. Where it is unsure
/// whether a test module is the last item, it keeps the module.
pub fn code(source: &str) -> String {
    let lines: Vec<&str> = source
        .lines()
        .map(str::trim_end)
        .filter(|line| !line.is_empty() && !line.trim_start().starts_with("//"))
        .collect();
    // rustfmt indents all that is inside a module, so the first `}` without indentation closes it.
    let tests = lines.windows(2).position(|pair| {
        pair[0] == "#[cfg(test)]" && pair[1].starts_with("mod ") && pair[1].ends_with('{')
    });
    let end = tests.filter(|&start| {
        lines[start..].iter().position(|line| *line == "}") == Some(lines.len() - start - 1)
    });
    lines[..end.unwrap_or(lines.len())].join("\n")
}

/// Gives the program the commit that it is built from, for the manifests of runs.
fn set_the_commit() {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        output.status.success().then(|| text.trim().to_owned())
    };
    // The log of HEAD grows with every commit and checkout.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"])
        && Path::new(&log).exists()
    {
        println!("cargo::rerun-if-changed={log}");
    }
    if let Some(commit) = git(&["rev-parse", "HEAD"]) {
        println!("cargo::rustc-env=CVAR_GAME_COMMIT={commit}");
    }
}

/// Lets the binaries find libtorch at run time, without `LD_LIBRARY_PATH`.
///
/// torch-sys passes the folder of libtorch to the linker, but a dependency cannot put a run path into the
/// binaries of the crates above it. So this finds the same folder in the same order (see torch-sys'
/// own build script) and writes it into every binary, test, bench and example.
fn link_libtorch() {
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
    // One file rather than the folder: cargo would check each of its ten thousand headers.
    println!("cargo::rerun-if-changed={}", folder.join("libtorch_cpu.so").display());
    match fs::canonicalize(folder.join("libtorch_cpu.so")) {
        // The canonical path: a binary continues to work when the repository moves or `.libtorch`
        // comes to point elsewhere.
        Ok(library) => {
            let folder = library.parent().unwrap_or(&folder);
            println!("cargo::rustc-link-arg=-Wl,-rpath,{}", folder.display());
        }
        Err(_) if on_other_platform() => {}
        Err(_) => println!(
            "cargo::error=no libtorch in {}; run `cargo xtask torch build` (or set LIBTORCH to one \
             of your own, or build without the feature `torch`)",
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
    let root = root.map_or_else(|| PathBuf::from(".libtorch"), PathBuf::from);
    Ok(root.join("lib"))
}

/// The folder of Python's torch, by the Python that torch-sys would run.
fn pytorch_folder() -> Result<PathBuf, String> {
    let python = if env::var_os("VIRTUAL_ENV").is_some() { "python" } else { "python3" };
    let answer = Command::new(python).args(["-c", PYTORCH_FOLDER]).output();
    match answer {
        Ok(answer) if answer.status.success() => {
            Ok(Path::new(String::from_utf8_lossy(&answer.stdout).trim()).to_path_buf())
        }
        _ => Err(format!(
            "LIBTORCH_USE_PYTORCH is set, but `{python}` has no torch; install torch 2.13.0 there, \
             or unset it and run `cargo xtask torch build`"
        )),
    }
}

/// Whether libtorch's libraries have other names than on Linux; run paths are then the user's.
fn on_other_platform() -> bool {
    env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "linux")
}
