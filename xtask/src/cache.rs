//! The user's cache: one folder per version of libtorch, shared by all checkouts.
//!
//! A libtorch is made ready in a staging folder next to its place and moved there by one rename, so
//! a broken download is not mistaken for a libtorch. A file lock admits one set-up at a time;
//! the kernel releases it when the process ends, so no lock outlasts its process.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};

use crate::libtorch::{self, Environment, VERSION};
use crate::{tools, wheels};

/// Room for one download: pip holds torch's wheel (527 MB) twice for a moment; afterwards the
/// wheels (540 MB) and the unpacked files (490 MB) are there together.
const ROOM_NEEDED: u64 = 1_300_000_000;

/// How the names of staging folders begin.
const STAGING: &str = ".partial-";

/// The cache of this program in the user's cache.
pub fn root(environment: &Environment) -> Result<PathBuf> {
    match &environment.caches {
        Some(caches) if caches.is_absolute() => Ok(caches.join("cvar-game")),
        _ => bail!("no place for libtorch: set HOME or XDG_CACHE_HOME to an absolute path"),
    }
}

fn folder_name() -> String {
    format!("libtorch-{VERSION}-cpu-x86_64")
}

/// Returns the folder of our libtorch in the cache, after fetching it if it is absent or incomplete.
pub fn provide(root: &Path) -> Result<PathBuf> {
    let libtorch = root.join(folder_name());
    if check(&libtorch).is_ok() {
        println!("libtorch {VERSION} is in {}", libtorch.display());
        return Ok(libtorch);
    }

    create(root)?;
    let _lock = lock(root)?;
    // Another set-up may have done the work while this one waited.
    match check(&libtorch) {
        Ok(()) => return Ok(libtorch),
        Err(fault) if libtorch.exists() => eprintln!("{fault}; fetching it again"),
        Err(_) => {}
    }

    clear_stale(root)?;
    tools::check_pip()?;
    check_room(root)?;
    println!("fetching libtorch {VERSION} (540 MB) into {}", root.display());
    // Its name is new each time: the pip of a killed set-up may still run and write into the old one.
    let staging = tempfile::Builder::new()
        .prefix(STAGING)
        .tempdir_in(root)
        .with_context(|| format!("cannot create a folder in {}", root.display()))?;
    let made = make(staging.path(), &libtorch);
    // The half gigabyte is removed in any case; an error of `make` is more precise than ours.
    let cleared = staging.close().context("cannot remove what was downloaded");
    made.and(cleared)?;
    println!("libtorch {VERSION} is in {}", libtorch.display());
    Ok(libtorch)
}

/// Removes the folders of killed set-ups. While the lock is held, no other set-up works.
fn clear_stale(root: &Path) -> Result<()> {
    let reading = || format!("cannot read {}", root.display());
    for entry in fs::read_dir(root).with_context(reading)? {
        let entry = entry.with_context(reading)?;
        if entry.file_name().to_string_lossy().starts_with(STAGING) {
            let path = entry.path();
            fs::remove_dir_all(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
        }
    }
    Ok(())
}

fn make(staging: &Path, libtorch: &Path) -> Result<()> {
    let wheels = wheels::download(staging)?;
    println!("unpacking");
    let fresh = staging.join("libtorch");
    wheels::unpack(&wheels, &fresh)?;
    let header = libtorch::version_in(&fresh).unwrap_or_else(|| "unknown".into());
    ensure!(
        libtorch::is_right(&header),
        "the fetched package holds libtorch of version {header}, but {VERSION} is needed; \
         nothing was set up"
    );
    fs::write(fresh.join("build-version"), format!("{VERSION}\n"))
        .with_context(|| format!("cannot write into {}", fresh.display()))?;
    check(&fresh)?;

    // A damaged libtorch is moved away by a rename too, so its place never holds a part of one.
    if libtorch.exists() {
        let old = staging.join("old");
        fs::rename(libtorch, &old)
            .with_context(|| format!("cannot move {} away", libtorch.display()))?;
    }
    fs::rename(&fresh, libtorch)
        .with_context(|| format!("cannot move libtorch to {}", libtorch.display()))
}

/// Checks that a libtorch of ours is complete and of the right version.
fn check(libtorch: &Path) -> Result<()> {
    let shown = libtorch.display();
    let version = libtorch::version_in(libtorch).unwrap_or_else(|| "unknown".into());
    ensure!(
        libtorch::is_right(&version),
        "libtorch in {shown} has version {version}, not {VERSION}"
    );
    let needed = ["include/torch/csrc/api/include/torch/torch.h".to_owned()]
        .into_iter()
        .chain(wheels::LIBRARIES.map(|name| format!("lib/{name}")));
    for file in needed {
        ensure!(libtorch.join(&file).is_file(), "libtorch in {shown} lacks {file}");
    }
    Ok(())
}

/// Points the repository's link at a libtorch.
pub fn link(libtorch: &Path, link: &Path) -> Result<()> {
    if fs::read_link(link).is_ok_and(|target| target == libtorch) {
        return Ok(());
    }
    ensure!(
        link.is_symlink() || !link.exists(),
        "{} is in the way: it should be a link, made here; move it away",
        link.display()
    );
    // A link cannot be changed in place; a rename replaces it in one step. The name in between is
    // unique, for two set-ups may work on one repository.
    let in_words = || format!("cannot link {} to {}", link.display(), libtorch.display());
    let folder = link.parent().with_context(in_words)?;
    tempfile::Builder::new()
        .prefix(".libtorch-")
        .make_in(folder, |path| std::os::unix::fs::symlink(libtorch, path))
        .with_context(in_words)?
        .into_temp_path()
        .persist(link)
        .with_context(in_words)?;
    println!("linked as {}", link.display());
    // Cargo checks this file's date to see that the link has a new target. A shared cache may
    // be read-only, and then its libtorch has not moved either.
    if let Ok(library) = File::options().append(true).open(libtorch.join("lib/libtorch_cpu.so")) {
        library.set_modified(std::time::SystemTime::now()).ok();
    }
    Ok(())
}

fn lock(root: &Path) -> Result<File> {
    let path = root.join(".lock");
    let in_words = || format!("cannot lock {}", path.display());
    let file = File::create(&path).with_context(in_words)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            println!("another set-up is running; waiting for it");
            file.lock().with_context(in_words)?;
        }
        Err(TryLockError::Error(error)) => return Err(error).with_context(in_words),
    }
    Ok(file)
}

