//! What can happen to a run, and that it ends with the same bits all the same: signals, kills, damaged
//! files, full disks, crashed workers, two programs in one folder.
#![cfg(unix)]

#[path = "support/program.rs"]
mod support;

use cvar_game::experiment::tensorboard;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use support::{program, succeed, without_timing};
use tempfile::TempDir;

/// A sweep of two runs in each world: 30 updates each, in a second or two.
const CONFIG: &str = r#"
[experiment]
etas = [25]
seeds = [1, 2]
[train]
steps = 60_000
parallel_episodes = 50
budget_wait = 0.2
budget_rise = 0.2
[train.protagonist]
minibatch = 500
[train.antagonist]
minibatch = 500
[checkpoint]
every = 4
[evaluation]
episodes = 300
figure_episodes = 300
"#;

const RUNS: [&str; 4] = [
    "lava-grid/game/eta-25/seed-1",
    "lava-grid/game/eta-25/seed-2",
    "lava-point/game/eta-25/seed-1",
    "lava-point/game/eta-25/seed-2",
];

/// A configuration file with an output folder beside it.
struct Sweep {
    folder: TempDir,
}

impl Sweep {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("faults.toml"), CONFIG).unwrap();
        Sweep { folder }
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn run(&self, run: &str) -> PathBuf {
        self.out().join(run)
    }

    fn command(&self, verb: &str, rest: &[&str]) -> Command {
        let mut command = program(verb);
        command.arg("--config").arg(self.folder.path().join("faults.toml"));
        command.arg("--out").arg(self.out()).args(rest);
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn bench(&self, rest: &[&str]) -> Output {
        self.command("bench", rest).output().unwrap()
    }

    /// The first run of a world, by `train`.
    fn train(&self, world: &str) -> Command {
        self.command("train", &["--env", world, "--eta", "25", "--seed", "1"])
    }
}

/// Everything in a run's folder that may not depend on what happened to it.
fn result(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let bytes = fs::read(&path).unwrap();
        let bytes = match name.as_str() {
            ".lock" => continue,
            "progress.csv" => without_timing(str::from_utf8(&bytes).unwrap()).into_bytes(),
            "evaluation.json" | "manifest.json" => {
                let mut json: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
                json["seconds"] = 0.into();
                json["evaluation_seconds"] = 0.into();
                json.to_string().into_bytes()
            }
            // Its events have wall-clock times; that none is lost or doubled shows in its length.
            tensorboard::FILE => bytes.len().to_string().into_bytes(),
            _ => bytes,
        };
        files.insert(name, bytes);
    }
    files
}

/// What the sweep comes to if nothing happens to it.
fn undisturbed() -> &'static BTreeMap<String, BTreeMap<String, Vec<u8>>> {
    static RESULT: std::sync::OnceLock<BTreeMap<String, BTreeMap<String, Vec<u8>>>> =
        std::sync::OnceLock::new();
    RESULT.get_or_init(|| {
        let sweep = Sweep::new();
        succeed(&mut sweep.command("bench", &["--jobs", "2"]));
        let mut results: BTreeMap<_, _> =
            RUNS.map(|run| (run.to_owned(), result(&sweep.run(run)))).into();
        results.insert("sweep".into(), BTreeMap::from([("runs.csv".into(), table(&sweep))]));
        results
    })
}

/// `runs.csv` without its timing.
fn table(sweep: &Sweep) -> Vec<u8> {
    without_timing(&fs::read_to_string(sweep.out().join("runs.csv")).unwrap()).into_bytes()
}

