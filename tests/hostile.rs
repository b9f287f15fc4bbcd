//! Files from elsewhere are refused or read: no input makes a parser panic, allocate without bound or
//! write outside of its folder.

#[path = "support/fuzz.rs"]
mod fuzz;

use cap::Cap;
use cvar_game::experiment::archive::{self, PackedWeights, RunName};
use cvar_game::experiment::artefacts::{Evaluation, SCHEMA};
use cvar_game::experiment::config::{Config, RunConfig, Setting, Source};
use cvar_game::experiment::figure_data::FigureData;
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::registry::standard;
use cvar_game::experiment::{plan, runner};
use cvar_game::report::runs::Runs;
use cvar_game::report::settings::Settings;
use cvar_game::report::table::{Results, Table};
use cvar_game::report::{self, Optimum, Worlds, figures, page};
use fuzz::{fuzz, inputs};
use lava_envs::map::{MAX_CELLS, Map};
use std::alloc::System;
use std::fs;
use std::path::Path;
use std::time::Duration;

/// Whoever asks for more memory than all parsers together need ends the test.
#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, 1 << 30);

/// Columns of text of the terminal.
const WIDTH: usize = 100;

fuzz::fuzz_targets!(
    configs,
    run_configs,
    settings,
    maps,
    names,
    evaluations,
    episodes,
    archives,
    progress,
    figure_data,
    constants
);

/// A file of its own with these bytes, for a parser that reads files.
fn with_file(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    read(&path);
}

/// Whether a run's folder is below the output folder, by plain names alone.
fn stays_in(folder: &Path, out: &Path) -> bool {
    let names = folder.strip_prefix(out).map(|rest| rest.components());
    names.is_ok_and(|mut names| names.all(|of| matches!(of, std::path::Component::Normal(_))))
}

fn first_run() -> RunConfig {
    let config = Config::resolve(standard().catalogue(), Source::Default, &[]).unwrap();
    config.run(&plan::runs(&config)[0])
}

fn configs(effort: (u32, Duration)) -> u64 {
    let shipped = |name: &str| {
        fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name)).unwrap()
    };
    let valid = vec![
        standard().catalogue().annotated_default().into(),
        shipped("quick.toml"),
        shipped("paper.toml"),
        b"train.steps = 20_000\n[env.lava-grid]\nslip = 0.1\n".into(),
        b"[[experiment.variant]]\nname = \"k-1\"\netas = [25]\nset = { \"train.follower_updates\" = 1 }\n\
          [experiment.axes]\n\"env.slip\" = [0.1, 0.2]\n\"train.leader\" = [\"antagonist\"]\n".into(),
        b"extends = \"some.toml\"\ngamma = 0.9\n".into(),
    ];
    fuzz(&inputs(valid, "configs"), effort, |bytes| {
        with_file("some.toml", bytes, |path| {
            match Config::resolve(standard().catalogue(), Source::File(path), &[]) {
                // What is accepted can be printed and planned, and its runs stay in their folder.
                Ok(config) => {
                    let _ = config.to_toml();
                    for id in plan::runs(&config) {
                        let folder = id.folder(Path::new("out"));
                        assert!(
                            folder.starts_with("out")
                                && [5, 6].contains(&folder.components().count())
                        );
                    }
                }
                Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
            }
        });
    })
}

fn run_configs(effort: (u32, Duration)) -> u64 {
    let valid = vec![first_run().to_toml().into()];
    fuzz(&inputs(valid, "run_configs"), effort, |bytes| {
        with_file("config.toml", bytes, |path| {
            if let Ok(run) = RunConfig::load(path, standard().catalogue()) {
                let _ = run.differences(&first_run());
            }
        });
    })
}

fn settings(effort: (u32, Duration)) -> u64 {
    let valid = vec![b"env.slip=0.1".into(), b"experiment.seeds=[1, 2]".into(), b"a=\"b\"".into()];
    fuzz(&inputs(valid, "settings"), effort, |bytes| {
        if let Ok(setting) = Setting::parse(&String::from_utf8_lossy(bytes)) {
            let _ = Config::resolve(standard().catalogue(), Source::Default, &[setting]);
        }
    })
}

fn maps(effort: (u32, Duration)) -> u64 {
    let valid =
        vec![lava_envs::GridConfig::default().map.into(), b"  S#G\n  .L.\n".into(), b"SG".into()];
    fuzz(&inputs(valid, "maps"), effort, |bytes| {
        if let Ok(map) = Map::parse(&String::from_utf8_lossy(bytes)) {
            assert!(map.cells() <= MAX_CELLS);
            assert_eq!(Map::parse(&map.to_string()).unwrap(), map);
        }
    })
}

fn names(effort: (u32, Duration)) -> u64 {
    let valid = vec![
        b"lava-grid/eta-25/seed-3".into(),
        b"lava-point/game/eta-2.5/seed-0".into(),
        b"lava-grid/game/k-1+noise-0.5/eta-25/seed-3".into(),
    ];
    fuzz(&inputs(valid, "names"), effort, |bytes| {
        if let Ok(id) = String::from_utf8_lossy(bytes).parse::<RunId>() {
            assert!(stays_in(&id.folder(Path::new("out")), Path::new("out")), "{id}");
        }
    })
}

