//! The program as its user meets it: answers, exit codes and bad input.

use assert_cmd::Command;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// The program; the variable CVAR_GAME_TESTED names another build of it, to see a test fail on a former
/// version.
fn program() -> Command {
    let tested = std::env::var_os("CVAR_GAME_TESTED");
    tested.map_or_else(|| Command::cargo_bin("cvar-game").unwrap(), Command::new)
}

/// Standard output of a command that succeeds.
fn answer(arguments: &[&str]) -> String {
    let output = program().args(arguments).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {error}");
    String::from_utf8(output.stdout).unwrap()
}

/// The one line of standard error of a command that is refused as bad input.
fn refusal(arguments: &[&str]) -> String {
    let output = program().args(arguments).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
    assert!(output.stdout.is_empty(), "{arguments:?} answered");
    assert_eq!(error.lines().count(), 1, "{arguments:?}: {error}");
    error
}

/// A column of a CSV file.
fn column(text: &str, name: &str) -> Vec<String> {
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let head = reader.headers().unwrap().clone();
    let at = head.iter().position(|of| of == name);
    let at = at.unwrap_or_else(|| panic!("there is no column {name} in {head:?}"));
    reader.records().map(|row| row.unwrap()[at].to_owned()).collect()
}

fn config_file(folder: &TempDir, text: &str) -> String {
    let path = folder.path().join("some.toml");
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn help_of_the_program_and_of_each_verb_is_there() {
    assert!(answer(&["--help"]).contains("Examples:"));
    for verb in ["bench", "train", "evaluate", "exact", "table", "envs", "config"] {
        assert!(answer(&[verb, "--help"]).contains("Usage: cvar-game"), "{verb}");
    }
    assert!(!answer(&["--help"]).contains("worker"), "the workers' verb is not for users");
}

#[test]
fn envs_lists_the_worlds_with_their_constants() {
    let text = answer(&["envs"]);
    for part in ["# lava-grid:", "slip = 0.05", "# lava-point:", "noise = 1.5", "horizon = 40"] {
        assert!(text.contains(part), "{part} is missing in {text}");
    }
    assert!(!text.contains("train"), "{text}");
    let json: serde_json::Value = serde_json::from_str(&answer(&["envs", "--json"])).unwrap();
    assert_eq!(json["lava-grid"]["slip"], 0.05);
    assert_eq!(json["lava-point"]["lava"]["max"], serde_json::json!([8.0, 2.0]));
}

#[test]
fn config_prints_what_resolves_to_itself() {
    let folder = tempfile::tempdir().unwrap();
    let printed = answer(&["config", "--env", "lava-point", "--set", "env.noise=2"]);
    assert!(printed.contains("noise = 2.0") && !printed.contains("lava-grid"), "{printed}");
    assert!(printed.contains("etas = [1.0, 25.0, 100.0]"), "{printed}");
    let again = answer(&["config", "--config", &config_file(&folder, &printed)]);
    assert_eq!(again, printed);
}

#[test]
fn exact_solves_the_grid() {
    let json = answer(&["exact", "--env", "lava-grid", "--eta", "25", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["eta"], 25.0);
    assert!((json["optimal_cvar"].as_f64().unwrap() - 0.2083).abs() < 1e-3, "{json}");
    assert!(answer(&["exact", "--env", "lava-grid", "--eta", "1"]).contains("lava-grid"));
}

/// The weights that are committed are those of the rows that are committed.
#[test]
fn packed_players_are_played_without_unpacking() {
    let folder = "results/paper";
    let runs = fs::read_to_string(format!("{folder}/runs.csv")).unwrap();
    let values = ["env", "eta", "seed", "greedy_cvar"].map(|name| column(&runs, name));
    let mut checked = 0;
    for (((env, eta), seed), cvar) in
        values[0].iter().zip(&values[1]).zip(&values[2]).zip(&values[3])
    {
        if env == "lava-grid" && seed == "121" {
            let run = format!("{folder}/{env}/game/eta-{eta}/seed-{seed}");
            let json = answer(&["exact", "--policy", &run, "--json"]);
            let json: serde_json::Value = serde_json::from_str(&json).unwrap();
            let found = json["cvar"].as_f64().unwrap();
            assert!((found - cvar.parse::<f64>().unwrap()).abs() < 1e-6, "{run}: {found}, {cvar}");
            checked += 1;
        }
    }
    assert_eq!(checked, 3);
    let run = format!("{folder}/lava-grid/game/eta-25/seed-122");
    let error = refusal(&["exact", "--policy", &run]);
    assert!(error.contains("pack --weights all"), "{error}");
}

#[test]
fn bad_input_is_refused_in_one_line_that_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let good = config_file(&folder, "experiment.seeds = [1]");
    let out = folder.path().join("out");
    let out = out.to_str().unwrap();
    let under_a_file = format!("{good}/out");
    let grid = ["train", "--out", out, "--env", "lava-grid", "--seed", "1", "--eta"];
    let train = |rest: &[&'static str]| [&grid[..], rest].concat();
    let bench =
        |rest: &[&'static str]| [&["bench", "--out", out, "--config", &good], rest].concat();
    for (arguments, parts) in [
        (train(&["0.5"]), ["--eta: eta must be", "at least 1, got 0.5"]),
        (train(&["-3"]), ["--eta: eta must be", "at least 1, got -3"]),
        (train(&["nan"]), ["--eta: eta must be", "got NaN"]),
        (train(&["inf"]), ["--eta: eta must be", "got inf"]),
        (train(&["1", "--steps", "0"]), ["train.steps = 0 (from --steps)", "at least 1"]),
        (train(&["1", "--config", "no.toml"]), ["cannot read no.toml", "give the path"]),
        (train(&["1", "--set", "train.step=1"]), ["train.step (", "did you mean train.steps?"]),
        (train(&["1", "--set", "steps"]), ["--set steps", "--set key=value"]),
        (bench(&["--set", "gamma=nan"]), ["gamma = nan (from --set)", "at most 1"]),
        (bench(&["--set", "experiment.seeds=[1,1]"]), ["experiment.seeds", "duplicates"]),
        (
            bench(&["--set", "experiment.shifts=['lava-grid.slap=0.1']"]),
            ["env.lava-grid.slap", "did you mean env.lava-grid.slip?"],
        ),
        (
            bench(&["--set", "experiment.shifts=['lava-grid.slip=2']"]),
            ["env.lava-grid.slip = 2", "at most 1"],
        ),
        (bench(&["--set", "experiment.shifts=['slip']"]), ["\"slip\"", "WORLD.CONSTANT=VALUE"]),
        (bench(&["--set", "env.map=..G"]), ["env.lava-grid.map", "write S into one free cell"]),
        (bench(&["--set", "env.map=S.."]), ["env.lava-grid.map", "write G into a free cell"]),
        (
            vec!["bench", "--config", &good, "--out", &under_a_file],
            ["cannot write to", "choose another folder with --out"],
        ),
        (vec!["bench", "--config", "no.toml"], ["cannot read no.toml", "give the path"]),
        (vec!["table", out], ["cannot read", "check the path"]),
        (vec!["evaluate", out], ["holds no run", "give the folder of one"]),
        (vec!["exact", "--env", "lava-grid", "--eta", "0"], ["--eta", "at least 1, got 0"]),
    ] {
        let message = refusal(&arguments);
        for part in parts {
            assert!(message.contains(part), "{arguments:?}: {message:?} lacks {part:?}");
        }
    }
    assert!(!Path::new(out).exists(), "a refused command left something behind");
}

#[test]
fn wrong_usage_is_refused_with_the_reason() {
    for (arguments, reason) in [
        (vec!["bench", "--config", "x", "--jobs", "0"], "use a whole number of at least 1"),
        (vec!["slurm"], "--config <FILE>"),
        (
            vec!["train", "--env", "lava-lake", "--eta", "1", "--seed", "1"],
            "\"lava-grid\", \"lava-point\"",
        ),
        (vec!["config", "--env", "pit"], "\"lava-grid\", \"lava-point\""),
        (
            vec!["bench", "--config", "x", "--device", "tpu"],
            "is not \"cpu\", \"cuda\" or \"cuda:N\"",
        ),
    ] {
        let output = program().args(&arguments).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(error.contains(reason), "{arguments:?}: {error}");
    }
}

#[test]
fn numbers_may_be_grouped_and_negative_ones_are_refused_with_their_range() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let train = ["train", "--env", "lava-grid", "--eta", "1", "--seed", "1", "--out", out];
    for (rest, reason) in [
        (vec!["--steps", "1_000"], "train.steps = 1000 is less than one rollout"),
        (vec!["--set", "train.steps=1_000"], "train.steps = 1000 is less than one rollout"),
        (vec!["--steps", "-5"], "train.steps = -5 (from --steps)"),
    ] {
        let message = refusal(&[&train[..], &rest].concat());
        assert!(message.contains(reason), "{rest:?}: {message}");
    }
    for (arguments, reason) in [
        (vec!["evaluate", out, "--episodes", "1_000"], "holds no run"),
        (vec!["rollout", out, "--episodes", "1_000_000"], "holds no run"),
        (vec!["rollout", out, "--seed", "1_0"], "holds no run"),
        (vec!["evaluate", out, "--episodes", "-5"], "not negative"),
        (vec!["evaluate", out, "--episodes", "0"], "at least 1"),
        (vec!["evaluate", out, "--episodes", "1__0"], "such as 100_000"),
        (vec!["evaluate", out, "--episodes", "many"], "such as 100_000"),
        (vec!["evaluate", out, "--seed", "-1"], "not negative"),
        (vec!["rollout", out, "--episodes", "-5"], "not negative"),
        (vec!["rollout", out, "--seed", "99999999999999999999999"], "too large"),
        (vec!["bench", "--jobs", "-2"], "at least 1"),
        (vec!["slurm", "--config", "x", "--out", out, "--array-limit", "-2"], "at least 1"),
        (vec!["exact", "--env", "lava-point", "--eta", "25", "--cell", "-1"], "-1"),
        (vec!["exact", "--env", "lava-point", "--eta", "25", "--velocity", "-1"], "-1"),
    ] {
        let output = program().args(&arguments).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(reason), "{arguments:?}: {error}");
        assert!(!error.contains("unexpected argument"), "{arguments:?}: {error}");
    }
}

#[test]
fn a_world_whose_goal_is_out_of_reach_is_refused() {
    for (set, parts) in [
        ("env.lava-grid.map=SL\nLG", ["row 1, column 1", "no way past lava and walls"]),
        ("env.lava-grid.map=S#G", ["env.lava-grid.map", "no way past lava and walls"]),
        (
            "env.lava-grid.horizon=12",
            ["horizon = 12", "at least 13, the moves of the shortest way"],
        ),
        ("env.lava-point.lava.max=[10, 2]", ["env.lava-point.goal", "does not touch the lava"]),
        ("env.lava-point.lava.max=[8, 6.9]", ["env.lava-point.goal", "does not touch the lava"]),
        ("env.lava-point.start=[3, 1]", ["env.lava-point.start", "neither lava"]),
    ] {
        let message = refusal(&["config", "--set", &set.replace("\\n", "\n")]);
        for part in parts {
            assert!(message.contains(part), "{set}: {message}");
        }
    }
    // As long as the shortest way, and a gap that is wider than the disc.
    answer(&["config", "--set", "env.lava-grid.horizon=13"]);
    answer(&["config", "--set", "env.lava-point.lava.max=[8, 6.7]"]);
}

#[test]
fn completions_and_manual_pages_know_the_verbs_and_their_options() {
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let script = answer(&["completions", shell]);
        assert!(script.contains("rollout") && script.contains("antagonist"), "{shell}");
    }
    let folder = tempfile::tempdir().unwrap();
    let pages = folder.path().join("man1");
    answer(&["man", "--out", pages.to_str().unwrap()]);
    let page = |name: &str| fs::read_to_string(pages.join(name)).unwrap();
    assert!(page("cvar-game.1").contains("bench"));
    assert!(page("cvar-game-rollout.1").contains("antagonist"));
    assert!(!pages.join("cvar-game-worker.1").exists(), "the workers' verb is not for users");
}

