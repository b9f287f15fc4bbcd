//! Whole runs through the program: the same bits from the same seed, and evaluations that agree with
//! exact laws.

#[path = "support/program.rs"]
mod support;

use cvar_game::experiment::artefacts::{Chance, Evaluation};
use cvar_game::game::returns::ReturnLaw;
use cvar_game::learn::policy::Mode;
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};
use support::{program, succeed, without_timing};

fn bench(config: &Path, out: &Path, jobs: &str) {
    let mut command = program("bench");
    succeed(command.args(["--jobs", jobs, "--config"]).arg(config).arg("--out").arg(out));
}

/// Trains for so many steps at eta = 25 and evaluates with few episodes; the folder of the run.
fn train(env: &str, steps: &str, figure_episodes: &str, out: &Path) -> PathBuf {
    let figures = format!("evaluation.figure_episodes={figure_episodes}");
    let mut command = program("train");
    command.args(["--env", env, "--eta", "25", "--seed", "1", "--steps", steps]);
    command.args(["--set", "evaluation.episodes=300", "--set", &figures, "--out"]).arg(out);
    succeed(&mut command);
    out.join(env).join("game/eta-25/seed-1")
}

const SMALL: &str = r#"
[experiment]
etas = [1, 25]
seeds = [1, 2]
[train]
steps = 30_000
[evaluation]
episodes = 500
figure_episodes = 500
"#;

const RUNS: [&str; 8] = [
    "lava-grid/game/eta-1/seed-1",
    "lava-grid/game/eta-1/seed-2",
    "lava-grid/game/eta-25/seed-1",
    "lava-grid/game/eta-25/seed-2",
    "lava-point/game/eta-1/seed-1",
    "lava-point/game/eta-1/seed-2",
    "lava-point/game/eta-25/seed-1",
    "lava-point/game/eta-25/seed-2",
];

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap()
}

fn evaluation(path: &Path) -> Evaluation {
    let evaluation: Evaluation = serde_json::from_str(&read(path)).unwrap();
    Evaluation { seconds: 0.0, ..evaluation }
}

#[test]
fn one_seed_gives_the_same_bits_whatever_the_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("small.toml");
    fs::write(&config, SMALL).unwrap();
    let (one, two) = (folder.path().join("one"), folder.path().join("two"));
    bench(&config, &one, "1");
    bench(&config, &two, "2");
    for run in RUNS {
        let [a, b] = [one.join(run), two.join(run)];
        let weights = [&a, &b].map(|run| fs::read(run.join("final.safetensors")).unwrap());
        assert!(weights[0] == weights[1], "weights of {run}");
        let progress = [&a, &b].map(|run| read(&run.join("progress.csv")));
        assert_eq!(without_timing(&progress[0]), without_timing(&progress[1]), "progress of {run}");
        let found = [&a, &b].map(|run| evaluation(&run.join("evaluation.json")));
        assert_eq!(found[0], found[1], "evaluation of {run}");
        let shown = [&a, &b].map(|run| read(&run.join("figure_data.json")));
        assert_eq!(shown[0], shown[1], "exhibits of {run}");
    }
    // Finished runs are skipped; nothing is trained again.
    let before =
        fs::metadata(one.join(RUNS[0]).join("final.safetensors")).unwrap().modified().unwrap();
    bench(&config, &one, "2");
    let after =
        fs::metadata(one.join(RUNS[0]).join("final.safetensors")).unwrap().modified().unwrap();
    assert_eq!(before, after);
}

