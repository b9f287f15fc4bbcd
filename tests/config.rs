//! The configuration: layers, refusals, and the way into a run's folder and back.

use cvar_game::experiment::config::{Config, DEFAULT, Device, RunConfig, Setting};
use cvar_game::experiment::names::{RunId, WorldName};
use cvar_game::experiment::plan;
use std::path::{Path, PathBuf};

fn resolve(file: Option<&str>, sets: &[&str]) -> Result<Config, String> {
    let folder = tempfile::tempdir().unwrap();
    let path: Option<PathBuf> = file.map(|text| {
        let path = folder.path().join("some.toml");
        std::fs::write(&path, text).unwrap();
        path
    });
    let one_line = |error: &dyn std::error::Error| {
        let message = error.to_string();
        assert!(!message.contains('\n'), "not one line: {message}");
        message.replace(&folder.path().display().to_string(), "DIR")
    };
    let settings: Result<Vec<Setting>, _> = sets.iter().map(|set| Setting::parse(set)).collect();
    let settings = settings.map_err(|error| one_line(&error))?;
    Config::resolve(path.as_deref(), &settings).map_err(|error| one_line(&error))
}

fn refusal(file: Option<&str>, sets: &[&str]) -> String {
    resolve(file, sets).expect_err(&format!("{file:?} {sets:?} was not refused"))
}

#[test]
fn the_default_is_the_papers_experiment() {
    let config = resolve(None, &[]).unwrap();
    assert_eq!(config.experiment.envs, WorldName::ALL);
    assert_eq!(config.gamma, 1.0);
    assert_eq!(config.device, Device::Cpu);
    for world in WorldName::ALL {
        let train = &config.world(world).train;
        assert_eq!(train.steps, 5_000_000);
        assert_eq!(train.parallel_episodes * train.rollout_steps, 10_000);
        assert_eq!(train.follower_updates, 2);
        // The point mass needs time to find the goal before the antagonist wakes.
        assert_eq!(train.budget_wait > 0.0, world == WorldName::LavaPoint);
    }
}

#[test]
fn the_defaults_of_the_worlds_are_their_own() {
    use cvar_game::experiment::config::WorldConfig::{LavaGrid, LavaPoint};
    let config = resolve(None, &[]).unwrap();
    let LavaGrid(grid) = &config.world(WorldName::LavaGrid).constants else { panic!() };
    let LavaPoint(point) = &config.world(WorldName::LavaPoint).constants else { panic!() };
    assert_eq!(grid, &lava_envs::GridConfig::default());
    assert_eq!(point, &lava_envs::PointConfig::default());
}

#[test]
fn every_key_of_the_default_has_its_comment() {
    let mut commented = false;
    let mut in_map = false;
    for line in DEFAULT.lines() {
        let quotes = line.matches("\"\"\"").count() == 1;
        if in_map || line.is_empty() || line.starts_with('#') {
            commented = line.starts_with('#');
        } else {
            assert!(commented, "no comment right above {line:?}");
            commented = false;
        }
        in_map ^= quotes;
    }
}

#[test]
fn a_later_layer_wins_and_a_worlds_own_section_within_one() {
    let steps = |config: &Config| WorldName::ALL.map(|world| config.world(world).train.steps);
    let cases: [(Option<&str>, &[&str], [u64; 2]); 8] = [
        (Some("train.steps = 20_000"), &[], [20_000, 20_000]),
        (Some("train.steps = 20_000\nenv.lava-point.train.steps = 30_000"), &[], [20_000, 30_000]),
        // --set is later than the file, so it wins over the file's section of the world too.
        (Some("env.lava-point.train.steps = 30_000"), &["train.steps=40_000"], [40_000, 40_000]),
        (None, &["env.lava-grid.train.steps=50_000"], [50_000, 5_000_000]),
        (None, &["train.steps=40_000", "train.steps=50_000"], [50_000, 50_000]),
        (None, &["env.lava-grid.train.steps=50_000", "train.steps=40_000"], [40_000, 40_000]),
        (None, &["env.train.steps=60_000"], [60_000, 60_000]),
        (None, &["env.train.steps=60_000", "experiment.envs=[\"lava-grid\"]"], [60_000, 5_000_000]),
    ];
    for (file, sets, expected) in cases {
        let config = resolve(file, sets).unwrap();
        assert_eq!(steps(&config), expected, "{file:?} {sets:?}");
    }
}