/// A finished run of a world, as its `evaluation.json` tells of it.
fn evaluation(env: &str) -> String {
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
        "schema": SCHEMA, "env": env, "eta": 25.0, "seed": 1, "steps": 10_000, "seconds": 1.0,
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
    text
}

/// A finished run as a table of results reads it.
fn evaluations(effort: (u32, Duration)) -> u64 {
    let valid = vec![evaluation("lava-grid").into()];
    fuzz(&inputs(valid, "evaluations"), effort, |bytes| {
        let out = tempfile::tempdir().unwrap();
        let folder = out.path().join("lava-grid/eta-25/seed-1");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("evaluation.json"), bytes).unwrap();
        let _ = runner::read_evaluation(&folder);
        if report::write(out.path(), standard(), WIDTH).is_ok() {
            report::table_json(out.path(), &[], standard()).unwrap();
        }
    })
}

/// The results of another program.
fn episodes(effort: (u32, Duration)) -> u64 {
    let valid = vec![
        b"return,steps,end\n0.5,12,goal\n-1.035,3,lava\n-1.4,40,timeout\n".into(),
        b"end,return,clearance,chance,protagonist,steps\n\
          goal,0.5,1.5,nominal,greedy,12\nlava,-1,0,antagonist,sampled,3\ngoal,1e-3,,exact,greedy,1\n"
            .into(),
    ];
    fuzz(&inputs(valid, "episodes"), effort, |bytes| {
        let parent = tempfile::tempdir().unwrap();
        let out = parent.path().join("out");
        let folder = out.join("lava-grid/eta-25/seed-1");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("episodes.csv"), bytes).unwrap();
        if report::write(&out, standard(), WIDTH).is_ok() {
            report::table_json(&out, &[], standard()).unwrap();
        }
        assert_eq!(fs::read_dir(&parent).unwrap().count(), 1, "it has left its folder");
    })
}

/// The archive of a results folder.
fn archives(effort: (u32, Duration)) -> u64 {
    let out = tempfile::tempdir().unwrap();
    for name in ["lava-grid/eta-25/seed-1", "lava-point/game/k-1/eta-25/seed-1"] {
        let folder = out.path().join(name);
        fs::create_dir_all(&folder).unwrap();
        let world = name.split('/').next().unwrap();
        fs::write(folder.join("evaluation.json"), evaluation(world)).unwrap();
        fs::write(folder.join("config.toml"), first_run().to_toml()).unwrap();
    }
    assert_eq!(archive::pack(out.path(), PackedWeights::None).unwrap().runs, 2);
    let valid = vec![fs::read(out.path().join("runs.zip")).unwrap()];
    fuzz(&inputs(valid, "archives"), effort, |bytes| {
        let parent = tempfile::tempdir().unwrap();
        let out = parent.path().join("out");
        fs::create_dir(&out).unwrap();
        fs::write(out.join("runs.zip"), bytes).unwrap();
        let _ = runner::read_evaluation(&out.join("lava-grid/eta-25/seed-1"));
        if report::write(&out, standard(), WIDTH).is_ok() {
            report::table_json(&out, &[], standard()).unwrap();
        }
        assert_eq!(fs::read_dir(&parent).unwrap().count(), 1, "it has left its folder");
    })
}

const PROGRESS: &str =
    "steps,player,mean_return,regret\n10000,protagonist,-1.5,1.5\n20000,antagonist,NaN,\n";

/// The `figure_data.json` of a run in a small world.
fn figure_data_of(env: &str) -> String {
    let maps = serde_json::json!({
        "visits": [900.0, 900.0, 900.0, 0.0], "deviations": [90.0, 9.0, 0.0, 0.0],
    });
    let shifts = serde_json::json!({
        "visits": [900, 9], "shift": [[0.5, -0.5], [0.0, 0.0]], "divergence": [0.1, 0.0],
    });
    let world = if env == "lava-grid" {
        serde_json::json!({"lava-grid": {
            "occupancy": [1.0, 0.5, 0.25, 0.0], "learned": maps, "exact": maps,
            "exact_budget": [1.0, 0.5],
        }})
    } else {
        serde_json::json!({"lava-point": {
            "trajectories": [[[0.5, 0.5], [1.5, 3.0]]], "bins": [2, 1],
            "shifts": [shifts, shifts, shifts],
        }})
    };
    let episode = serde_json::json!({
        "chance": "antagonist", "index": 0, "end": "lava", "value": -1.0,
        "path": [[0.0, 0.0], [1.0, 0.5]], "actions": [[0.0, 1.0]], "outcomes": [[1.0, 0.0]],
        "ratios": [2.0], "budgets": [25.0, 12.5],
    });
    let data = serde_json::json!({
        "schema": SCHEMA, "episodes": 1000, "world": world, "stored": [episode],
        "budget": {"running": [9, 8], "mean": [1.0, 0.4], "low": [1.0, 0.1], "high": [1.0, 0.8]},
    });
    let text = data.to_string();
    serde_json::from_str::<FigureData>(&text).unwrap().check().unwrap();
    text
}

