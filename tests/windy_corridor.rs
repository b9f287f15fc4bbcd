//! A third world and a second method, each in one file and one line: the world of the tutorial conforms,
//! is solved, trained by every method, and reported.

#[path = "../examples/windy_corridor.rs"]
mod windy_corridor;

use cvar_game::exact::finite::ExactWorld;
use cvar_game::experiment::artefacts::Chance;
use cvar_game::experiment::config::{Config, Setting, Source};
use cvar_game::experiment::plan;
use cvar_game::experiment::runner::read_evaluation;
use cvar_game::experiment::stop::Stop;
use cvar_game::learn::policy::Mode;
use cvar_game::report;
use lava_envs::{World, conformance};
use std::fs;
use std::path::{Path, PathBuf};
use windy_corridor::WindyCorridor;

#[test]
fn it_keeps_the_promises_of_a_world() {
    conformance::check::<WindyCorridor>(&WindyCorridor::defaults());
}

/// The risk-neutral walker takes the shortest way, near the lava; the averse one goes to the middle.
#[test]
fn risk_aversion_keeps_away_from_the_lava() {
    let exact = ExactWorld::<WindyCorridor>::new(&WindyCorridor::defaults(), 1.0).unwrap();
    let row_at_half = |eta| {
        let path = exact.solve(eta).unwrap().path;
        path.iter().filter(|step| step.x == 5).map(|step| step.y).max().unwrap()
    };
    assert!(row_at_half(1.0) < row_at_half(100.0));
}

/// From the configuration to the page, with nothing but the example's own file.
#[test]
fn every_method_trains_there_and_enters_the_table() {
    let registry = windy_corridor::registry();
    let settings = [
        "experiment.envs=[\"windy-corridor\"]",
        "experiment.methods=[\"game\", \"uniform\"]",
        "experiment.etas=[1, 25]",
        "experiment.seeds=[1]",
        "train.steps=300_000",
        "evaluation.episodes=2_000",
        "evaluation.figure_episodes=2_000",
    ];
    let settings = settings.map(|text| Setting::parse(text).unwrap());
    let config = Config::resolve(registry.catalogue(), Source::Default, &settings).unwrap();
    let out = tempfile::tempdir().unwrap();
    let mut means = Vec::new();
    for id in plan::runs(&config) {
        let (run, folder) = (config.run(&id), id.folder(out.path()));
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("config.toml"), run.to_toml()).unwrap();
        let world = registry.world(&run.env).unwrap();
        world.execute(&run, &folder, &Stop::default(), &mut |_| {}).unwrap();
        let evaluation = read_evaluation(&folder).unwrap().unwrap();
        // An antagonist plays where the method has one, and the budget allows it something.
        assert_eq!(evaluation.audit.is_some(), id.method == "game" && id.eta.get() > 1.0);
        assert!(evaluation.certificate.is_some());
        means.push(evaluation.play(Mode::Greedy, Chance::Nominal).unwrap().law.mean());
    }
    // Runs by method, then eta. At eta = 1 the pair has learned; the uniform policy never does.
    let best = ExactWorld::<WindyCorridor>::new(&WindyCorridor::defaults(), 1.0).unwrap();
    let best = best.optimum(1.0).unwrap().cvar;
    assert!(means[0] > best - 0.1, "{means:?}, {best}");
    assert!(means[2] < best - 0.5 && means[3] < best - 0.5, "{means:?}, {best}");
    let written = report::write_all(out.path(), &registry).unwrap();
    let table = written.terminal(100);
    for word in ["windy-corridor", "game", "uniform"] {
        assert!(table.contains(word), "{word} in {table}");
    }
    let drawn: Vec<&str> = written.figures.drawn.iter().map(|of| of.name.as_str()).collect();
    for name in ["map", "occupancy", "frontier", "cross", "learning", "budget"] {
        assert!(drawn.contains(&format!("windy-corridor-{name}").as_str()), "{name}: {drawn:?}");
    }
}

/// Files below `folder` that contain a word, by their paths from there.
fn files_with(folder: &Path, word: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if fs::read_to_string(&path).is_ok_and(|text| text.contains(word)) {
                found.push(path);
            }
        }
    }
    let mut found: Vec<PathBuf> =
        found.iter().map(|path| path.strip_prefix(folder).unwrap().to_owned()).collect();
    found.sort();
    found
}

/// The measure of the house: what a method and a world touch.
#[test]
fn a_method_and_a_world_are_one_file_and_one_line() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let source = root.join("src");
    // The file, its line in the registry, and the line that declares the module.
    let expected = ["experiment/registry.rs", "learn/methods/mod.rs", "learn/methods/uniform.rs"];
    assert_eq!(files_with(&source, "Uniform"), expected.map(PathBuf::from));
    for word in ["WindyCorridor", "windy-corridor"] {
        assert!(files_with(&source, word).is_empty(), "{word}");
        assert!(files_with(&root.join("envs/src"), word).is_empty(), "{word}");
        assert!(files_with(&root.join("configs"), word).is_empty(), "{word}");
    }
}
