//! Answers that must not be lost: a run that trains what was asked for, a sweep that nobody listens to, results
//! that are damaged, outdated or too large, and files that are no files. Through the command line only.

#[path = "support/program.rs"]
mod support;

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime};
use support::{program, succeed, without_timing};
use tempfile::TempDir;

/// `train` at budget 1, where nothing slow is evaluated, in an output folder.
fn train(env: &str, out: &Path, options: &[&str]) -> Command {
    let mut command = program("train");
    command.args(["--env", env, "--eta", "1", "--seed", "1", "--out"]).arg(out);
    command.args(["--set", "train.steps=10000"]).args(options);
    command
}

/// A finished run in an output folder of its own.
struct Run {
    out: TempDir,
    env: &'static str,
}

impl Run {
    /// A copy of a run that is trained once.
    fn new(env: &'static str) -> Run {
        static GRID: OnceLock<TempDir> = OnceLock::new();
        static POINT: OnceLock<TempDir> = OnceLock::new();
        let once = if env == "lava-grid" { &GRID } else { &POINT };
        let trained = once.get_or_init(|| {
            let out = tempfile::tempdir().unwrap();
            succeed(&mut train(env, out.path(), &["--set", "evaluation.episodes=300"]));
            out
        });
        let out = tempfile::tempdir().unwrap();
        let from = format!("{}/.", trained.path().display());
        succeed(Command::new("cp").args(["-rp", &from]).arg(out.path()));
        Run { out, env }
    }

    /// The run's folder.
    fn folder(&self) -> PathBuf {
        let text = format!("find {} -name progress.csv", self.out.path().display());
        let found = succeed(Command::new("sh").args(["-c", &text]));
        let path = String::from_utf8(found.stdout).unwrap();
        PathBuf::from(path.trim()).parent().unwrap().to_owned()
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder().join(name)
    }

    fn text(&self, name: &str) -> String {
        fs::read_to_string(self.file(name)).unwrap()
    }

    fn config(&self) -> String {
        self.text("config.toml")
    }

    fn progress(&self) -> String {
        without_timing(&self.text("progress.csv"))
    }

    /// When the weights were written.
    fn trained(&self) -> SystemTime {
        fs::metadata(self.file("final.safetensors")).unwrap().modified().unwrap()
    }

    /// The same run again, evaluated on so many episodes.
    fn again(&self, episodes: u64) -> Command {
        let episodes = format!("evaluation.episodes={episodes}");
        train(self.env, self.out.path(), &["--set", &episodes])
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The message of a command that is refused as bad input.
#[track_caller]
fn refusal(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(!stderr(&output).contains("panicked"), "{}", stderr(&output));
    stderr(&output)
}

/// The same command, ended after 20 seconds with exit code 124, with so much address space.
fn bounded(command: &Command, kilobytes: u64) -> Command {
    let mut bounded = Command::new("sh");
    bounded.args(["-c", &format!("ulimit -v {kilobytes}; exec timeout 20 \"$@\""), "sh"]);
    bounded.arg(command.get_program()).args(command.get_args()).stdin(Stdio::null());
    bounded
}

const PLENTY: u64 = 4_000_000;

// What is trained

#[test]
fn steps_that_never_update_the_protagonist_are_refused_before_training() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let mut command = program("train");
    command.args(["--env", "lava-grid", "--eta", "25", "--seed", "1", "--steps", "20000", "--out"]);
    let message = refusal(command.arg(&out));
    for part in ["protagonist is never updated", "eta = 25", "at least 30000"] {
        assert!(message.contains(part), "{message}");
    }
    // A sweep too, for one of its budgets.
    let config = folder.path().join("short.toml");
    let text = "[experiment]\nenvs = [\"lava-grid\"]\netas = [1, 25]\n[train]\nsteps = 20_000\n";
    fs::write(&config, text).unwrap();
    let message = refusal(program("bench").arg("--config").arg(&config).arg("--out").arg(&out));
    assert!(message.contains("at least 30000"), "{message}");
    assert!(!out.exists(), "something was begun");
}

#[test]
fn steps_that_are_rounded_up_are_announced_and_noted() {
    let out = tempfile::tempdir().unwrap();
    let output = succeed(&mut train(
        "lava-grid",
        out.path(),
        &["--steps", "15001", "--set", "evaluation.episodes=300"],
    ));
    let note = "train.steps = 15001 is rounded up to 20000";
    assert!(stderr(&output).contains(note), "{}", stderr(&output));
    let run = Run { out, env: "lava-grid" };
    assert!(run.text("manifest.json").contains(note), "{}", run.text("manifest.json"));
}

// Who listens

/// A sweep of one short run.
fn bench(out: &Path) -> Command {
    let config = out.with_extension("toml");
    let text = "[experiment]\nenvs = [\"lava-grid\"]\netas = [1]\nseeds = [1]\n\
                [train]\nsteps = 10_000\n[evaluation]\nepisodes = 300\n";
    fs::write(&config, text).unwrap();
    let mut command = program("bench");
    command.args(["--jobs", "1", "--config"]).arg(config).arg("--out").arg(out);
    command
}

#[test]
fn a_sweep_ends_with_its_table_whoever_reads_its_progress() {
    let out = tempfile::tempdir().unwrap();
    let full = || File::options().write(true).open("/dev/full").unwrap();
    let output = bench(&out.path().join("full")).stderr(full()).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "standard error is full");
    assert!(String::from_utf8_lossy(&output.stdout).contains("CVaR_1/eta"));

