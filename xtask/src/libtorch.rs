//! Which libtorch a build uses, and what can be checked of one that the user brought.
//!
//! The order is that of torch-sys' build script: Python's torch if `LIBTORCH_USE_PYTORCH` is set,
//! else the folder `LIBTORCH`. The repository's `.cargo/config.toml` sets `LIBTORCH` to `.libtorch`
//! where the user has not, so a value equal to that link means: ours.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use etcetera::base_strategy::{BaseStrategy as _, Xdg};

/// The one version that tch 0.26 binds.
pub const VERSION: &str = "2.13.0";

/// What decides which libtorch is used, read once so that the decision itself is a pure function.
#[derive(Debug, Clone, Default)]
pub struct Environment {
    /// The link in the repository that stands for our own libtorch.
    pub link: PathBuf,
    pub libtorch: Option<OsString>,
    pub use_pytorch: bool,
    pub in_virtual_env: bool,
    pub bypass_version_check: bool,
    /// The user's cache folder by the XDG specification.
    pub caches: Option<PathBuf>,
}

impl Environment {
    pub fn of_this_process(repository: &Path) -> Self {
        let is_set = |name: &str| std::env::var_os(name).is_some();
        Self {
            link: repository.join(".libtorch"),
            libtorch: std::env::var_os("LIBTORCH"),
            use_pytorch: is_set("LIBTORCH_USE_PYTORCH"),
            in_virtual_env: is_set("VIRTUAL_ENV"),
            bypass_version_check: is_set("LIBTORCH_BYPASS_VERSION_CHECK"),
            caches: Xdg::new().ok().map(|user| user.cache_dir()),
        }
    }
}

/// Whose libtorch a build takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Choice {
    /// The one that `cargo xtask torch` provides.
    Ours,
    /// The folder that the user's `LIBTORCH` names.
    Folder(PathBuf),
    /// Python's, by the user's `LIBTORCH_USE_PYTORCH`.
    Pytorch,
}

pub fn choose(environment: &Environment) -> Choice {
    if environment.use_pytorch {
        return Choice::Pytorch;
    }
    match &environment.libtorch {
        Some(folder) if Path::new(folder) != environment.link => Choice::Folder(folder.into()),
        _ => Choice::Ours,
    }
}

/// Checks a libtorch that the user brought and returns a sentence about it.
pub fn check_users(choice: &Choice, environment: &Environment) -> Result<String> {
    let (source, version) = match choice {
        Choice::Ours => return Ok("libtorch is provided by cargo xtask torch".into()),
        Choice::Folder(folder) => {
            let source = format!("LIBTORCH={}", folder.display());
            (source, version_of_users_folder(folder)?)
        }
        Choice::Pytorch => {
            let python = if environment.in_virtual_env { "python" } else { "python3" };
            (
                format!("LIBTORCH_USE_PYTORCH (torch of `{python}`)"),
                Some(version_of_pytorch(python)?),
            )
        }
    };
    let Some(version) = version else {
        return Ok(format!("using {source}: its version is not known, {VERSION} is needed"));
    };
    if environment.bypass_version_check {
        return Ok(format!(
            "using {source}: version {version}, not checked, as LIBTORCH_BYPASS_VERSION_CHECK is set"
        ));
    }
    ensure!(
        is_right(&version),
        "{source} has version {version}, but tch needs {VERSION}; point it at libtorch {VERSION}, \
         or unset it to use the one of `cargo xtask torch`"
    );
    Ok(format!("using {source}: version {version}, nothing to set up"))
}

fn version_of_users_folder(folder: &Path) -> Result<Option<String>> {
    let what_to_do = "name the folder that holds include/ and lib/ by its absolute path, or unset \
                      LIBTORCH to use the one of `cargo xtask torch`";
    let shown = folder.display();
    // torch-sys' build script runs in a folder of its own, so a relative path would miss.
    ensure!(folder.is_absolute(), "LIBTORCH={shown} is not an absolute path; {what_to_do}");
    ensure!(folder.is_dir(), "LIBTORCH={shown} is not a folder; {what_to_do}");
    ensure!(folder.join("lib").is_dir(), "LIBTORCH={shown} has no folder lib; {what_to_do}");
    Ok(version_in(folder))
}

