//! The Python package: its tests, and the files from which others install it.

use crate::{finish, forget_this_package};
use anyhow::{Context, Result, bail};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// The oldest glibc that wheels run on, as their names say it.
const COMPATIBILITY: &str = "manylinux_2_17";

/// What builds the package.
const BUILDERS: [&str; 3] = ["maturin>=1.9,<2", "ziglang>=0.13,<0.17", "pip>=23"];

/// Builds the package as it is in development, installs it in an environment of its own, and runs its tests.
///
/// # Errors
/// If a tool cannot be had.
pub fn test(repository: &Path, target: &Path, arguments: &[OsString]) -> Result<ExitCode> {
    let environment = Environment::provide(target)?;
    environment.pip(&["install", "--quiet"], BUILDERS.map(OsString::from))?;
    let package = repository.join("envs").join("python");
    let mut develop = environment.command("maturin");
    develop.args(["develop", "--quiet", "--extras", "test"]).current_dir(&package);
    develop.env("CARGO_TARGET_DIR", target);
    succeed(develop)?;
    let mut tests = environment.command("python");
    tests.args(["-m", "pytest", "-q"]).args(arguments).current_dir(&package);
    finish(tests)
}

/// Builds a wheel for every Python from 3.10 on, and the package's sources, into `target/wheels`.
///
/// # Errors
/// If a tool cannot be had, or the build fails.
pub fn wheel(repository: &Path, target: &Path) -> Result<ExitCode> {
    let environment = Environment::provide(target)?;
    environment.pip(&["install", "--quiet"], BUILDERS.map(OsString::from))?;
    let package = repository.join("envs").join("python");
    let wheels = target.join("wheels");
    for arguments in
        [&["build", "--release", "--zig", "--compatibility", COMPATIBILITY][..], &["sdist"][..]]
    {
        let mut build = environment.command("maturin");
        build.args(arguments).arg("--out").arg(&wheels).current_dir(&package);
        build.env("CARGO_TARGET_DIR", target);
        succeed(build)?;
    }
    println!("{}", wheels.display());
    Ok(ExitCode::SUCCESS)
}

/// A Python environment of its own.
struct Environment {
    programs: PathBuf,
}

impl Environment {
    /// The one of a target folder; `PYTHON` may name the interpreter that makes it.
    fn provide(target: &Path) -> Result<Self> {
        let folder = target.join("python");
        let programs = folder.join(if cfg!(windows) { "Scripts" } else { "bin" });
        if !programs.join("pip").exists() {
            let python = std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into());
            let mut make = Command::new(&python);
            make.args(["-m", "venv"]).arg(&folder);
            succeed(make).context(
                "a Python from 3.10 on with venv is needed; PYTHON=PATH names one, and on Debian \
                 `apt install python3-venv` provides it",
            )?;
        }
        Ok(Environment { programs })
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(self.programs.join(program));
        forget_this_package(&mut command);
        let path = std::env::var_os("PATH").unwrap_or_default();
        let paths = [self.programs.clone()].into_iter().chain(std::env::split_paths(&path));
        if let Ok(path) = std::env::join_paths(paths) {
            command.env("PATH", path);
        }
        // The environment's folder, by which maturin finds it.
        command.env("VIRTUAL_ENV", self.programs.parent().unwrap_or(&self.programs));
        command
    }

    fn pip(&self, verb: &[&str], packages: impl IntoIterator<Item = OsString>) -> Result<()> {
        let mut pip = self.command("python");
        pip.args(["-m", "pip"]).args(verb).args(packages);
        succeed(pip)
    }
}

fn succeed(command: Command) -> Result<()> {
    let program = command.get_program().to_string_lossy().into_owned();
    if finish(command)? != ExitCode::SUCCESS {
        bail!("{program} failed");
    }
    Ok(())
}
