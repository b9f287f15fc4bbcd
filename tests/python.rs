//! The weights as other programs read them: `greedy.py` builds the network in PyTorch.

use assert_cmd::Command;
use cvar_game::experiment::config::RunConfig;
use cvar_game::experiment::registry::standard;
use cvar_game::learn::inputs::Inputs;
use cvar_game::learn::method::Players;
use cvar_game::learn::pair::Pair;
use lava_envs::{FiniteModel, LavaGrid, World};
use std::fs;

/// With `view`, the network's own greedy action in every cell, and PyTorch's.
fn compare(view: &str) {
    let out = tempfile::tempdir().unwrap();
    Command::cargo_bin("cvar-game")
        .unwrap()
        .args(["train", "--env", "lava-grid", "--eta", "25", "--seed", "1", "--steps", "100000"])
        .args(["--set", "evaluation.episodes=100", "--set", "evaluation.figure_episodes=100"])
        .args(["--set", &format!("train.observation={view}"), "--out"])
        .arg(out.path())
        .assert()
        .success();
    let folder = out.path().join("lava-grid/game/eta-25/seed-1");
    let run = RunConfig::load(&folder.join("config.toml"), standard().catalogue()).unwrap();
    let constants = &run.env.of::<LavaGrid>().unwrap();

    // A slot in every cell.
    let cells = LavaGrid::new(constants, 1).unwrap().cells();
    let mut world = LavaGrid::new(constants, cells).unwrap();
    (0..cells).for_each(|cell| world.place(cell, cell, 0));
    let mut pair = Pair::new(&world, &run.setting());
    let bytes = fs::read(folder.join("final.safetensors")).unwrap();
    pair.load(&bytes).unwrap();
    let mut inputs = Inputs::default();
    pair.observation.protagonist(&world, &mut inputs);
    let mut outputs = Vec::new();
    pair.protagonist.network.act(inputs.rows(), &mut outputs);
    let greedy = |cell: usize| {
        let logit = |action: usize| outputs[action * cells + cell];
        (1..4).fold(0, |best, action| if logit(action) > logit(best) { action } else { best })
    };
    let expected: Vec<usize> = (0..cells).map(greedy).collect();
    assert!(expected.iter().any(|&action| action != expected[0]), "the policy is constant");

    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/greedy.py");
    let output = Command::new(python).arg(script).arg(&folder).arg("--json").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Vec<usize> = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(found, expected);
}

#[test]
#[ignore = "needs a Python with torch and safetensors: PYTHON=path, by default python3"]
fn pytorch_finds_the_greedy_actions_of_every_cell() {
    compare("coordinates");
    compare("features");
}