#[track_caller]
fn assert_undisturbed(sweep: &Sweep, run: &str) {
    let (found, expected) = (result(&sweep.run(run)), &undisturbed()[run]);
    let names = |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&found), names(expected), "files of {run}");
    for (name, bytes) in expected {
        assert!(found[name] == *bytes, "{name} of {run} is another");
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn signal(child: &Child, name: &str) {
    let pid = child.id().to_string();
    assert!(Command::new("kill").args([name, &pid]).status().unwrap().success());
}

/// Waits for a file to appear.
fn await_file(path: &Path) {
    let start = Instant::now();
    while !path.exists() {
        assert!(start.elapsed() < Duration::from_secs(120), "{} does not appear", path.display());
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Starts a run by `train` and ends it by a signal when it has written a checkpoint.
fn cut_short(sweep: &Sweep, world: &str, checkpoint: u64, by: &str) -> Output {
    let child = sweep.train(world).spawn().unwrap();
    let folder = sweep.run(&format!("{world}/game/eta-25/seed-1"));
    await_file(&folder.join(format!("checkpoint-{checkpoint}.bin")));
    signal(&child, by);
    child.wait_with_output().unwrap()
}

fn checkpoints(folder: &Path) -> Vec<PathBuf> {
    cvar_game::experiment::checkpoint::list(folder).unwrap()
}

#[test]
fn a_run_stopped_by_sigterm_says_so_and_goes_on_to_the_same_bits() {
    for world in ["lava-grid", "lava-point"] {
        let sweep = Sweep::new();
        let stopped = cut_short(&sweep, world, 8, "-TERM");
        assert_eq!(stopped.status.code(), Some(75), "{}", stderr(&stopped));
        assert!(stderr(&stopped).contains("the same command continues"), "{}", stderr(&stopped));
        let folder = sweep.run(&format!("{world}/game/eta-25/seed-1"));
        assert!(!folder.join("evaluation.json").exists());
        let resumed = sweep.train(world).output().unwrap();
        assert!(resumed.status.success(), "{}", stderr(&resumed));
        assert!(stderr(&resumed).contains("continues after update"), "{}", stderr(&resumed));
        assert_undisturbed(&sweep, &format!("{world}/game/eta-25/seed-1"));
    }
}

#[test]
fn a_killed_run_goes_on_to_the_same_bits() {
    for world in ["lava-grid", "lava-point"] {
        let sweep = Sweep::new();
        for checkpoint in [4, 12, 20] {
            cut_short(&sweep, world, checkpoint, "-KILL");
        }
        assert!(sweep.train(world).output().unwrap().status.success());
        assert_undisturbed(&sweep, &format!("{world}/game/eta-25/seed-1"));
    }
}

#[test]
fn a_stopped_sweep_leaves_checkpoints_and_goes_on_to_the_same_bits() {
    let sweep = Sweep::new();
    let child = sweep.command("bench", &["--jobs", "2"]).spawn().unwrap();
    await_file(&sweep.run(RUNS[0]).join("checkpoint-4.bin"));
    signal(&child, "-TERM");
    let stopped = child.wait_with_output().unwrap();
    assert_eq!(stopped.status.code(), Some(75), "{}", stderr(&stopped));
    assert!(!checkpoints(&sweep.run(RUNS[0])).is_empty());
    let resumed = sweep.bench(&["--jobs", "2"]);
    assert!(resumed.status.success(), "{}", stderr(&resumed));
    assert!(stderr(&resumed).contains("continues after update"), "{}", stderr(&resumed));
    RUNS.iter().for_each(|run| assert_undisturbed(&sweep, run));
    assert_eq!(table(&sweep), undisturbed()["sweep"]["runs.csv"]);
}

#[test]
fn a_damaged_checkpoint_is_told_and_the_one_before_it_is_taken() {
    type Spoil = fn(&Path);
    let cut: Spoil = |path| {
        let bytes = fs::read(path).unwrap();
        fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    };
    let flip: Spoil = |path| {
        let mut bytes = fs::read(path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        fs::write(path, bytes).unwrap();
    };
    let empty: Spoil = |path| fs::write(path, "").unwrap();
    let version: Spoil = |path| {
        let mut bytes = fs::read(path).unwrap();
        bytes[8] = 77;
        fs::write(path, bytes).unwrap();
    };
    for (spoil, told) in [
        (cut, "is damaged"),
        (flip, "is damaged"),
        (empty, "is not a checkpoint"),
        (version, "has schema version 77"),
    ] {
        let sweep = Sweep::new();
        cut_short(&sweep, "lava-grid", 8, "-KILL");
        let found = checkpoints(&sweep.run(RUNS[0]));
        assert_eq!(found.len(), 2, "{found:?}");
        spoil(&found[0]);
        let resumed = sweep.train("lava-grid").output().unwrap();
        let name = found[0].file_name().unwrap().to_str().unwrap();
        let told = format!("{name} {told}");
        assert!(stderr(&resumed).contains(&told), "{told}: {}", stderr(&resumed));
        assert!(stderr(&resumed).contains("continues after update"), "{}", stderr(&resumed));
        assert_undisturbed(&sweep, RUNS[0]);
    }
}

#[test]
fn without_a_sound_checkpoint_the_run_starts_from_scratch() {
    let sweep = Sweep::new();
    cut_short(&sweep, "lava-grid", 8, "-KILL");
    // Checkpoints are of no use without the lines of progress that they count on.
    fs::write(sweep.run(RUNS[0]).join("progress.csv"), "update,steps\n").unwrap();
    let resumed = sweep.train("lava-grid").output().unwrap();
    assert_eq!(stderr(&resumed).matches("progress.csv").count(), 2, "{}", stderr(&resumed));
    assert!(!stderr(&resumed).contains("continues after"), "{}", stderr(&resumed));
    assert_undisturbed(&sweep, RUNS[0]);
}

#[test]
fn the_checkpoint_of_another_run_is_not_taken() {
    let sweep = Sweep::new();
    cut_short(&sweep, "lava-grid", 8, "-KILL");
    let newest = checkpoints(&sweep.run(RUNS[0])).remove(0);
    let other = sweep.run(RUNS[1]);
    fs::create_dir_all(&other).unwrap();
    let config = fs::read_to_string(sweep.run(RUNS[0]).join("config.toml")).unwrap();
    let config = config.replace("\nseed = 1\n", "\nseed = 2\n").replace("seed-1", "seed-2");
    fs::write(other.join("config.toml"), config).unwrap();
    fs::copy(&newest, other.join("checkpoint-8.bin")).unwrap();
    fs::copy(sweep.run(RUNS[0]).join("progress.csv"), other.join("progress.csv")).unwrap();
    let output = sweep.bench(&["--only", RUNS[1]]);
    assert!(stderr(&output).contains("it is of another configuration"), "{}", stderr(&output));
    assert_undisturbed(&sweep, RUNS[1]);
}

#[test]
fn a_full_disk_fails_the_run_and_loses_nothing() {
    let sweep = Sweep::new();
    assert!(sweep.bench(&["--only", RUNS[2]]).status.success());
    // A limit of 8 blocks of 512 bytes: the writes of this run fail as on a full disk.
    let train = sweep.train("lava-grid");
    let mut limited = Command::new("sh");
    limited.args(["-c", "trap '' XFSZ; ulimit -f 8; exec \"$0\" \"$@\""]);
    limited.arg(train.get_program()).args(train.get_args()).stdin(Stdio::null());
    let failed = limited.output().unwrap();
    assert_eq!(failed.status.code(), Some(1), "{}", stderr(&failed));
    assert!(stderr(&failed).contains("File too large"), "{}", stderr(&failed));
    let again = sweep.bench(&["--jobs", "2"]);
    assert!(again.status.success(), "{}", stderr(&again));
    RUNS.iter().for_each(|run| assert_undisturbed(&sweep, run));
}

#[test]
fn a_killed_worker_is_reported_the_others_go_on_and_it_is_taken_up_again() {
    let sweep = Sweep::new();
    let child = sweep.command("bench", &["--jobs", "1"]).spawn().unwrap();
    await_file(&sweep.run(RUNS[0]).join("checkpoint-4.bin"));
    let parent = child.id().to_string();
    let killed = Command::new("pkill").args(["-KILL", "-P", &parent]).status().unwrap();
    assert!(killed.success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let told = format!("{} failed: its worker was killed by signal 9", RUNS[0]);
    assert!(stderr(&output).contains(&told), "{}", stderr(&output));
    RUNS[1..].iter().for_each(|run| assert_undisturbed(&sweep, run));
    let again = sweep.bench(&[]);
    assert!(again.status.success(), "{}", stderr(&again));
    assert!(stderr(&again).contains("3 finished before, 1 to do"), "{}", stderr(&again));
    assert!(stderr(&again).contains("continues after update"), "{}", stderr(&again));
    assert_undisturbed(&sweep, RUNS[0]);
}

#[test]
fn two_programs_in_one_folder_do_every_run_once() {
    let sweep = Sweep::new();
    let first = sweep.command("bench", &["--jobs", "1"]).spawn().unwrap();
    let second = sweep.command("bench", &["--jobs", "1"]).spawn().unwrap();
    let outputs = [first, second].map(|child| child.wait_with_output().unwrap());
    for output in &outputs {
        assert!(output.status.success(), "{}", stderr(output));
    }
    let told: String = outputs.iter().map(stderr).collect();
    assert!(!told.contains("continues after"), "{told}");
    RUNS.iter().for_each(|run| assert_undisturbed(&sweep, run));
    assert_eq!(table(&sweep), undisturbed()["sweep"]["runs.csv"]);
}

#[test]
fn one_run_of_a_sweep_can_be_asked_for() {
    let sweep = Sweep::new();
    let output = sweep.bench(&["--only", RUNS[3]]);
    assert!(output.status.success() && output.stdout.is_empty(), "{}", stderr(&output));
    assert_undisturbed(&sweep, RUNS[3]);
    assert!(!sweep.run(RUNS[0]).exists() && !sweep.out().join("runs.csv").exists());
    let output = sweep.bench(&["--only", "lava-grid/game/eta-25/seed-3"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        stderr(&output).contains("has no such run; its first one is lava-grid/game/eta-25/seed-1")
    );
}

#[test]
fn a_folder_that_cannot_be_written_is_refused() {
    let sweep = Sweep::new();
    // /proc takes no folders, not even from root.
    let mut command = program("bench");
    command.args(["--out", "/proc/cvar-game", "--config"]);
    let output = command.arg(sweep.folder.path().join("faults.toml")).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("cannot write to /proc/cvar-game"), "{}", stderr(&output));
}

/// Whether a process of this sweep is left.
fn someone_works_in(out: &Path) -> bool {
    RUNS.iter().any(|run| {
        let folder = out.join(run);
        let lock = cvar_game::experiment::lock::RunLock::take(&folder);
        folder.exists() && lock.unwrap().is_none()
    })
}

#[test]
#[ignore = "a drill of minutes: 50 kills of a sweep and its workers at random moments"]
fn fifty_kills_change_nothing() {
    use rand::RngExt;
    let sweep = Sweep::new();
    let mut random =
        lava_envs::random::stream(1, lava_envs::random::Purpose::Bootstrap, u64::from(u32::MAX));
    let (mut kills, mut attempts) = (0, 0);
    while kills < 50 {
        attempts += 1;
        let mut child = sweep.command("bench", &["--jobs", "2"]).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(random.random_range(50..1500)));
        if child.try_wait().unwrap().is_some() {
            // It has finished: the drill continues with the same runs from the beginning.
            RUNS.iter().for_each(|run| assert_undisturbed(&sweep, run));
            assert_eq!(table(&sweep), undisturbed()["sweep"]["runs.csv"]);
            fs::remove_dir_all(sweep.out()).unwrap();
            continue;
        }
        // Every other time the workers are killed as well, before or after their parent.
        let workers = || {
            let parent = child.id().to_string();
            let _ = Command::new("pkill").args(["-KILL", "-P", &parent]).status();
        };
        if random.random_bool(0.5) {
            workers();
        }
        signal(&child, "-KILL");
        child.wait().unwrap();
        kills += 1;
    }
    let last = sweep.bench(&["--jobs", "2"]);
    assert!(last.status.success(), "{}", stderr(&last));
    RUNS.iter().for_each(|run| assert_undisturbed(&sweep, run));
    assert_eq!(table(&sweep), undisturbed()["sweep"]["runs.csv"]);
    assert!(!someone_works_in(&sweep.out()));
    eprintln!("{kills} kills in {attempts} attempts");
}