#[test]
fn the_short_form_sets_a_constant_in_each_world_that_has_it() {
    use cvar_game::experiment::config::WorldConfig::{LavaGrid, LavaPoint};
    let config = resolve(None, &["env.step_cost=0.05", "env.slip=0.1", "env.goal.max=[9.5, 1]"]);
    let config = config.unwrap();
    let LavaGrid(grid) = &config.world(WorldName::LavaGrid).constants else { panic!() };
    let LavaPoint(point) = &config.world(WorldName::LavaPoint).constants else { panic!() };
    assert_eq!((grid.step_cost, grid.slip), (0.05, 0.1));
    assert_eq!((point.step_cost, point.goal.max), (0.05, [9.5, 1.0]));
    assert_eq!(point.goal.min, [9.0, 0.0], "the rest of a section stays");
}

#[test]
fn unknown_keys_are_refused_with_the_nearest_known_one() {
    let file = "unknown key";
    for (text, parts) in [
        ("gama = 1.0", [file, "gama (from DIR/some.toml)", "did you mean gamma?"]),
        ("[train]\nstep = 5", [file, "train.step (", "did you mean train.steps?"]),
        ("[experiment]\neta = [1]", [file, "experiment.eta (", "did you mean experiment.etas?"]),
        (
            "[train.protagonist]\nlearning_rat = 1",
            [file, "train.protagonist.learning_rat (", "train.protagonist.learning_rate?"],
        ),
        ("[env.lava-lake]\nslip = 0.1", [file, "env.lava-lake.slip", "env.lava-grid.slip?"]),
        ("[env.lava-point]\nslip = 0.1", [file, "env.lava-point.slip", "env.lava-grid.slip?"]),
        (
            "[env.lava-grid.train]\nleeder = \"protagonist\"",
            [file, "env.lava-grid.train.leeder", "did you mean train.leader?"],
        ),
        ("[nonsense]", [file, "nonsense (from", "`cvar-game config` lists all keys"]),
        ("learning_rate = 1", [file, "learning_rate (", "learning_rate?"]),
    ] {
        let message = refusal(Some(text), &[]);
        for part in parts {
            assert!(message.contains(part), "{message:?} lacks {part:?}");
        }
    }
    let message = refusal(None, &["gama=1"]);
    assert_eq!(message, "unknown key gama (from --set); did you mean gamma?");
    let message = refusal(None, &["experiment.envs=[\"lava-point\"]", "env.slip=0.1"]);
    assert!(message.contains("no selected world (lava-point) has it"), "{message}");
}

