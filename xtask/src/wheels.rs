//! Where libtorch comes from: wheels of the Python package index, fetched by pip, and the few of
//! their files that a build needs.
//!
//! The index has no package of only libtorch, but the wheel of torch holds the C++ headers and
//! libraries. Only its CPU library is taken. That library was built with CUDA support and needs
//! two of CUDA's own libraries, which come from wheels of their own; no GPU is needed.
//! Wheels are pinned by version and digest, so everybody's libtorch is the same.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use zip::ZipArchive;

/// What pip is to fetch. The digests are those of the one wheel that [`PIP_ARGUMENTS`] select.
const REQUIREMENTS: &str = "\
torch==2.13.0 --hash=sha256:60fcdcb2f3876e21146cb4524ef06397d727ca9ad5f020818547e25075fe3cb7
nvidia-cuda-runtime==13.0.96 --hash=sha256:7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548
nvidia-cuda-cupti==13.0.85 --hash=sha256:4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8
";

/// The same wheels whatever Python runs pip: nothing of Python's part is used. No cache of pip,
/// which would keep half a gigabyte for a download that happens once.
const PIP_ARGUMENTS: &str = "-m pip download --no-cache-dir --no-deps --only-binary=:all: \
    --require-hashes --disable-pip-version-check --no-input \
    --python-version 3.11 --implementation cp --abi cp311 \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_25_x86_64 \
    --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64";

/// What a libtorch folder must hold for a build to succeed and its binaries to start.
pub const LIBRARIES: [&str; 7] = [
    "libtorch.so",
    "libtorch_cpu.so",
    "libc10.so",
    "libgomp.so",
    "libgomp.so.1",
    "libcudart.so.13",
    "libcupti.so.13",
];

/// torch-sys links `-ltorch`; the wheel's libtorch.so would drag in the GPU libraries.
const LIBTORCH_SO: &str = "INPUT(libtorch_cpu.so)\n";

/// Downloads the wheels into `staging`/wheels, with pip's temporary files in `staging` too, where
/// the room was checked and where a later run clears up after a broken one.
pub fn download(staging: &Path) -> Result<PathBuf> {
    let wheels = staging.join("wheels");
    let temporary = staging.join("tmp");
    let requirements = staging.join("requirements.txt");
    for folder in [&wheels, &temporary] {
        fs::create_dir_all(folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
    }
    fs::write(&requirements, REQUIREMENTS)
        .with_context(|| format!("cannot write {}", requirements.display()))?;

    let mut pip = Command::new("python3")
        .args(PIP_ARGUMENTS.split_whitespace())
        .arg("--dest")
        .arg(&wheels)
        .arg("--requirement")
        .arg(&requirements)
        .env("TMPDIR", &temporary)
        .stdin(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .context("pip could not be started")?;
    // pip's progress goes to the terminal by itself. Its errors are printed here, one by one, for it
    // can try again for minutes; they are kept too, for our own message.
    let mut complaints = Vec::new();
    if let Some(stderr) = pip.stderr.take() {
        for line in BufReader::new(stderr).lines().map_while(io::Result::ok) {
            eprintln!("{line}");
            complaints.push(line);
        }
    }
    let status = pip.wait().context("pip could not be waited for")?;
    if !status.success() {
        bail!(
            "the download of libtorch failed: pip says: {}; check the network (pip's settings for \
             proxies and mirrors hold), then run `cargo xtask torch` again",
            last_complaint(&complaints)
        );
    }
    Ok(wheels)
}

/// The line of pip's output that says what went wrong.
fn last_complaint(lines: &[String]) -> &str {
    let is_error = |line: &&String| line.starts_with("ERROR:");
    let spoken = |line: &&String| !line.trim().is_empty();
    lines
        .iter()
        .rfind(is_error)
        .or_else(|| lines.iter().rfind(spoken))
        .map_or("nothing", |line| line.trim())
}

/// Lays out `libtorch` (include/, lib/) from the wheels in a folder.
pub fn unpack(wheels: &Path, libtorch: &Path) -> Result<()> {
    let mut found = 0;
    for entry in fs::read_dir(wheels).with_context(|| format!("reading {}", wheels.display()))? {
        let wheel = entry.with_context(|| format!("reading {}", wheels.display()))?.path();
        found += unpack_wheel(&wheel, libtorch)
            .with_context(|| format!("cannot unpack {}", wheel.display()))?;
    }
    if found == 0 {
        bail!("the wheels in {} hold nothing of libtorch", wheels.display());
    }
    let lib = libtorch.join("lib");
    fs::create_dir_all(&lib)
        .and_then(|()| fs::write(lib.join("libtorch.so"), LIBTORCH_SO))
        // The linker looks for -lgomp. Without this it would take the compiler's, if it has one.
        .and_then(|()| std::os::unix::fs::symlink("libgomp.so.1", lib.join("libgomp.so")))
        .with_context(|| format!("cannot complete {}", lib.display()))?;
    Ok(())
}

/// Takes the needed files out of one wheel and returns how many. The archive is read in place: of
/// the 1.3 GB in torch's wheel less than half touches the disk.
fn unpack_wheel(wheel: &Path, libtorch: &Path) -> Result<usize> {
    let mut archive = ZipArchive::new(BufReader::new(File::open(wheel)?))?;
    let mut count = 0;
    for index in 0..archive.len() {
        let mut member = archive.by_index(index)?;
        let Some(place) = place_of(member.name()) else { continue };
        let path = libtorch.join(&place);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent)?;
        }
        let mut file = File::create(&path)?;
        io::copy(&mut member, &mut file).with_context(|| format!("writing {place}"))?;
        count += 1;
    }
    Ok(count)
}

