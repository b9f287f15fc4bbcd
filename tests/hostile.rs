//! Files from elsewhere are refused or read: no input makes a parser panic, allocate without bound or
//! write outside of its folder.

#[path = "support/fuzz.rs"]
mod fuzz;

use cap::Cap;
use cvar_game::experiment::artefacts::{Evaluation, SCHEMA};
use cvar_game::experiment::config::{Config, DEFAULT, RunConfig, Setting};
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::{plan, runner};
use cvar_game::report;
use fuzz::{fuzz, inputs};
use lava_envs::map::{MAX_CELLS, Map};
use std::alloc::System;
use std::fs;
use std::path::Path;
use std::time::Duration;

/// Whoever asks for more memory than all parsers together need ends the test.
#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, 1 << 30);

fuzz::fuzz_targets!(configs, run_configs, settings, maps, names, evaluations);

/// A file of its own with these bytes, for a parser that reads files.
fn with_file(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    read(&path);
}

fn first_run() -> RunConfig {
    let config = Config::resolve(None, &[]).unwrap();
    config.run(plan::runs(&config)[0])
}

fn configs(effort: (u32, Duration)) -> u64 {
    let shipped = |name: &str| {
        fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name)).unwrap()
    };
    let valid = vec![
        DEFAULT.into(),
        shipped("quick.toml"),
        shipped("paper.toml"),
        b"train.steps = 20_000\n[env.lava-grid]\nslip = 0.1\n".into(),
    ];
    fuzz(&inputs(valid, "configs"), effort, |bytes| {
        with_file("some.toml", bytes, |path| match Config::resolve(Some(path), &[]) {
            // What is accepted can be printed and planned, and its runs stay in their folder.
            Ok(config) => {
                let _ = config.to_toml();
                for id in plan::runs(&config) {
                    let folder = id.folder(Path::new("out"));
                    assert!(folder.starts_with("out") && folder.components().count() == 4);
                }
            }
            Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
        });
    })
}

fn run_configs(effort: (u32, Duration)) -> u64 {
    let valid = vec![first_run().to_toml().into()];
    fuzz(&inputs(valid, "run_configs"), effort, |bytes| {
        with_file("config.toml", bytes, |path| {
            if let Ok(run) = RunConfig::load(path) {
                let _ = run.differences(&first_run());
            }
        });
    })
}

fn settings(effort: (u32, Duration)) -> u64 {
    let valid = vec![b"env.slip=0.1".into(), b"experiment.seeds=[1, 2]".into(), b"a=\"b\"".into()];
    fuzz(&inputs(valid, "settings"), effort, |bytes| {
        if let Ok(setting) = Setting::parse(&String::from_utf8_lossy(bytes)) {
            let _ = Config::resolve(None, &[setting]);
        }
    })
}

fn maps(effort: (u32, Duration)) -> u64 {
    let valid = vec![lava_envs::grid::PAPER_MAP.into(), b"  S#G\n  .L.\n".into(), b"SG".into()];
    fuzz(&inputs(valid, "maps"), effort, |bytes| {
        if let Ok(map) = Map::parse(&String::from_utf8_lossy(bytes)) {
            assert!(map.cells() <= MAX_CELLS);
            assert_eq!(Map::parse(&map.to_string()).unwrap(), map);
        }
    })
}

fn names(effort: (u32, Duration)) -> u64 {
    let valid = vec![b"lava-grid/eta-25/seed-3".into(), b"lava-point/eta-2.5/seed-0".into()];
    fuzz(&inputs(valid, "names"), effort, |bytes| {
        if let Ok(id) = String::from_utf8_lossy(bytes).parse::<RunId>() {
            assert_eq!(id.folder(Path::new("out")).components().count(), 4, "{id}");
        }
    })
}

/// A finished run as a table of results reads it.
fn evaluations(effort: (u32, Duration)) -> u64 {
    let law = |value: f64| {
        serde_json::json!({
            "atoms": [
                {"value": -1.0, "undiscounted": -1.0, "steps": 3, "end": "lava", "mass": 0.01},
                {"value": value, "undiscounted": value, "steps": 12, "end": "goal", "mass": 0.99},
            ],
            "episodes": 1000,
        })
    };
    let play = |protagonist: &str, chance: &str| {
        serde_json::json!({
            "protagonist": protagonist, "chance": chance, "law": law(0.4), "mean_clearance": 1.5,
        })
    };
    let evaluation = serde_json::json!({
        "schema": SCHEMA, "env": "lava-grid", "eta": 25.0, "seed": 1, "steps": 10_000, "seconds": 1.0,
        "plays": [
            play("greedy", "nominal"), play("sampled", "nominal"), play("sampled", "antagonist"),
        ],
        "audit": {
            "trajectories": 1000, "max_budget_use": 0.9, "max_normalisation_error": 1e-12,
            "violations": 0, "antagonist_mean": 0.1, "antagonist_standard_error": 0.01,
            "weighted_nominal_mean": 0.1, "weighted_nominal_standard_error": 0.01,
        },
        "certificate": {
            "optimum": 0.2, "regret": 0.1, "antagonist_gap": 0.0, "antagonist_gap_standard_error": 0.0,
        },
    });
    let text = serde_json::to_string_pretty(&evaluation).unwrap();
    serde_json::from_str::<Evaluation>(&text).unwrap();
    fuzz(&inputs(vec![text.into()], "evaluations"), effort, |bytes| {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join("lava-grid/eta-25/seed-1");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("evaluation.json"), bytes).unwrap();
        let _ = runner::read_evaluation(&folder);
        if report::write(out.path()).is_ok() {
            report::table_json(out.path(), &[]).unwrap();
        }
    })
}

#[test]
fn sizes_beyond_reason_are_refused() {
    let refused = |sets: &[&str]| {
        let settings: Vec<Setting> = sets.iter().map(|set| Setting::parse(set).unwrap()).collect();
        let message = Config::resolve(None, &settings).unwrap_err().to_string();
        assert!(message.contains("at most") || message.contains("from 1 to"), "{message}");
    };
    refused(&["train.parallel_episodes=1000000000", "train.rollout_steps=1000000000"]);
    refused(&["train.parallel_episodes=1000000", "train.steps=9223372036854775807"]);
    refused(&["train.steps=9223372036854775807"]);
    refused(&["train.protagonist.hidden=65536", "train.parallel_episodes=10000"]);
    refused(&["evaluation.episodes=9223372036854775807"]);
    let row = ".".repeat(2_000) + "\n";
    let map = format!("S{}G\n{}", ".".repeat(1_998), row.repeat(1_999));
    assert!(Map::parse(&map).unwrap_err().to_string().contains("draw a smaller map"));
    assert!(Setting::parse(&format!("{}=1", "a.".repeat(100_000) + "a")).is_err());
    with_file("deep.toml", format!("{} = 1", "a.".repeat(100_000) + "a").as_bytes(), |path| {
        assert!(Config::resolve(Some(path), &[]).is_err());
    });
    let endless = Config::resolve(Some(Path::new("/dev/zero")), &[]).unwrap_err().to_string();
    assert!(endless.contains("larger than"), "{endless}");
}