#[test]
fn the_hint_of_slurm_is_a_command_of_the_shell() {
    let folder = tempfile::tempdir().unwrap();
    let config =
        config_file(&folder, "[experiment]\nenvs = [\"lava-grid\"]\netas = [1]\nseeds = [1]\n");
    let out = folder.path().join("it's here");
    let hint = answer(&["slurm", "--config", &config, "--out", out.to_str().unwrap()]);
    assert!(hint.starts_with("1 run to do"), "{hint}");
    let words = shlex::split(hint.split_once(": ").unwrap().1).unwrap();
    assert_eq!(words, ["sh", out.join("slurm/submit.sh").to_str().unwrap()]);
}

#[test]
fn a_reader_that_stops_listening_is_no_error() {
    use std::process::Stdio;
    let program = assert_cmd::cargo::cargo_bin("cvar-game");
    let mut child = std::process::Command::new(program)
        .arg("envs")
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
}

#[test]
#[cfg(not(feature = "torch"))]
fn a_build_without_torch_says_how_to_get_a_device() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let run = ["train", "--env", "lava-grid", "--eta", "1", "--seed", "1", "--device", "cuda"];
    let arguments = [&run[..], &["--out", out.to_str().unwrap()]].concat();
    assert!(refusal(&arguments).contains("cargo xtask torch"));
    assert!(!out.join("lava-grid").exists());
}