    // `bench 2>&1 | head -1`
    let command = bench(&out.path().join("head"));
    let code = out.path().join("code");
    let mut shell = Command::new("sh");
    let script = "{ \"$@\"; echo $? >\"$CODE\"; } 2>&1 | head -1";
    shell.args(["-c", script, "sh"]).arg(command.get_program()).args(command.get_args());
    let head = succeed(shell.env("CODE", &code).stdin(Stdio::null()));
    assert_eq!(String::from_utf8_lossy(&head.stdout).lines().count(), 1);
    assert_eq!(fs::read_to_string(&code).unwrap().trim(), "0", "its reader left");
    assert!(out.path().join("head/table.md").exists());

    // An answer that cannot be written is lost, and that is an error.
    let output = bench(&out.path().join("full")).stdout(full()).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("cannot write to standard output"), "{}", stderr(&output));
}

#[test]
fn a_refusal_that_nobody_reads_has_its_exit_code() {
    let full = File::options().write(true).open("/dev/full").unwrap();
    let output = program("bench").args(["--config", "no.toml"]).stderr(full).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_request_to_stop_counts_before_the_first_run() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let seeds: Vec<u32> = (0..30_000).collect();
    let config = folder.path().join("many.toml");
    fs::write(&config, format!("experiment.seeds = {seeds:?}\ntrain.steps = 1_000_000_000\n"))
        .unwrap();
    let mut command = program("bench");
    command.arg("--config").arg(&config).arg("--out").arg(&out).stderr(Stdio::null());
    let mut child = command.spawn().unwrap();
    let start = Instant::now();
    // The first thing that it does in its output folder is to look for runs in it.
    while !out.exists() {
        assert!(start.elapsed() < Duration::from_secs(60), "it does not begin");
        std::thread::sleep(Duration::from_millis(1));
    }
    succeed(Command::new("kill").arg(child.id().to_string()));
    assert_eq!(child.wait().unwrap().code(), Some(75));
}

// What is there already

#[test]
fn a_damaged_evaluation_is_named_and_made_again() {
    let run = Run::new("lava-grid");
    let (whole, trained) = (run.text("evaluation.json"), run.trained());
    for damage in [&whole[..whole.len() / 2], "", "{}", "{\"schema\":1}"] {
        fs::write(run.file("evaluation.json"), damage).unwrap();
        let output = succeed(&mut run.again(300));
        let (name, message) = (run.file("evaluation.json"), stderr(&output));
        assert!(message.contains(name.to_str().unwrap()), "{message}");
        assert_eq!(run.text("evaluation.json"), whole);
        assert_eq!(run.trained(), trained, "it was trained again");
    }
    // Who asks for its result gets the name.
    fs::write(run.file("evaluation.json"), &whole[..50]).unwrap();
    let message = refusal(program("evaluate").arg(run.folder()));
    assert!(message.contains("evaluation.json is damaged"), "{message}");
}

#[test]
fn other_settings_of_the_evaluation_need_no_training() {
    let run = Run::new("lava-point");
    let trained = run.trained();
    let output = succeed(&mut run.again(400));
    assert!(stderr(&output).contains("evaluated again, without training"), "{}", stderr(&output));
    assert_eq!(run.trained(), trained, "it was trained again");
    assert!(run.text("evaluation.json").contains("\"episodes\": 400"));
    assert!(run.text("config.toml").contains("\nepisodes = 400\n"));
    let again = succeed(&mut run.again(400));
    assert!(stderr(&again).contains("has finished before"), "{}", stderr(&again));
    // Training is not a matter of the evaluation.
    let message = refusal(run.again(400).args(["--set", "gamma=0.9"]));
    assert!(message.contains("gamma is 1.0 there and 0.9 here"), "{message}");
}