/// Where a wheel's member goes in the libtorch folder, if it is needed.
fn place_of(member: &str) -> Option<String> {
    if member.ends_with('/') || member.split('/').any(|part| part == "..") {
        return None;
    }
    if member.starts_with("torch/include/") {
        return member.strip_prefix("torch/").map(str::to_owned);
    }
    let name = match member.strip_prefix("torch/lib/") {
        // We write a libtorch.so of our own, see LIBTORCH_SO.
        Some("libtorch.so") => return None,
        Some(name) => name,
        None => member.strip_prefix("nvidia/cu13/lib/")?,
    };
    LIBRARIES.contains(&name).then(|| format!("lib/{name}"))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn only_headers_and_the_cpu_libraries_are_taken() {
        let place = |member| place_of(member);
        assert_eq!(place("torch/include/ATen/ATen.h").as_deref(), Some("include/ATen/ATen.h"));
        assert_eq!(place("torch/lib/libc10.so").as_deref(), Some("lib/libc10.so"));
        assert_eq!(place("nvidia/cu13/lib/libcupti.so.13").as_deref(), Some("lib/libcupti.so.13"));
        for member in [
            "torch/lib/libtorch_cuda.so",
            "torch/lib/libtorch.so",
            "torch/include/",
            "torch/include/../../etc/passwd",
            "torch/nn/modules/linear.py",
        ] {
            assert_eq!(place_of(member), None, "{member}");
        }
    }

    #[test]
    fn wheels_become_a_libtorch_folder() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let wheels = folder.path().join("wheels");
        fs::create_dir(&wheels).expect("a folder");
        let file = File::create(wheels.join("torch.whl")).expect("a file");
        let mut wheel = zip::ZipWriter::new(file);
        for name in ["torch/include/torch/torch.h", "torch/lib/libtorch_cpu.so", "torch/a.py"] {
            wheel.start_file(name, zip::write::FileOptions::default()).expect("a member");
            wheel.write_all(name.as_bytes()).expect("its content");
        }
        wheel.finish().expect("an archive");

        let libtorch = folder.path().join("libtorch");
        unpack(&wheels, &libtorch).expect("to unpack");
        let header = fs::read_to_string(libtorch.join("include/torch/torch.h"));
        assert_eq!(header.expect("a header"), "torch/include/torch/torch.h");
        let script = fs::read_to_string(libtorch.join("lib/libtorch.so")).expect("a script");
        assert_eq!(script, LIBTORCH_SO);
        assert!(!libtorch.join("a.py").exists());
    }

    #[test]
    fn a_damaged_wheel_is_named() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::write(folder.path().join("torch.whl"), "half of it").expect("a file");
        let error = unpack(folder.path(), &folder.path().join("x")).expect_err("not an archive");
        assert!(format!("{error:#}").contains("torch.whl"), "{error:#}");
    }

    #[test]
    fn the_error_of_pip_is_told_from_its_chatter() {
        let lines =
            ["WARNING: Retrying", "ERROR: No matching distribution", "", "[notice] new pip"]
                .map(str::to_owned);
        assert_eq!(last_complaint(&lines), "ERROR: No matching distribution");
        assert_eq!(last_complaint(&["odd".to_owned(), String::new()]), "odd");
        assert_eq!(last_complaint(&[]), "nothing");
    }

    #[test]
    fn every_requirement_is_pinned_by_digest() {
        assert!(REQUIREMENTS.contains(&format!("torch=={}", crate::libtorch::VERSION)));
        for line in REQUIREMENTS.lines() {
            let digest = line.split("--hash=sha256:").nth(1).expect("a digest");
            assert_eq!(digest.len(), 64, "{line}");
        }
    }
}