fn check_room(root: &Path) -> Result<()> {
    let free = rustix::fs::statvfs(root)
        .with_context(|| format!("cannot determine the free space of {}", root.display()))?;
    ensure_room(free.f_bavail.saturating_mul(free.f_frsize), root)
}

fn ensure_room(free: u64, root: &Path) -> Result<()> {
    let megabytes = |bytes: u64| bytes / 1_000_000;
    ensure!(
        free >= ROOM_NEEDED,
        "not enough disk in {}: {} MB free, {} MB needed while libtorch is fetched (490 MB stay); \
         free some, or set XDG_CACHE_HOME to a folder on a larger disk",
        root.display(),
        megabytes(free),
        megabytes(ROOM_NEEDED),
    );
    Ok(())
}

fn create(folder: &Path) -> Result<()> {
    fs::create_dir_all(folder).with_context(|| {
        format!(
            "cannot create {}; set XDG_CACHE_HOME to a folder you can write to",
            folder.display()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_needs_an_absolute_folder() {
        let root = |caches: Option<&str>| {
            root(&Environment { caches: caches.map(Into::into), ..Environment::default() }).ok()
        };
        assert_eq!(root(Some("/home/a/.cache")), Some("/home/a/.cache/cvar-game".into()));
        assert_eq!(root(Some(".cache")), None);
        assert_eq!(root(None), None);
    }

    #[test]
    fn too_little_room_says_how_much_and_what_to_do() {
        let error = ensure_room(64_000_000, Path::new("/x")).expect_err("too little");
        let message = error.to_string();
        assert!(message.contains("64 MB free") && message.contains("1300 MB"), "{message}");
        assert!(message.contains("XDG_CACHE_HOME"), "{message}");
    }

    #[test]
    fn a_libtorch_that_lacks_a_library_is_not_whole() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let libtorch = folder.path();
        assert!(check(libtorch).is_err());
        fs::create_dir_all(libtorch.join("lib")).expect("a folder");
        let headers = libtorch.join("include/torch/csrc/api/include/torch");
        fs::create_dir_all(&headers).expect("a folder");
        fs::write(headers.join("torch.h"), "").expect("a file");
        fs::write(libtorch.join("build-version"), VERSION).expect("a file");
        for library in wheels::LIBRARIES {
            assert!(check(libtorch).is_err(), "without {library}");
            fs::write(libtorch.join("lib").join(library), "").expect("a file");
        }
        check(libtorch).expect("to be whole");
        fs::write(libtorch.join("build-version"), "2.12.0").expect("a file");
        assert!(check(libtorch).is_err(), "of another version");
    }

    #[test]
    fn the_link_is_made_changed_and_never_overwrites_a_folder() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let at = folder.path().join(".libtorch");
        for target in ["/a", "/b"] {
            link(Path::new(target), &at).expect("to link");
            assert_eq!(fs::read_link(&at).expect("a link"), Path::new(target));
        }
        fs::remove_file(&at).expect("to remove the link");
        fs::create_dir(&at).expect("a folder");
        assert!(link(Path::new("/a"), &at).is_err());
    }

    /// Two simultaneous set-ups of one repository once failed with "File exists".
    #[test]
    fn set_ups_at_once_agree_on_the_link() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let at = folder.path().join(".libtorch");
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| link(Path::new("/a"), &at).expect("to link"));
            }
        });
        assert_eq!(fs::read_link(&at).expect("a link"), Path::new("/a"));
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1);
    }

    #[test]
    fn what_a_killed_set_up_left_is_cleared() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::create_dir_all(folder.path().join(".partial-Ab12/wheels")).expect("a folder");
        fs::create_dir(folder.path().join(folder_name())).expect("a folder");
        clear_stale(folder.path()).expect("to clear");
        assert!(!folder.path().join(".partial-Ab12").exists());
        assert!(folder.path().join(folder_name()).exists());
    }

    #[test]
    fn a_second_set_up_waits_for_the_first() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let held = lock(folder.path()).expect("the lock");
        let again = File::create(folder.path().join(".lock")).expect("the lock's file");
        assert!(matches!(again.try_lock(), Err(TryLockError::WouldBlock)));
        drop(held);
        again.try_lock().expect("a free lock");
    }
}
