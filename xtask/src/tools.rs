//! What must be on the machine before anything is fetched: platform, C++ compiler, Python's pip.

use std::env;
use std::ffi::OsStr;
use std::process::{Command, Stdio};

use anyhow::{Result, bail, ensure};

use crate::libtorch::VERSION;

/// The packages fetched hold libraries only for Linux with glibc on x86-64.
pub fn check_platform() -> Result<()> {
    ensure!(
        cfg!(all(target_os = "linux", target_arch = "x86_64", target_env = "gnu")),
        "no ready-made libtorch for this platform ({} {}): the set-up supports Linux with glibc on \
         x86-64; install libtorch {VERSION} yourself and set LIBTORCH to its folder",
        env::consts::OS,
        env::consts::ARCH,
    );
    Ok(())
}

/// tch's bindings are C++ and compiled here, by `$CXX` or else `c++`.
pub fn check_cxx_compiler() -> Result<()> {
    let Some(named) = env::var_os("CXX").filter(|named| !named.is_empty()) else {
        if runs("c++", "--version") {
            return Ok(());
        }
        if let Some(other) = ["g++", "clang++"].into_iter().find(|name| runs(name, "--version")) {
            bail!("there is no `c++` on PATH, but there is {other}: set CXX={other}");
        }
        bail!(
            "no C++ compiler: there is no `c++` on PATH; install one (on Debian or Ubuntu: apt-get \
             install g++) or set CXX to yours"
        );
    };
    // As the cc crate has it, CXX may hold a wrapper or flags too: `ccache g++`.
    let text = named.to_string_lossy();
    let mut words = text.split_whitespace();
    let runs_as_named = words
        .next()
        .is_some_and(|program| quietly(Command::new(program).args(words).arg("--version")));
    ensure!(
        runs_as_named,
        "no C++ compiler: CXX is `{text}`, which does not run; set CXX to a C++ compiler, or unset \
         it"
    );
    Ok(())
}

/// pip fetches libtorch: it brings proxies, mirrors, retries and the check of digests.
pub fn check_pip() -> Result<()> {
    ensure!(
        runs("python3", "--version"),
        "no `python3` on PATH; libtorch is fetched with Python's pip: install Python 3.9 or later \
         with pip (on Debian or Ubuntu: apt-get install python3-pip), or set LIBTORCH to a \
         libtorch {VERSION} of your own"
    );
    ensure!(
        quietly(Command::new("python3").args(["-m", "pip", "--version"])),
        "`python3` has no pip, which fetches libtorch: install pip (on Debian or Ubuntu: \
         apt-get install python3-pip; in a virtual environment: python3 -m ensurepip), or set \
         LIBTORCH to a libtorch {VERSION} of your own"
    );
    Ok(())
}

fn runs(program: impl AsRef<OsStr>, argument: &str) -> bool {
    quietly(Command::new(program).arg(argument))
}

fn quietly(command: &mut Command) -> bool {
    command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}
