//! Numbers that were wrong or promised more than they could, asked for as a user asks.

#[path = "support/program.rs"]
#[expect(dead_code, reason = "other tests compare CSV without its times")]
mod support;

use serde_json::Value;
use std::process::Command;
use support::{program, succeed};
use tempfile::TempDir;

/// `exact` on lava-point, coarse and on a short horizon, with a cache of its own.
fn exact(cache: &str, settings: &[&str]) -> Command {
    let mut command = program("exact");
    command.args(["--env", "lava-point", "--eta", "25", "--cell", "0.5", "--json"]);
    for setting in settings {
        command.args(["--set", setting]);
    }
    command.env("XDG_CACHE_HOME", cache);
    command
}

fn json(command: &mut Command) -> Value {
    serde_json::from_slice(&succeed(command).stdout).unwrap()
}

#[test]
fn the_oracle_is_not_worse_than_a_script_at_little_noise() {
    let cache = tempfile::tempdir().unwrap();
    let settings = ["env.noise=0.1", "env.substeps=1"];
    let answer = json(&mut exact(cache.path().to_str().unwrap(), &settings));
    let number = |value: &Value| value.as_f64().unwrap();
    let best = number(&answer["certified_cvar"]);
    for script in answer["baselines"].as_array().unwrap() {
        assert!(best >= number(&script["cvar"]), "{script} is better than {best}");
    }
    assert!(number(&answer["lattice_value"]) <= 1.0, "no return is above 1: {answer}");
}

#[test]
fn an_answer_is_not_lost_where_it_cannot_be_kept() {
    let settings = ["env.horizon=5", "env.start=[8.4, 2.6]", "env.substeps=1"];
    // A folder below a file can be made by nobody, root included.
    let output = succeed(&mut exact("/etc/hostname/cache", &settings));
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(answer["certified_cvar"].is_f64(), "{answer}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("cannot write /etc/hostname/cache"), "{said}");
}

#[test]
fn evaluate_has_intervals_and_no_tail_of_ten_episodes() {
    let out: TempDir = tempfile::tempdir().unwrap();
    let mut train = program("train");
    train.args(["--env", "lava-point", "--eta", "1", "--seed", "1", "--steps", "10000", "--out"]);
    train.arg(out.path()).args(["--set", "evaluation.episodes=200"]);
    succeed(&mut train);
    let folder = ["lava-point/game/eta-1/seed-1", "lava-point/eta-1/seed-1"]
        .map(|name| out.path().join(name))
        .into_iter()
        .find(|folder| folder.join("config.toml").exists())
        .unwrap();
    let evaluate = |episodes: &str| {
        let mut command = program("evaluate");
        String::from_utf8(succeed(command.arg(&folder).args(["--episodes", episodes])).stdout)
            .unwrap()
    };
    let few = evaluate("10");
    assert!(few.contains("CVaR_0.01 needs at least 1000 episodes"), "{few}");
    let mean = few.lines().find(|line| line.trim_start().starts_with("mean")).unwrap();
    assert!(mean.contains('[') && mean.ends_with(']'), "{few}");
    let many = evaluate("1000");
    let tail = many.lines().find(|line| line.contains("CVaR_0.01")).unwrap();
    assert!(tail.contains('['), "{many}");
}