#[test]
fn bad_values_are_refused_with_key_value_and_range() {
    for (set, parts) in [
        ("gamma=0", ["gamma = 0 (from --set)", "above 0 and at most 1"]),
        ("gamma=1.5", ["gamma = 1.5", "above 0 and at most 1"]),
        ("gamma=nan", ["gamma = nan", "a finite number"]),
        ("gamma=NaN", ["gamma = \"NaN\"", "a finite number"]),
        ("gamma=inf", ["gamma = inf", "a finite number"]),
        ("device=tpu", ["device = \"tpu\"", "\"cpu\", \"cuda\" or \"cuda:N\""]),
        ("experiment.etas=[0.5]", ["experiment.etas = [0.5]", "at least 1"]),
        ("experiment.etas=[nan]", ["experiment.etas = [nan]", "a finite number at least 1"]),
        ("experiment.etas=[]", ["experiment.etas = []", "at least one value"]),
        ("experiment.etas=25", ["experiment.etas = 25", "a list, such as [1.0, 25.0, 100.0]"]),
        ("experiment.etas=[1, 1.0]", ["experiment.etas", "without duplicates"]),
        ("experiment.seeds=[1, 2, 1]", ["[1, 2, 1]", "without duplicates (1 is there twice)"]),
        ("experiment.seeds=[-1]", ["[-1]", "a whole number of at least 0"]),
        ("experiment.envs=[\"lava-lake\"]", ["lava-lake", "\"lava-grid\" or \"lava-point\""]),
        ("train.steps=0", ["train.steps = 0", "a whole number of at least 1"]),
        ("train.steps=1e6", ["train.steps = 1000000.0", "a whole number of at least 1"]),
        ("train.steps=many", ["train.steps = \"many\"", "a whole number of at least 1"]),
        ("train.steps=100", ["train.steps = 100 is less than one rollout", "= 10000"]),
        ("train.protagonist.minibatch=20000", ["protagonist.minibatch = 20000", "10000"]),
        ("train.antagonist.clip=1", ["train.antagonist.clip = 1", "above 0 and below 1"]),
        ("train.leader=chance", ["\"chance\"", "\"protagonist\" or \"antagonist\""]),
        ("train.hide_budget=1", ["train.hide_budget = 1", "true or false"]),
        ("train.budget_wait=1", ["train.budget_wait = 1", "at least 0 and below 1"]),
        ("train.credit=executed", ["lava-grid alone", "(lava-point)"]),
        ("train.bump=4", ["train.bump = 4", "a section"]),
        ("train.steps.x=4", ["train.steps.x", "unknown key"]),
        ("evaluation.alphas=[0]", ["evaluation.alphas = [0]", "above 0 and at most 1"]),
        ("env.lava-grid.slip=2", ["env.lava-grid.slip = 2", "[0, 1]"]),
        ("env.lava-grid.slip=nan", ["env.lava-grid.slip = nan", "a finite number"]),
        ("env.lava-grid.horizon=0", ["env.lava-grid.horizon = 0", "at least 1"]),
        ("env.lava-grid.horizon=-1", ["env.lava-grid.horizon = -1", "from 0 to 4294967295"]),
        ("env.lava-grid.map=..G", ["env.lava-grid.map", "no start"]),
        ("env.lava-grid.map=S..", ["env.lava-grid.map", "no goal"]),
        ("env.lava-point.arena=[1]", ["env.lava-point.arena = [1]", "a list of 2 numbers"]),
        ("env.lava-point.start=[nan, 1]", ["env.lava-point.start", "must lie in the arena"]),
        ("train.budget_rise", ["--set train.budget_rise", "--set key=value"]),
        ("=3", ["--set =3", "--set key=value"]),
    ] {
        let message = refusal(None, &[set]);
        for part in parts {
            assert!(message.contains(part), "{set}: {message:?} lacks {part:?}");
        }
    }
    let message = refusal(None, &["train.budget_wait=0.6", "train.budget_rise=0.6"]);
    assert!(message.contains("must be at most 1"), "{message}");
}

#[test]
fn what_is_no_file_or_no_toml_is_refused() {
    let missing = Config::resolve(Some(Path::new("no/such.toml")), &[]).unwrap_err().to_string();
    assert!(missing.starts_with("cannot read no/such.toml: "), "{missing}");
    let message = refusal(Some("gamma = 1\n[train\n"), &[]);
    assert!(message.starts_with("DIR/some.toml: line 2: "), "{message}");
    let message = refusal(Some("gamma = 1\ngamma = 1\n"), &[]);
    assert!(message.starts_with("DIR/some.toml: line 2: "), "{message}");
}

#[test]
fn a_conflict_in_a_world_that_is_not_selected_does_not_matter() {
    let grid = "experiment.envs=[\"lava-grid\"]";
    assert!(resolve(None, &[grid, "train.credit=executed"]).is_ok());
}