/// Trains a little and compares the exact laws with `episodes` played ones, and the exact worst-case
/// antagonist with the CVaR.
fn exact_laws_agree_with(episodes: u64) {
    let folder = tempfile::tempdir().unwrap();
    let run = train("lava-grid", "300000", "20000", folder.path());
    let exact = evaluation(&run.join("evaluation.json"));
    let play = |antagonist: &str| -> Value {
        let mut command = program("evaluate");
        command.args(["--antagonist", antagonist, "--json", "--episodes", &episodes.to_string()]);
        let output = succeed(command.arg(&run));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let nominal = play("nominal");
    for (mode, name) in [(Mode::Greedy, "greedy"), (Mode::Sampled, "sampled")] {
        let law = &exact.play(mode, Chance::Nominal).unwrap().law;
        assert_eq!(law.episodes(), None, "the stored law is exact");
        let played = nominal["plays"]
            .as_array()
            .unwrap()
            .iter()
            .find(|play| play["protagonist"] == name)
            .unwrap();
        let law_played: ReturnLaw = serde_json::from_value(played["law"].clone()).unwrap();
        assert_eq!(law_played.episodes(), Some(episodes));
        let error = law_played.mean_standard_error();
        assert!((law_played.mean() - law.mean()).abs() < 4.0 * error, "mean of the {name} policy");
        for alpha in [0.5, 0.1, 0.04] {
            let error = law_played.cvar_standard_error(alpha) + 1e-12;
            let off = (law_played.cvar(alpha) - law.cvar(alpha)).abs();
            assert!(off < 4.0 * error, "CVaR_{alpha} of the {name} policy: {off}, error {error}");
        }
    }
    let cvar = exact.play(Mode::Greedy, Chance::Nominal).unwrap().law.cvar(0.04);
    let worst = play("exact");
    let law: ReturnLaw = serde_json::from_value(worst["plays"][0]["law"].clone()).unwrap();
    let error = law.mean_standard_error() + 1e-9;
    assert!((law.mean() - cvar).abs() < 4.0 * error, "{} against CVaR {cvar}", law.mean());
}

#[test]
fn exact_laws_agree_with_played_episodes() {
    exact_laws_agree_with(50_000);
}

#[test]
#[ignore = "a million episodes take minutes without optimisation"]
fn exact_laws_agree_with_a_million_episodes() {
    exact_laws_agree_with(1_000_000);
}

/// The fields of a row by name, and the sums that its episode must obey.
#[test]
fn rollouts_are_the_episodes_of_the_evaluation_step_by_step() {
    let folder = tempfile::tempdir().unwrap();
    for env in ["lava-grid", "lava-point"] {
        let run = train(env, "40000", "300", folder.path());
        let law = &evaluation(&run.join("evaluation.json"));
        let law = &law.play(Mode::Greedy, Chance::Antagonist).unwrap().law;
        let mut command = program("rollout");
        command.args(["--antagonist", "learned", "--episodes", "300", "--run"]);
        let output = succeed(command.arg(&run));
        let mut reader = csv::Reader::from_reader(&output.stdout[..]);
        let head = reader.headers().unwrap().clone();
        let column = |name: &str| head.iter().position(|column| column == name).unwrap();
        let [episode, t, delta, budget, reward, end] =
            ["episode", "t", "delta", "budget", "reward", "end"].map(column);
        let (mut episodes, mut time, mut eta, mut sum) = (0, 0, 25.0, 0.0);
        for row in reader.records() {
            let row = row.unwrap();
            let number = |column: usize| row[column].parse::<f64>().unwrap();
            assert_eq!((number(episode), number(t)), (f64::from(episodes), f64::from(time)));
            let left = number(budget);
            assert!((left / eta - 1.0).abs() < 1e-9, "budget {left}, expected {eta}");
            assert!(number(delta) <= left * (1.0 + 1e-9), "delta exceeds the remaining budget");
            eta = left / number(delta);
            time += 1;
            sum += number(reward);
            if !row[end].is_empty() {
                (episodes, time, eta) = (episodes + 1, 0, 25.0);
            }
        }
        assert_eq!(episodes, 300);
        assert!((sum / 300.0 - law.mean()).abs() < 1e-9, "{} against {}", sum / 300.0, law.mean());

        let mut command = program("rollout");
        command.args(["--episodes", "3", "--format", "json", "--run"]);
        let json = succeed(command.arg(&run));
        for line in String::from_utf8(json.stdout).unwrap().lines() {
            let row: Value = serde_json::from_str(line).unwrap();
            assert_eq!(row["delta"], 1.0, "nominal chance");
        }
    }
}

/// `rollout | head` ends with `head`.
#[test]
fn a_rollout_stops_when_nobody_reads_on() {
    let folder = tempfile::tempdir().unwrap();
    let run = train("lava-point", "40000", "300", folder.path());
    for format in ["csv", "json"] {
        let mut command = program("rollout");
        // Minutes of playing.
        command.args(["--episodes", "1000000", "--format", format, "--run"]).arg(&run);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        assert!(lines.next().unwrap().unwrap().contains("episode"));
        drop(lines);
        let start = Instant::now();
        let output = child.wait_with_output().unwrap();
        assert!(start.elapsed() < Duration::from_secs(60), "it has played on");
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    }
}