/// Feeds a file of a finished run to the figures and the page, in a small world of each kind.
fn drawn(corpus: &str, file: &str, valid: Vec<Vec<u8>>, effort: (u32, Duration)) -> u64 {
    let out = tempfile::tempdir().unwrap();
    let sets = ["env.lava-grid.map=\"SG\\n.L\"", "env.lava-grid.horizon=4"];
    let sets = sets.map(|set| Setting::parse(set).unwrap());
    let config = Config::resolve(standard().catalogue(), Source::Default, &sets).unwrap();
    let folders = ["lava-grid", "lava-point"].map(|env| {
        let id: RunId = format!("{env}/eta-25/seed-1").parse().unwrap();
        let folder = id.folder(out.path());
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("config.toml"), config.run(&id).to_toml()).unwrap();
        fs::write(folder.join("evaluation.json"), evaluation(env)).unwrap();
        fs::write(folder.join("figure_data.json"), figure_data_of(env)).unwrap();
        fs::write(folder.join("progress.csv"), PROGRESS).unwrap();
        folder
    });
    let runs = Runs::read(out.path(), standard()).unwrap();
    let results = Results::of(&[("results", &runs)]);
    let table = Table::new(&results);
    let draw = || {
        let (panels, notes) = figures::panels(&results, standard());
        let figures = figures::draw(&panels, notes, standard());
        (panels, figures)
    };
    let (_, undamaged) = draw();
    assert_eq!(undamaged.missing, Vec::<String>::new());
    fuzz(&inputs(valid, corpus), effort, |bytes| {
        for folder in &folders {
            fs::write(folder.join(file), bytes).unwrap();
        }
        let (panels, figures) = draw();
        for figure in figures.drawn.iter().filter(|figure| !undamaged.drawn.contains(figure)) {
            figures::png(&figure.picture.svg).unwrap();
        }
        page::render("results", &table, &panels, &figures, standard());
    })
}

fn progress(effort: (u32, Duration)) -> u64 {
    let valid = vec![
        PROGRESS.into(),
        b"update,steps,player,mean_return\n1,10000,protagonist,-1.5\n2,20000,antagonist,0.25\n"
            .into(),
    ];
    drawn("progress", "progress.csv", valid, effort)
}

fn figure_data(effort: (u32, Duration)) -> u64 {
    let valid = ["lava-grid", "lava-point"].map(|env| figure_data_of(env).into());
    drawn("figure_data", "figure_data.json", valid.into(), effort)
}

/// The constants of a world as tables and figures read them from the `config.toml` of a run.
fn constants(effort: (u32, Duration)) -> u64 {
    let valid = vec![
        b"gamma = 1\n[env.lava-grid]\nmap = \"SG\\n.L\"\nslip = 0.1\nhorizon = 4\n".into(),
        b"gamma = 0.9\n[env.lava-point]\narena = [8.0, 6.0]\n".into(),
    ];
    let name = RunName::parse("lava-grid/eta-25/seed-1").unwrap();
    fuzz(&inputs(valid, "constants"), effort, |bytes| {
        let text = String::from_utf8_lossy(bytes).into_owned();
        let Ok(Settings { task, .. }) = Settings::of(&name, Some(text), standard()) else { return };
        let world = name.world.as_str();
        standard().limits(world, &task.constants, task.gamma);
        let optimum = standard().optimum(world, &task.constants, task.gamma, name.eta);
        if let (Some(_), Optimum::Known(law)) = (standard().scene(world, &task.constants), optimum)
        {
            law.cvar(1.0 / name.eta);
        }
    })
}

#[test]
fn sizes_beyond_reason_are_refused() {
    let refused = |sets: &[&str]| {
        let settings: Vec<Setting> = sets.iter().map(|set| Setting::parse(set).unwrap()).collect();
        let message = Config::resolve(standard().catalogue(), Source::Default, &settings)
            .unwrap_err()
            .to_string();
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
        assert!(Config::resolve(standard().catalogue(), Source::File(path), &[]).is_err());
    });
    let refusal = |path: &Path| {
        Config::resolve(standard().catalogue(), Source::File(path), &[]).unwrap_err().to_string()
    };
    assert!(refusal(Path::new("/dev/zero")).contains("a device"));
    with_file("endless.toml", b"", |path| {
        fs::File::options().write(true).open(path).unwrap().set_len(1 << 40).unwrap();
        assert!(refusal(path).contains("larger than"));
    });
    let square = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"50000\" height=\"50000\"/>";
    figures::png(square).unwrap();
    let out = tempfile::tempdir().unwrap();
    let folder = out.path().join("lava-grid/eta-25/seed-1");
    fs::create_dir_all(&folder).unwrap();
    std::os::unix::fs::symlink("/dev/zero", folder.join("episodes.csv")).unwrap();
    let endless = report::write(out.path(), standard(), WIDTH).unwrap_err().to_string();
    assert!(endless.contains("a device"), "{endless}");
}