#[test]
fn a_kill_while_a_run_is_evaluated_again_leaves_one_that_continues() {
    let run = Run::new("lava-point");
    let trained = run.trained();
    let mut child = run.again(9_000_000).stderr(Stdio::null()).spawn().unwrap();
    let start = Instant::now();
    while !run.text("config.toml").contains("\nepisodes = 9000000\n") {
        assert!(start.elapsed() < Duration::from_secs(60), "it does not begin");
        assert!(child.try_wait().unwrap().is_none(), "it was refused");
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    // The new configuration must not stand beside the former result.
    assert!(!run.file("evaluation.json").exists());
    succeed(&mut run.again(500));
    assert!(run.text("evaluation.json").contains("\"episodes\": 500"));
    assert_eq!(run.trained(), trained, "it was trained again");
}

#[test]
fn without_weights_another_evaluation_is_refused_and_the_present_one_kept() {
    let run = Run::new("lava-grid");
    fs::remove_file(run.file("final.safetensors")).unwrap();
    let before = run.text("evaluation.json");
    let message = refusal(&mut run.again(400));
    for part in ["evaluation.episodes is 300 there and 400 here", "no final.safetensors", "--out"] {
        assert!(message.contains(part), "{message}");
    }
    assert_eq!(run.text("evaluation.json"), before);
    succeed(&mut run.again(300));
}

#[test]
fn a_packed_run_is_evaluated_again_with_the_weights_beside_the_archive() {
    let run = Run::new("lava-point");
    let folder = run.folder();
    succeed(program("pack").arg(run.out.path()));
    assert!(!folder.join("evaluation.json").exists());
    let output = succeed(&mut run.again(400));
    assert!(stderr(&output).contains("without training"), "{}", stderr(&output));
    // What the tables and figures read of it is beside its new evaluation.
    for file in ["config.toml", "manifest.json", "progress.csv", "figure_data.json"] {
        assert!(folder.join(file).exists(), "{file}");
    }
    assert!(run.text("evaluation.json").contains("\"episodes\": 400"));
    succeed(program("table").arg(run.out.path()));
}

#[test]
fn the_configuration_of_a_run_repeats_it() {
    let run = Run::new("lava-grid");
    let weights = fs::read(run.file("final.safetensors")).unwrap();
    let config = run.file("config.toml");
    let out = tempfile::tempdir().unwrap();
    let arguments = |verb: &str, out: &Path| {
        let mut command = program(verb);
        command.arg("--config").arg(&config).arg("--out").arg(out);
        command
    };
    succeed(&mut arguments("bench", out.path()));
    let repeated = Run { out, env: "lava-grid" };
    assert_eq!(fs::read(repeated.file("final.safetensors")).unwrap(), weights);
    for of in [Run::config, Run::progress] {
        assert_eq!(of(&repeated), of(&run));
    }
    // In the folder of the run there is nothing to do.
    let output = succeed(&mut arguments("bench", run.out.path()));
    assert!(stderr(&output).contains("1 finished before, 0 to do"), "{}", stderr(&output));
    let other = tempfile::tempdir().unwrap();
    let mut command = arguments("train", other.path());
    succeed(command.args(["--env", "lava-grid", "--eta", "1", "--seed", "1"]));
}

#[test]
fn the_configuration_of_a_former_run_and_of_a_variant_repeats_it() {
    let run = Run::new("lava-grid");
    let present = run.text("config.toml");
    let config = run.file("config.toml");
    let resolved = || succeed(program("config").arg("--config").arg(&config)).stdout;
    let expected = resolved();
    let former = present.replace("method = \"game\"\n", "");
    let former = former.replace("figure_episodes", "exhibit_episodes");
    assert_ne!(former, present);
    fs::write(&config, former).unwrap();
    assert_eq!(String::from_utf8(resolved()).unwrap(), String::from_utf8(expected).unwrap());
    fs::write(&config, present.replace("\neta = ", "\nvariant = \"k-1\"\neta = ")).unwrap();
    let printed = String::from_utf8(resolved()).unwrap();
    assert!(printed.contains("name = \"k-1\""), "{printed}");
    fs::write(&config, present.replace("schema = 1", "schema = 9")).unwrap();
    let message = refusal(program("config").arg("--config").arg(&config));
    assert!(message.contains("schema version 9"), "{message}");
}

// What is too large

#[test]
fn episodes_beyond_the_memory_are_refused_with_what_they_need() {
    let run = Run::new("lava-grid");
    for (episodes, needs) in [("18446744073709551615", "GB"), ("10_000_000_000", "2000 GB")] {
        let mut command = program("evaluate");
        command.arg(run.folder()).args(["--episodes", episodes]);
        let message = refusal(&mut bounded(&command, PLENTY));
        assert!(message.contains(needs) && message.contains("10000000"), "{message}");
    }
    for key in ["evaluation.episodes", "train.protagonist.minibatch", "checkpoint.every"] {
        let out = tempfile::tempdir().unwrap();
        let mut command = train("lava-grid", out.path(), &["--set"]);
        command.arg(format!("{key}=9223372036854775807"));
        let message = refusal(&mut bounded(&command, PLENTY));
        assert!(message.contains(key) && message.contains("10000000"), "{message}");
    }
}

#[test]
fn a_rollout_of_any_length_is_written_row_by_row() {
    let run = Run::new("lava-grid");
    for episodes in ["10000000000", "18446744073709551615"] {
        let mut command = program("rollout");
        // The option by which former versions name the folder.
        command.args(["--episodes", episodes, "--run"]).arg(run.folder());
        let mut child = bounded(&command, PLENTY)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines: Vec<String> = BufReader::new(child.stdout.take().unwrap())
            .lines()
            .take(3)
            .map(Result::unwrap)
            .collect();
        let output = child.wait_with_output().unwrap();
        assert_eq!(lines.len(), 3, "{}", stderr(&output));
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    }
}

#[test]
fn a_rollout_in_training_that_needs_too_much_memory_is_refused_with_its_size() {
    let out = tempfile::tempdir().unwrap();
    for parallel in [1_000_000, 200_000] {
        let mut command = train("lava-grid", out.path(), &["--set", "train.steps=100000000"]);
        command.args(["--set", "train.rollout_steps=10", "--set"]);
        command.arg(format!("train.parallel_episodes={parallel}"));
        if parallel == 1_000_000 {
            let message = refusal(&mut bounded(&command, PLENTY));
            assert!(message.contains("5.0 GB") && message.contains("at most"), "{message}");
        } else {
            let resolved = program("config")
                .args(command.get_args().skip_while(|of| *of != "--set"))
                .output()
                .unwrap();
            assert!(resolved.status.success(), "{}", stderr(&resolved));
        }
    }
}

#[test]
fn constants_beyond_their_ranges_are_refused() {
    let out = tempfile::tempdir().unwrap();
    for (env, constant, range) in [
        ("lava-point", "control_step=1e-300", "at least 0.001"),
        ("lava-point", "step_cost=1e308", "at most 1000000"),
        ("lava-grid", "step_cost=1e308", "at most 1000000"),
        ("lava-grid", "goal_reward=-1e300", "at least -1000000"),
        ("lava-point", "lava_reward=1e300", "at most 1000000"),
        ("lava-grid", "horizon=4000000000", "from 1 to 1000000"),
    ] {
        let mut command = train(env, out.path(), &["--set"]);
        let message = refusal(&mut bounded(command.arg(format!("env.{constant}")), PLENTY));
        assert!(message.contains(range), "{message}");
    }
    let mut command = train("lava-point", out.path(), &["--set", "train.initial_std=1e308"]);
    assert!(refusal(&mut bounded(&command, PLENTY)).contains("at most 1000"));
    // At the bounds there is a run.
    command = train("lava-point", out.path(), &["--set", "env.step_cost=1000000"]);
    succeed(command.args(["--set", "env.control_step=0.001", "--set", "evaluation.episodes=300"]));
}

// What is no file

/// Puts a pipe that nobody writes to in the place of a file.
fn pipe(path: &Path) {
    let _ = fs::remove_file(path);
    succeed(Command::new("mkfifo").arg(path));
}

#[test]
fn a_pipe_in_the_place_of_a_file_keeps_nobody_waiting() {
    // A configuration.
    let run = Run::new("lava-grid");
    let config = run.out.path().join("pipe.toml");
    pipe(&config);
    let mut command = program("bench");
    command.arg("--config").arg(&config);
    let message = refusal(&mut bounded(&command, PLENTY));
    assert!(message.contains("pipe.toml") && message.contains("regular file"), "{message}");

    // Files of a run that are read. An evaluation is made again.
    pipe(&run.file("evaluation.json"));
    let mut command = program("evaluate");
    let message = refusal(&mut bounded(command.arg(run.folder()), PLENTY));
    assert!(message.contains("evaluation.json"), "{message}");
    succeed(&mut bounded(&run.again(300), PLENTY));
    for file in ["final.safetensors", "config.toml"] {
        let run = Run::new("lava-grid");
        pipe(&run.file(file));
        for verb in ["evaluate", "rollout"] {
            let mut command = program(verb);
            command.args(if verb == "rollout" { &["--run"][..] } else { &[] }).arg(run.folder());
            let message = refusal(&mut bounded(&command, PLENTY));
            assert!(message.contains("regular file"), "{verb}, {file}: {message}");
        }
    }
    // Those that are written: the run fails, and says why.
    for file in [".lock", "progress.csv", "worker.log"] {
        let run = Run::new("lava-grid");
        for name in ["evaluation.json", "final.safetensors"] {
            fs::remove_file(run.file(name)).unwrap();
        }
        let folder = run.folder();
        pipe(&folder.join(file));
        let output = bounded(&bench(run.out.path()), PLENTY).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{file}: {}", stderr(&output));
        assert!(stderr(&output).contains("regular file"), "{file}: {}", stderr(&output));
    }
}