/// Whole runs, small enough for a test.
mod runs {
    use super::*;
    use std::process::{Child, Stdio};
    use std::time::{Duration, Instant};

    /// Rollouts of 400 steps, and few episodes of evaluation.
    const SMALL: &str = "
        [experiment]
        envs = [\"lava-grid\", \"lava-point\"]
        etas = [1, 25]
        seeds = [1]
        [train]
        steps = 4_000
        parallel_episodes = 10
        protagonist.minibatch = 200
        antagonist.minibatch = 200
        [evaluation]
        episodes = 200
        figure_episodes = 200
        parallel_episodes = 100
        ";

    /// The same at budget 1, with keys that all versions have.
    const PLAIN: &str = "
        [experiment]
        envs = [\"lava-grid\", \"lava-point\"]
        etas = [1]
        seeds = [1, 2]
        [train]
        steps = 4_000
        parallel_episodes = 10
        protagonist.minibatch = 200
        antagonist.minibatch = 200
        [evaluation]
        episodes = 3_000
        parallel_episodes = 100
        ";

    /// A run that would take hours.
    const ENDLESS: &str = "train.steps=4_000_000_000";

    #[test]
    fn train_ends_with_its_summary_and_keeps_a_finished_run() {
        let folder = tempfile::tempdir().unwrap();
        let config = config_file(&folder, SMALL);
        let out = folder.path().join("out");
        let arguments = [
            "train",
            "--env",
            "lava-grid",
            "--eta",
            "25",
            "--seed",
            "3",
            "--config",
            &config,
            "--json",
            "--out",
            out.to_str().unwrap(),
        ];
        let first = answer(&arguments);
        let json: serde_json::Value =
            serde_json::from_str(first.lines().next_back().unwrap()).unwrap();
        assert_eq!((&json["env"], &json["seed"]), (&"lava-grid".into(), &3.into()), "{json}");
        assert_eq!((&json["eta"], &json["steps"]), (&25.0.into(), &4000.into()), "{json}");
        for key in ["seconds", "steps_per_second", "greedy_mean", "greedy_cvar"] {
            assert!(json[key].is_number(), "{key} in {json}");
        }
        let run = out.join("lava-grid/game/eta-25/seed-3");
        assert_eq!(json["folder"], run.to_str().unwrap());
        for file in [
            "config.toml",
            "manifest.json",
            "progress.csv",
            "final.safetensors",
            "figure_data.json",
            "evaluation.json",
        ] {
            assert!(run.join(file).exists(), "{file} is missing");
        }
        // The evaluation's time is told apart from that of training.
        let manifest = fs::read_to_string(run.join("manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
        let seconds = ["seconds", "evaluation_seconds"].map(|key| manifest[key].as_f64().unwrap());
        assert!(seconds.iter().all(|seconds| *seconds > 0.0), "{manifest}");
        assert_eq!(json["seconds"], seconds[0]);
        answer(&["table", out.to_str().unwrap()]);
        let table = fs::read_to_string(out.join("table.csv")).unwrap();
        assert!(table.lines().next().unwrap().contains("evaluation_seconds"), "{table}");

        let written = fs::metadata(run.join("final.safetensors")).unwrap().modified().unwrap();
        assert_eq!(answer(&arguments), first);
        let now = fs::metadata(run.join("final.safetensors")).unwrap().modified().unwrap();
        assert_eq!(now, written, "the finished run was carried out again");
    }

    /// On a terminal, which `script` provides.
    #[test]
    fn a_bar_says_what_is_done_and_how_long_it_will_take() {
        let folder = tempfile::tempdir().unwrap();
        let config = config_file(&folder, PLAIN);
        let out = folder.path().join("out");
        let (program, out) = (program().get_program().to_owned(), out.to_str().unwrap().to_owned());
        let line = format!("{} bench --config {config} --out {out}", program.to_str().unwrap());
        let mut script = std::process::Command::new("script");
        script.args(["-qefc", &line, "/dev/null"]).stdin(Stdio::null());
        let shown = script.env("TERM", "xterm").output().unwrap();
        assert!(shown.status.success(), "{shown:?}");
        let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
        for part in ["evaluating, ", " left", "of 4 ended", "steps/s"] {
            assert!(shown.contains(part), "{part} is missing in {shown}");
        }
        assert_eq!(shown.matches("finished in").count(), 4, "{shown}");
    }

    #[test]
    fn progress_has_the_lengths_of_episodes_and_a_rollout_the_states_after_its_steps() {
        let folder = tempfile::tempdir().unwrap();
        let config = config_file(&folder, PLAIN);
        let out = folder.path().join("out");
        let out = out.to_str().unwrap();
        answer(&[
            "train",
            "--env",
            "lava-point",
            "--eta",
            "1",
            "--seed",
            "1",
            "--config",
            &config,
            "--out",
            out,
        ]);
        let found =
            std::process::Command::new("find").args([out, "-name", "progress.csv"]).output();
        let progress =
            std::path::PathBuf::from(String::from_utf8(found.unwrap().stdout).unwrap().trim());
        let text = fs::read_to_string(&progress).unwrap();
        for length in column(&text, "mean_length") {
            let length: f64 = length.parse().unwrap();
            assert!(length.is_nan() || (1.0..=40.0).contains(&length), "{length}");
        }
        let events = fs::read(progress.with_file_name("events.out.tfevents.cvar-game")).unwrap();
        let tag = b"charts/episodic_length";
        assert!(events.windows(tag.len()).any(|bytes| bytes == tag), "TensorBoard has no lengths");
        let run = progress.parent().unwrap().to_str().unwrap();
        let rows = answer(&["rollout", "--run", run, "--episodes", "20"]);
        let (ends, times) = (column(&rows, "end"), column(&rows, "t"));
        for name in ["x", "y", "vx", "vy"] {
            let (before, after) = (column(&rows, name), column(&rows, &format!("next_{name}")));
            for row in 1..before.len() {
                let continues = times[row] != "0";
                assert_eq!(continues, ends[row - 1].is_empty());
                assert!(!continues || before[row] == after[row - 1], "{name} in row {row}");
            }
        }
        // The last state is the one after the last step.
        let last = ends.iter().position(|end| end == "lava").expect("an episode ends in lava");
        let place = |name: &str| column(&rows, name)[last].parse::<f64>().unwrap();
        let [x, y] = ["next_x", "next_y"].map(place);
        assert!((1.8..=8.2).contains(&x) && (-0.2..=2.2).contains(&y), "({x}, {y})");
    }

    #[test]
    fn bench_prints_and_writes_the_table() {
        let folder = tempfile::tempdir().unwrap();
        let config = config_file(&folder, SMALL);
        let out = folder.path().join("out");
        let shifts = "experiment.shifts=['lava-grid.slip=0.05,0.2', 'lava-grid.horizon=40,3']";
        let out_path = out.to_str().unwrap();
        let text = answer(&["bench", "--config", &config, "--out", out_path, "--set", shifts]);
        assert!(text.contains("lava-grid") && text.contains("lava-point"), "{text}");
        for file in ["runs.csv", "table.csv", "table.md"] {
            assert!(out.join(file).exists(), "{file} is missing");
        }
        // Under the slip of training every policy is worth what it was, under another one something else.
        let runs = fs::read_to_string(out.join("runs.csv")).unwrap();
        let shifted = fs::read_to_string(out.join("shifts.csv")).unwrap();
        let of = |slip: &str| -> Vec<String> {
            let (slips, means) = (column(&shifted, "value"), column(&shifted, "mean"));
            slips.iter().zip(means).filter(|(of, _)| *of == slip).map(|(_, mean)| mean).collect()
        };
        let worlds = column(&runs, "env").into_iter().zip(column(&runs, "greedy_mean"));
        let trained: Vec<String> =
            worlds.filter(|(world, _)| world == "lava-grid").map(|(_, mean)| mean).collect();
        assert_eq!(of("0.05"), trained);
        assert!(of("0.2").len() == trained.len() && of("0.2") != trained);
        assert!(of("40") == trained && of("3") != trained);
        assert_eq!(answer(&["table", out.to_str().unwrap()]), text);
        let run = out.join("lava-grid/game/eta-25/seed-1");
        for antagonist in ["nominal", "learned", "exact"] {
            let run = run.to_str().unwrap();
            let text = answer(&["evaluate", run, "--antagonist", antagonist, "--episodes", "100"]);
            assert!(text.contains("greedy protagonist"), "{text}");
        }
    }

    /// A sweep of endless runs, once its workers are at work.
    fn endless(folder: &TempDir, out: &Path) -> Child {
        let config = config_file(folder, SMALL);
        let child = std::process::Command::new(assert_cmd::cargo::cargo_bin("cvar-game"))
            .args(["bench", "--jobs", "2", "--config", &config, "--set", ENDLESS, "--out"])
            .arg(out)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        wait_for("two workers", || workers(out).len() == 2);
        child
    }

    /// The processes of the workers in an output folder.
    fn workers(out: &Path) -> Vec<String> {
        let out = out.to_str().unwrap();
        let mut found = Vec::new();
        for entry in fs::read_dir("/proc").unwrap().flatten() {
            let command = fs::read_to_string(entry.path().join("cmdline")).unwrap_or_default();
            if command.contains("\0worker\0") && command.contains(out) {
                found.push(entry.file_name().into_string().unwrap());
            }
        }
        found
    }

    fn wait_for(what: &str, condition: impl Fn() -> bool) {
        let start = Instant::now();
        while !condition() {
            assert!(start.elapsed() < Duration::from_secs(60), "waited in vain for {what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn signal(child: &Child, signal: &str) {
        let id = child.id().to_string();
        assert!(std::process::Command::new("kill").args([signal, &id]).status().unwrap().success());
    }

    #[test]
    fn a_signal_stops_the_workers_and_sets_the_exit_code() {
        for (name, code) in [("-INT", 130), ("-TERM", 75)] {
            let folder = tempfile::tempdir().unwrap();
            let out = folder.path().join("out");
            let mut child = endless(&folder, &out);
            signal(&child, name);
            assert_eq!(child.wait().unwrap().code(), Some(code));
            assert!(workers(&out).is_empty(), "workers outlive the sweep");
        }
    }

    #[test]
    fn workers_do_not_outlive_a_sweep_that_was_killed() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let mut child = endless(&folder, &out);
        signal(&child, "-KILL");
        child.wait().unwrap();
        wait_for("the workers' end", || workers(&out).is_empty());
    }
}