#[test]
fn the_shipped_configurations_are_valid() {
    for (name, runs) in [("quick", 18), ("paper", 60)] {
        let path = format!("{}/configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        let config = Config::resolve(Some(Path::new(&path)), &[]).unwrap();
        assert_eq!(plan::runs(&config).len(), runs, "{name}");
    }
}

#[test]
fn the_printed_configuration_resolves_to_itself() {
    let config = resolve(None, &["env.lava-grid.train.steps=70_000", "env.slip=0.2"]).unwrap();
    let printed = config.to_toml();
    assert_eq!(resolve(Some(&printed), &[]).unwrap(), config, "{printed}");
    let grid_only = resolve(None, &["experiment.envs=[\"lava-grid\"]"]).unwrap().to_toml();
    assert!(!grid_only.contains("lava-point"), "{grid_only}");
}

#[test]
fn a_runs_configuration_survives_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("config.toml");
    let config = resolve(None, &["experiment.etas=[2.5]", "gamma=0.1", "env.slip=0.3"]).unwrap();
    for id in plan::runs(&config) {
        let run = config.run(id);
        assert_eq!(run.id(), id);
        std::fs::write(&path, run.to_toml()).unwrap();
        let loaded = RunConfig::load(&path).unwrap();
        assert_eq!(loaded, run);
        assert_eq!(loaded.to_toml(), run.to_toml());
    }
}

#[test]
fn a_runs_configuration_is_checked_when_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("config.toml");
    let config = resolve(None, &[]).unwrap();
    let good = config.run(plan::runs(&config)[0]).to_toml();
    for (from, to, expected) in [
        ("schema = 1", "schema = 2", "has schema version 2, this program writes"),
        ("schema = 1\n", "", "has schema version none"),
        ("seed = 1", "seed = -1", "seed = -1 (from"),
        ("eta = 1.0", "eta = nan", "eta = nan (from"),
        ("gamma = 1.0", "gamma = 7.0", "gamma = 7.0 (from"),
        ("slip = 0.05", "slip = 5.0", "env.lava-grid.slip = 5.0"),
        ("seed = 1", "seed = 1\nsede = 1", "unknown field `sede`"),
        ("clip = 0.2", "clip = 2.0", "train.antagonist.clip = 2.0"),
    ] {
        assert!(good.contains(from), "{good}");
        std::fs::write(&path, good.replace(from, to)).unwrap();
        let message = RunConfig::load(&path).unwrap_err().to_string();
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        assert!(!message.contains('\n'), "{message}");
    }
}

#[test]
fn differences_of_runs_are_told_by_key() {
    let id: RunId = "lava-grid/eta-25/seed-3".parse().unwrap();
    let here = resolve(None, &[]).unwrap().run(id);
    let there = resolve(None, &["train.steps=10_000", "env.slip=0.1"]).unwrap().run(id);
    let told: Vec<String> = here
        .differences(&there)
        .iter()
        .map(|difference| format!("{} {} {}", difference.key, difference.ours, difference.theirs))
        .collect();
    assert_eq!(told, ["env.lava-grid.slip 0.05 0.1", "train.steps 5000000 10000"]);
    assert!(here.differences(&here).is_empty());
}

#[test]
fn the_plan_is_ordered_by_world_eta_and_seed() {
    let sets = ["experiment.etas=[25, 1, 2.5]", "experiment.seeds=[7, 3]"];
    let names: Vec<String> =
        plan::runs(&resolve(None, &sets).unwrap()).iter().map(RunId::to_string).collect();
    assert_eq!(names.len(), 12);
    assert_eq!(
        names[..7],
        [
            "lava-grid/eta-25/seed-7",
            "lava-grid/eta-25/seed-3",
            "lava-grid/eta-1/seed-7",
            "lava-grid/eta-1/seed-3",
            "lava-grid/eta-2.5/seed-7",
            "lava-grid/eta-2.5/seed-3",
            "lava-point/eta-25/seed-7",
        ]
    );
}

#[test]
fn a_run_has_one_name_and_stays_in_its_folder() {
    let id: RunId = "lava-point/eta-2.5/seed-3".parse().unwrap();
    assert_eq!(id.folder(Path::new("out")), Path::new("out/lava-point/eta-2.5/seed-3"));
    for text in [
        "",
        "lava-grid",
        "lava-grid/eta-25",
        "lava-grid/eta-25/seed-",
        "lava-grid/eta-25/seed-3/",
        "lava-grid/eta-25/seed-03",
        "lava-grid/eta-25.0/seed-3",
        "lava-grid/eta-0.5/seed-3",
        "lava-grid/eta-nan/seed-3",
        "../eta-25/seed-3",
        "/lava-grid/eta-25/seed-3",
    ] {
        assert!(text.parse::<RunId>().is_err(), "{text:?} was taken for a run");
    }
}