fn version_of_pytorch(python: &str) -> Result<String> {
    let what_to_do = format!(
        "install torch {VERSION} there, or unset LIBTORCH_USE_PYTORCH to use the one of `cargo \
         xtask torch`"
    );
    let answer = Command::new(python)
        .args(["-c", "import torch; print(torch.__version__)"])
        .output()
        .with_context(|| format!("LIBTORCH_USE_PYTORCH: `{python}` cannot run; {what_to_do}"))?;
    if !answer.status.success() {
        let errors = String::from_utf8_lossy(&answer.stderr);
        let reason = errors.lines().last().unwrap_or("no message");
        bail!("LIBTORCH_USE_PYTORCH: `{python}` cannot import torch ({reason}); {what_to_do}");
    }
    Ok(String::from_utf8_lossy(&answer.stdout).trim().to_owned())
}

/// The version of the libtorch in `folder`, if a file there states it: `build-version` in the packages
/// of libtorch, the header in those of Python, where it has moved over the years.
pub fn version_in(folder: &Path) -> Option<String> {
    if let Ok(version) = std::fs::read_to_string(folder.join("build-version")) {
        return Some(version.trim().to_owned());
    }
    ["include/torch/headeronly/version.h", "include/torch/csrc/api/include/torch/version.h"]
        .iter()
        .filter_map(|header| std::fs::read_to_string(folder.join(header)).ok())
        .find_map(|header| version_in_header(&header))
}

/// Reads `2.13.0` out of the header's `TORCH_VERSION_MAJOR`, `_MINOR` and `_PATCH`.
fn version_in_header(header: &str) -> Option<String> {
    let number = |name: &str| -> Option<u32> {
        header.lines().find_map(|line| {
            let mut words = line.split_whitespace();
            let defines = words.next() == Some("#define") && words.next() == Some(name);
            defines.then(|| words.next()?.parse().ok()).flatten()
        })
    };
    let major = number("TORCH_VERSION_MAJOR")?;
    let minor = number("TORCH_VERSION_MINOR")?;
    let patch = number("TORCH_VERSION_PATCH")?;
    Some(format!("{major}.{minor}.{patch}"))
}

/// Whether a version is the one needed; what follows a `+` names the kind of build (`2.13.0+cpu`).
pub fn is_right(version: &str) -> bool {
    version.split('+').next() == Some(VERSION)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn environment(libtorch: Option<&str>) -> Environment {
        Environment {
            link: "/repository/.libtorch".into(),
            libtorch: libtorch.map(OsString::from),
            ..Environment::default()
        }
    }

    #[test]
    fn the_value_of_the_cargo_configuration_means_ours() {
        assert_eq!(choose(&environment(None)), Choice::Ours);
        assert_eq!(choose(&environment(Some("/repository/.libtorch"))), Choice::Ours);
    }

    #[test]
    fn what_the_user_set_wins() {
        let folder = environment(Some("/opt/libtorch"));
        assert_eq!(choose(&folder), Choice::Folder("/opt/libtorch".into()));
        let both = Environment { use_pytorch: true, ..folder };
        assert_eq!(choose(&both), Choice::Pytorch);
    }

    #[test]
    fn the_version_is_read_from_a_header() {
        let header = "#pragma once\n/// Major\n#define TORCH_VERSION_MAJOR 2\n\
                      #define TORCH_VERSION_MINOR 13\n#define TORCH_VERSION_PATCH 0\n\
                      #define TORCH_VERSION \\\n";
        assert_eq!(version_in_header(header).as_deref(), Some("2.13.0"));
        assert_eq!(version_in_header("#define TORCH_VERSION_MAJOR 2"), None);
    }

    #[test]
    fn the_kind_of_build_does_not_matter() {
        assert!(is_right("2.13.0"));
        assert!(is_right("2.13.0+cpu"));
        assert!(!is_right("2.13.1"));
        assert!(!is_right("2.1"));
    }

    #[test]
    fn a_folder_of_another_version_is_refused() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::create_dir(folder.path().join("lib")).expect("a folder");
        std::fs::write(folder.path().join("build-version"), "2.5.1+cpu\n").expect("a file");
        let choice = Choice::Folder(folder.path().into());

        let refused = check_users(&choice, &environment(None)).expect_err("a wrong version");
        let message = refused.to_string();
        assert!(message.contains("2.5.1+cpu") && message.contains(VERSION), "{message}");

        let bypass = Environment { bypass_version_check: true, ..environment(None) };
        assert!(check_users(&choice, &bypass).is_ok());
    }

    #[test]
    fn a_folder_that_is_none_is_refused() {
        for (folder, words) in
            [("/nowhere/libtorch", "is not a folder"), ("libtorch", "not an absolute path")]
        {
            let choice = Choice::Folder(folder.into());
            let error = check_users(&choice, &environment(None)).expect_err("no such folder");
            assert!(error.to_string().contains(words), "{error}");
        }
    }
}
