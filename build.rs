//! Tells the program what it is built from.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    tell_the_commit();
    tell_the_build();
}

/// Gives both programs a mark of the sources that they are built from, by which the one knows the other.
fn tell_the_build() {
    let mut hash = DefaultHasher::new();
    let mut paths =
        ["src", "envs/src", "configs/default.toml", "configs/oracle.json", "Cargo.lock"]
            .map(PathBuf::from)
            .to_vec();
    while let Some(path) = paths.pop() {
        if path.is_dir() {
            let entries = fs::read_dir(&path).into_iter().flatten().flatten();
            let mut inside: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
            inside.sort();
            paths.append(&mut inside);
        } else {
            println!("cargo::rerun-if-changed={}", path.display());
            (&path, fs::read(&path).ok()).hash(&mut hash);
        }
    }
    println!("cargo::rerun-if-changed=src");
    println!("cargo::rerun-if-changed=envs/src");
    println!("cargo::rustc-env=CVAR_GAME_BUILD={:016x}", hash.finish());
}

/// Gives the program the commit that it is built from, for the manifests of runs.
fn tell_the_commit() {
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
