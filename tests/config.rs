//! The configuration: layers, refusals, and the way into a run's folder and back.

use cvar_game::experiment::archive::{RunFiles, Store};
use cvar_game::experiment::config::{Config, RunConfig, Setting, Source};
use cvar_game::experiment::names::{RunId, VariantName};
use cvar_game::experiment::plan;
use cvar_game::experiment::registry::standard;
use cvar_game::game::gaussian::MOST;
use cvar_game::learn::device::Device;
use lava_envs::{LavaGrid, LavaPoint, World};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const WORLDS: [&str; 2] = [LavaGrid::NAME, LavaPoint::NAME];

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
    Config::resolve(standard().catalogue(), Source::of(path.as_deref()), &settings)
        .map_err(|error| one_line(&error))
}

fn refusal(file: Option<&str>, sets: &[&str]) -> String {
    resolve(file, sets).expect_err(&format!("{file:?} {sets:?} was not refused"))
}

#[test]
fn the_default_is_the_papers_experiment() {
    let config = resolve(None, &[]).unwrap();
    assert_eq!(config.experiment.envs, WORLDS);
    assert_eq!(config.experiment.methods, ["game"]);
    assert_eq!(config.base.gamma, 1.0);
    assert_eq!(config.base.device, Device::Cpu);
    for world in WORLDS {
        let train = &config.world(world).train;
        assert_eq!(train.steps, 5_000_000);
        assert_eq!(train.parallel_episodes * train.rollout_steps, 10_000);
        assert_eq!(train.follower_updates, 2);
        // The point mass needs time to find the goal before the antagonist becomes active.
        assert_eq!(train.budget_wait > 0.0, world == LavaPoint::NAME);
    }
}

#[test]
fn the_defaults_of_the_worlds_are_their_own() {
    let config = resolve(None, &[]).unwrap();
    let grid = config.world(LavaGrid::NAME).constants.of::<LavaGrid>().unwrap();
    let point = config.world(LavaPoint::NAME).constants.of::<LavaPoint>().unwrap();
    assert_eq!(grid, lava_envs::GridConfig::default());
    assert_eq!(point, lava_envs::PointConfig::default());
    let wrong = config.world(LavaGrid::NAME).constants.of::<LavaPoint>().unwrap_err();
    assert!(wrong.to_string().contains("lava-point was expected"), "{wrong}");
}

#[test]
fn every_key_of_the_default_has_its_comment() {
    let mut commented = false;
    let mut in_map = false;
    for line in standard().catalogue().annotated_default().lines() {
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
    let steps = |config: &Config| WORLDS.map(|world| config.world(world).train.steps);
    let cases: [(Option<&str>, &[&str], [u64; 2]); 8] = [
        (Some("train.steps = 80_000"), &[], [80_000, 80_000]),
        (Some("train.steps = 80_000\nenv.lava-point.train.steps = 30_000"), &[], [80_000, 30_000]),
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
    let config = resolve(None, &["env.step_cost=0.05", "env.slip=0.1", "env.goal.max=[9.5, 1]"]);
    let config = config.unwrap();
    let grid = config.world(LavaGrid::NAME).constants.of::<LavaGrid>().unwrap();
    let point = config.world(LavaPoint::NAME).constants.of::<LavaPoint>().unwrap();
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
        ("experiment.envs=[\"lava-lake\"]", ["lava-lake", "\"lava-grid\", \"lava-point\""]),
        ("train.steps=0", ["train.steps = 0", "a whole number of at least 1"]),
        ("train.steps=1e6", ["train.steps = 1000000.0", "a whole number of at least 1"]),
        ("train.steps=many", ["train.steps = \"many\"", "a whole number of at least 1"]),
        ("train.steps=100", ["train.steps = 100 is less than one rollout", "= 10000"]),
        ("train.protagonist.minibatch=20000", ["protagonist.minibatch = 20000", "10000"]),
        ("train.antagonist.clip=1", ["train.antagonist.clip = 1", "above 0 and below 1"]),
        ("train.leader=chance", ["\"chance\"", "\"protagonist\" or \"antagonist\""]),
        ("train.hide_budget=1", ["train.hide_budget = 1", "true or false"]),
        ("train.budget_wait=1", ["train.budget_wait = 1", "at least 0 and below 1"]),
        ("train.credit=executed", ["in which chance decides an action", "(lava-point)"]),
        (
            "train.family.kind=softmax",
            ["use \"bumps\" or \"probits\" or \"shift\" or \"auto\"", "(lava-point)"],
        ),
        (
            "train.family.kind=none",
            ["\"none\"", "\"auto\", \"bumps\", \"probits\", \"shift\" or \"softmax\""],
        ),
        ("experiment.methods=[\"dqn\"]", ["dqn", "each element \"game\""]),
        (
            "train.family=4",
            ["train.family = 4", "a section; set its keys, such as train.family.kind"],
        ),
        ("train.steps.x=4", ["train.steps.x", "unknown key"]),
        ("evaluation.alphas=[0]", ["evaluation.alphas = [0]", "above 0 and at most 1"]),
        ("env.lava-grid.slip=2", ["env.lava-grid.slip = 2", "at least 0 and at most 1"]),
        ("env.lava-grid.slip=nan", ["env.lava-grid.slip = nan", "a finite number"]),
        ("env.lava-grid.horizon=0", ["env.lava-grid.horizon = 0", "from 1 to 1000000"]),
        ("env.lava-grid.horizon=-1", ["env.lava-grid.horizon = -1", "from 1 to 1000000"]),
        ("env.lava-grid.map=..G", ["env.lava-grid.map", "no start"]),
        ("env.lava-grid.map=S..", ["env.lava-grid.map", "no goal"]),
        ("env.lava-point.arena=[1]", ["env.lava-point.arena = [1]", "a list of 2 numbers"]),
        ("env.lava-point.start=[nan, 1]", ["env.lava-point.start", "a finite number"]),
        ("env.lava-point.start=[20, 1]", ["env.lava-point.start", "must lie in the arena"]),
        ("env.lava-point.start=[0.5, 0.5, 1]", ["start", "a list of 2 numbers"]),
        ("env.lava-point.walls=[[1, 1]]", ["env.lava-point.walls[0]: ", "array of length 4"]),
        ("env.lava-point.walls=[[5, 5, 4, 6]]", ["env.lava-point.walls = ", "min < max"]),
        ("env.lava-point.walls=[0.5]", ["env.lava-point.walls[0]: ", "array of length 4"]),
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

/// Whether Algorithm 1 updates the protagonist at all, by its schedule.
#[test]
fn a_run_that_never_updates_the_protagonist_is_refused_with_the_steps_that_would() {
    const GRID: &str = "experiment.envs=[\"lava-grid\"]";
    for (sets, reason) in [
        (&["train.steps=20_000"][..], "eta = 25"),
        (&["train.steps=80_000", "train.follower_updates=8"], "at least 90000"),
        (&["train.steps=20_000", "train.response=0.5"], "at least 50000"),
        (&["train.response=1"], "train.response = 1; lower it"),
        (&["train.steps=20_000", "experiment.etas=[1, 2]"], "eta = 2"),
    ] {
        let message = refusal(None, &[&[GRID], sets].concat());
        assert!(message.contains("never updated") && message.contains(reason), "{message}");
    }
    for sets in [
        &["train.steps=30_000"][..],
        &["train.steps=90_000", "train.follower_updates=8"],
        &["train.steps=50_000", "train.response=0.5"],
        &["train.steps=10_000", "experiment.etas=[1]"],
        &["train.steps=10_000", "train.leader=antagonist"],
        &["train.steps=10_000", "train.adversary=random"],
        &["train.steps=10_000", "train.budget_wait=0.1"],
        &["train.steps=10_000", "experiment.methods=[\"uniform\"]"],
    ] {
        resolve(None, &[&[GRID], sets].concat()).unwrap();
    }
}

#[test]
fn what_is_no_file_or_no_toml_is_refused() {
    let missing =
        Config::resolve(standard().catalogue(), Source::File(Path::new("no/such.toml")), &[])
            .unwrap_err()
            .to_string();
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

fn shipped(name: &str) -> Config {
    let path = format!("{}/configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
    Config::resolve(standard().catalogue(), Source::File(Path::new(&path)), &[]).unwrap()
}

#[test]
fn the_shipped_configurations_are_valid() {
    let paper = [("paper", 120), ("paper-timeless", 60), ("paper-plain", 120)];
    let baselines = [("equal-updates", 40), ("published", 9), ("response", 20)];
    let earlier = [("coordinates", 60), ("ablations", 270)];
    for (name, runs) in [("quick", 18)].into_iter().chain(paper).chain(baselines).chain(earlier) {
        let config = shipped(name);
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
        let run = config.run(&id);
        assert_eq!(run.id(), id);
        std::fs::write(&path, run.to_toml()).unwrap();
        let loaded = RunConfig::load(&path, standard().catalogue()).unwrap();
        assert_eq!(loaded, run);
        assert_eq!(loaded.to_toml(), run.to_toml());
    }
}

#[test]
fn a_runs_configuration_is_checked_when_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("config.toml");
    let config = resolve(None, &[]).unwrap();
    let good = config.run(&plan::runs(&config)[0]).to_toml();
    for (from, to, expected) in [
        ("schema = 1", "schema = 2", "has schema version 2, this program writes"),
        ("schema = 1\n", "", "has schema version none"),
        ("seed = 1", "seed = -1", "seed = -1 (from"),
        ("eta = 1.0", "eta = nan", "eta = nan (from"),
        ("gamma = 1.0", "gamma = 7.0", "gamma = 7.0 (from"),
        ("slip = 0.05", "slip = 5.0", "env.lava-grid.slip = 5.0"),
        ("seed = 1", "seed = 1\nsede = 1", "unknown field `sede`"),
        ("clip = 0.2", "clip = 2.0", "train.protagonist.clip = 2.0"),
        ("[env.lava-grid]", "[env.lava-lake]", "there is no world \"lava-lake\"; the worlds are"),
        ("slip = 0.05", "slap = 0.05", "unknown field `slap`"),
        ("method = \"game\"", "method = \"dqn\"", "method = \"dqn\" (from"),
    ] {
        assert!(good.contains(from), "{good}");
        std::fs::write(&path, good.replace(from, to)).unwrap();
        let message = RunConfig::load(&path, standard().catalogue()).unwrap_err().to_string();
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        assert!(!message.contains('\n'), "{message}");
    }
}

#[test]
fn differences_of_runs_are_listed_by_key() {
    let id: RunId = "lava-grid/game/eta-25/seed-3".parse().unwrap();
    let here = resolve(None, &[]).unwrap().run(&id);
    let there = resolve(None, &["train.steps=30_000", "env.slip=0.1"]).unwrap().run(&id);
    let listed: Vec<String> = here
        .differences(&there)
        .iter()
        .map(|difference| format!("{} {} {}", difference.key, difference.ours, difference.theirs))
        .collect();
    assert_eq!(listed, ["env.lava-grid.slip 0.05 0.1", "train.steps 5000000 30000"]);
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
            "lava-grid/game/eta-25/seed-7",
            "lava-grid/game/eta-25/seed-3",
            "lava-grid/game/eta-1/seed-7",
            "lava-grid/game/eta-1/seed-3",
            "lava-grid/game/eta-2.5/seed-7",
            "lava-grid/game/eta-2.5/seed-3",
            "lava-point/game/eta-25/seed-7",
        ]
    );
}

#[test]
fn a_run_has_one_name_and_stays_in_its_folder() {
    let id: RunId = "lava-point/game/eta-2.5/seed-3".parse().unwrap();
    assert_eq!(id.folder(Path::new("out")), Path::new("out/lava-point/game/eta-2.5/seed-3"));
    // The name of former versions, which had one method and no variants.
    let former: RunId = "lava-point/eta-2.5/seed-3".parse().unwrap();
    assert_eq!(former, id);
    assert_eq!(former.to_string(), "lava-point/game/eta-2.5/seed-3");
    assert_eq!(id.former_name().unwrap(), "lava-point/eta-2.5/seed-3");
    let name = "lava-grid/game/k-1+noise-0.5/eta-25/seed-3";
    let variant: RunId = name.parse().unwrap();
    assert_eq!(variant.variant, Some("k-1+noise-0.5".parse().unwrap()));
    assert_eq!(variant.to_string(), name);
    assert_eq!(variant.former_name(), None);
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
        "lava-grid/../eta-25/seed-3",
        "lava-grid/game/../eta-25/seed-3",
        "lava-grid/game/./eta-25/seed-3",
        "lava-grid/game//eta-25/seed-3",
        "lava-grid/game/.hidden/eta-25/seed-3",
        "lava-grid/game/eta-1/eta-25/seed-3",
        "lava-grid/game/a/b/eta-25/seed-3",
        "lava-grid/ga me/eta-25/seed-3",
        "lava-grid/game/x\\..\\y/eta-25/seed-3",
        "/lava-grid/eta-25/seed-3",
    ] {
        assert!(text.parse::<RunId>().is_err(), "{text:?} was taken for a run");
    }
}

/// The rule that stands right above each key of the annotated default, read once more.
fn stated_rules() -> BTreeMap<String, String> {
    let (mut section, mut above, mut rules) = (String::new(), "", BTreeMap::new());
    for line in standard().catalogue().annotated_default().lines() {
        if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            section = format!("{name}.");
        } else if let Some((key, _)) = line.split_once(" = ")
            && (above.starts_with("# Range: ") || above.starts_with("# One of: "))
        {
            rules.insert(format!("{section}{key}"), above[2..].to_owned());
        }
        above = line;
    }
    rules
}

#[test]
fn every_option_has_a_rule_that_its_default_follows() {
    let stated = stated_rules();
    let config = resolve(None, &[]).unwrap();
    assert_eq!(resolve(Some(standard().catalogue().annotated_default()), &[]).unwrap(), config);
    let mut unstated = Vec::new();
    for option in standard().catalogue().options() {
        assert_eq!(option.stated, stated.contains_key(&option.key), "{}", option.key);
        if !option.stated && !option.default.is_bool() {
            unstated.push(option.key);
        }
    }
    // These are checked by code: variants, shifts, and what relates constants of a world to one another.
    let checked_elsewhere = [
        "env.lava-grid.map",
        "env.lava-point.goal.max",
        "env.lava-point.goal.min",
        "env.lava-point.lava.max",
        "env.lava-point.lava.min",
        "env.lava-point.lesser_goals",
        "env.lava-point.more_goals",
        "env.lava-point.more_lava",
        "env.lava-point.radius",
        "env.lava-point.start",
        "env.lava-point.walls",
        "env.table.model",
        "experiment.shifts",
        "experiment.variant",
    ];
    assert_eq!(unstated, checked_elsewhere);
    assert_eq!(stated["train.family.count"], format!("Range: [1, {MOST}]"));
    let worlds = "One of: \"lava-grid\", \"lava-point\", \"table\", \"lava-grid/SCENE\", \
                  \"lava-point/SCENE\", \"table/SCENE\"";
    assert_eq!(stated["experiment.envs"], worlds);
    assert!(!standard().catalogue().annotated_default().contains("of the program\n"));
}

/// A value of a key is refused by its rule, rather than accepted or found to be in conflict.
fn out_of_range(key: &str, value: &str, is_list: bool) -> bool {
    let set = if is_list && key.starts_with("env.") {
        format!("{key}=[{value}, {value}]")
    } else if is_list {
        format!("{key}=[{value}]")
    } else {
        format!("{key}={value}")
    };
    match resolve(None, &[&set]) {
        Ok(_) => false,
        Err(message) => message.starts_with(&format!("{key} = ")) && message.contains("must be"),
    }
}

#[test]
fn stated_ranges_are_the_ones_that_are_checked() {
    for option in standard().catalogue().options().filter(|option| option.stated) {
        let rule = &stated_rules()[&option.key];
        let Some(range) = rule.strip_prefix("Range: ") else { continue };
        let is_list = option.default.is_array();
        let example = option.default.as_array().map_or(&option.default, |list| &list[0]);
        let is_whole = example.is_integer();
        let (lower, upper) = range.split_once(", ").unwrap();
        let bounds = [
            (&lower[1..], lower.starts_with('['), -1.0),
            (&upper[..upper.len() - 1], upper.ends_with(']'), 1.0),
        ];
        for (text, included, outward) in bounds {
            let Some(bound) = Some(text.parse::<f64>().unwrap()).filter(|bound| bound.is_finite())
            else {
                continue;
            };
            let step = if is_whole { 1.0 } else { (bound.abs() * 1e-9).max(1e-9) };
            let shown =
                |value: f64| if is_whole { format!("{value}") } else { format!("{value:?}") };
            let refused = |value: f64| out_of_range(&option.key, &shown(value), is_list);
            assert_eq!(refused(bound), !included, "{}: {range} at {bound}", option.key);
            assert!(refused(bound + outward * step), "{}: {range} beyond {bound}", option.key);
            assert!(!refused(bound - outward * step), "{}: {range} within {bound}", option.key);
        }
        for value in ["nan", "inf", "-inf", "word", "true", "{}"] {
            let set = if is_list { format!("[{value}]") } else { value.to_owned() };
            refusal(None, &[&format!("{}={set}", option.key)]);
        }
    }
}

proptest::proptest! {
    /// A number is accepted exactly if it is in the interval that the text states.
    #[test]
    fn numbers_are_accepted_exactly_in_their_range(
        index in 0_usize..1_000,
        number in proptest::prop_oneof![
            -3.0_f64..3.0,
            -2e6_f64..2e6,
            proptest::sample::select(vec![0.0, 1.0, -1.0, 100.0, 1e6, 1e300, 0.001]),
        ],
    ) {
        let options: Vec<_> = standard().catalogue()
            .options()
            .filter(|option| stated_rules().get(&option.key).is_some_and(|of| of.starts_with("Range")))
            .collect();
        let option = &options[index % options.len()];
        let range = stated_rules()[&option.key]["Range: ".len()..].to_owned();
        let (lower, upper) = range.split_once(", ").unwrap();
        let (low, high): (f64, f64) =
            (lower[1..].parse().unwrap(), upper[..upper.len() - 1].parse().unwrap());
        let is_list = option.default.is_array();
        let example = option.default.as_array().map_or(&option.default, |list| &list[0]);
        let number = if example.is_integer() { number.clamp(-1e15, 1e15).trunc() } else { number };
        let value =
            if example.is_integer() { format!("{number}") } else { format!("{number:?}") };
        let above = if lower.starts_with('[') { number >= low } else { number > low };
        let below = if upper.ends_with(']') { number <= high } else { number < high };
        proptest::prop_assert_eq!(out_of_range(&option.key, &value, is_list), !(above && below));
    }
}

#[test]
fn former_keys_are_refused_with_their_present_names() {
    for (text, present) in [
        ("train.price_budget = true", "train.budget_sensitivity"),
        ("[env.lava-point.train.bump]\ncount = 3", "train.family.count"),
        ("evaluation.exhibit_episodes = 3", "evaluation.figure_episodes"),
    ] {
        let message = refusal(Some(text), &[]);
        assert!(message.ends_with(&format!("it was renamed to {present}")), "{message}");
    }
}

#[test]
fn a_key_in_quotes_is_not_a_dotted_one() {
    // It was merged as a key of its own and had no effect.
    let message = refusal(Some("\"train.steps\" = 20_000"), &[]);
    assert!(message.contains("unknown key \"train.steps\""), "{message}");
}

/// The runs of a folder of committed results, read as configurations.
fn committed(folder: &str) -> Vec<RunConfig> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("results").join(folder);
    let runs = Store::open(&folder).unwrap().list().unwrap().runs;
    let read = |run: &RunFiles| {
        let text = run.text("config.toml").unwrap().unwrap();
        let path = run.place("config.toml");
        let mut config = RunConfig::parse(&path, &text, standard().catalogue()).unwrap();
        // Former versions did not say it.
        config.variant = run.name.variant.as_ref().map(|name| name.parse().unwrap());
        config
    };
    runs.iter().map(read).collect()
}

#[test]
fn committed_runs_are_those_of_the_shipped_configurations() {
    let paper = ["paper", "paper-timeless", "paper-plain"];
    for name in paper.into_iter().chain(["equal-updates", "published", "coordinates", "ablations"])
    {
        let config = shipped(name);
        let mut planned = plan::runs(&config);
        for run in committed(name) {
            let id = run.id();
            assert_eq!(run.differences(&config.run(&id)), [], "{name}: {id}");
            planned.retain(|planned| *planned != id);
        }
        assert_eq!(planned, [], "all of configs/{name}.toml has been run");
    }
}

const VARIANTS: &str = "
train.steps = 30_000
[experiment]
envs = [\"lava-point\"]
etas = [1, 25]
seeds = [1]
[experiment.axes]
\"env.noise\" = [0.5, 2]
[[experiment.variant]]
name = \"plain\"
[[experiment.variant]]
name = \"short\"
etas = [25]
set = { \"train.steps\" = 80_000, env.substeps = 2 }
";

fn names(config: &Config) -> Vec<String> {
    plan::runs(config).iter().map(RunId::to_string).collect()
}

#[test]
fn variants_and_axes_are_combined() {
    let config = resolve(Some(VARIANTS), &["env.mass=2"]).unwrap();
    assert_eq!(
        names(&config),
        [
            "lava-point/game/plain+noise-0.5/eta-1/seed-1",
            "lava-point/game/plain+noise-0.5/eta-25/seed-1",
            "lava-point/game/plain+noise-2/eta-1/seed-1",
            "lava-point/game/plain+noise-2/eta-25/seed-1",
            "lava-point/game/short+noise-0.5/eta-25/seed-1",
            "lava-point/game/short+noise-2/eta-25/seed-1",
        ]
    );
    let run = config.run(&"lava-point/game/short+noise-0.5/eta-25/seed-1".parse().unwrap());
    let point = run.env.of::<LavaPoint>().unwrap();
    assert_eq!((run.train.steps, point.substeps, point.noise, point.mass), (80_000, 2, 0.5, 2.0));
    assert_eq!(run.variant, Some("short+noise-0.5".parse::<VariantName>().unwrap()));
    // The command line wins over a variant.
    let config = resolve(Some(VARIANTS), &["train.steps=30_000"]).unwrap();
    assert!(plan::runs(&config).iter().all(|id| config.run(id).train.steps == 30_000));
    // What the command line chooses narrows a variant's own choice.
    let config = resolve(Some(VARIANTS), &["experiment.etas=[1, 5]"]).unwrap();
    assert_eq!(plan::runs(&config).len(), 4, "{:?}", names(&config));
    let only = "[[experiment.variant]]\nname = \"a\"\netas = [25]\n";
    assert!(refusal(Some(only), &["experiment.etas=[7]"]).contains("choose others"));
    // Axes may come from the command line, and replace those of the file.
    let config = resolve(Some(VARIANTS), &["experiment.axes.env.noise=[1]"]).unwrap();
    assert_eq!(plan::runs(&config).len(), 3);
    let axes = [
        "experiment.axes.train.protagonist.clip=[0.1, 0.2]",
        "experiment.axes.train.antagonist.clip=[0.3]",
    ];
    let config = resolve(Some("experiment.seeds = [1]"), &axes).unwrap();
    assert_eq!(config.variants[1].name, "protagonist.clip-0.2+antagonist.clip-0.3");
}

#[test]
fn variants_survive_printing_and_their_runs_files() {
    for config in [resolve(Some(VARIANTS), &["env.mass=2"]).unwrap(), shipped("ablations")] {
        let printed = config.to_toml();
        assert_eq!(resolve(Some(&printed), &[]).unwrap().to_toml(), printed);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        for id in plan::runs(&config) {
            let run = config.run(&id);
            std::fs::write(&path, run.to_toml()).unwrap();
            assert_eq!(RunConfig::load(&path, standard().catalogue()).unwrap(), run);
            assert_eq!(run.id(), id);
        }
    }
}

#[test]
fn wrong_variants_are_refused_by_name() {
    let variant = |rest: &str| format!("[[experiment.variant]]\nname = \"k-1\"\n{rest}");
    for (text, parts) in [
        (
            variant("set = { \"train.follower_updates\" = 0 }"),
            ["train.follower_updates = 0", "variant k-1"],
        ),
        (
            variant("set = { \"train.follower\" = 1 }"),
            ["unknown key train.follower ", "variant k-1"],
        ),
        (variant("set = { \"train.price_budget\" = true }"), ["renamed to", "variant k-1"]),
        (
            variant("set = { \"experiment.seeds\" = [1] }"),
            ["a variant sets options of its runs", "variant k-1"],
        ),
        (variant("set = { \"train..steps\" = 1 }"), ["unknown key train..steps", "variant k-1"]),
        (
            variant("set = { \"train.steps\" = 10 }"),
            ["less than one rollout", "(lava-grid, variant k-1)"],
        ),
        (
            variant("set = { \"train.credit\" = \"executed\" }"),
            ["chance decides an action", "(lava-point, variant k-1)"],
        ),
        (variant("envs = [\"lava-lake\"]"), ["experiment.variant.envs", "variant k-1"]),
        (variant("etas = [0.5]"), ["at least 1", "variant k-1"]),
        (variant("etas = []"), ["at least one value", "variant k-1"]),
        (variant("etas = 25"), ["invalid type", "variant k-1"]),
        (variant("seeds = [1]"), ["unknown field `seeds`", "variant k-1"]),
        (variant("[[experiment.variant]]\nname = \"k-1\""), ["two variants named k-1", "own name"]),
        (
            variant("set = { \"train.steps\" = 20_000 }\n[experiment.axes]\n\"train.steps\" = [1]"),
            ["k-1 sets train.steps", "also an axis"],
        ),
        ("[[experiment.variant]]\nname = \"..\"".to_owned(), ["cannot be a name", "variant .."]),
        (
            "[[experiment.variant]]\nname = \"eta-1\"".to_owned(),
            ["cannot be a name", "eta- or seed-"],
        ),
        ("[[experiment.variant]]\netas = [1]".to_owned(), ["missing field `name`", "variant 1"]),
        ("experiment.variant = 1".to_owned(), ["experiment.variant = 1", "[[experiment.variant]]"]),
        ("experiment.axes = 1".to_owned(), ["experiment.axes = 1", "a section"]),
        (
            "experiment.axes.train.steps = 1".to_owned(),
            ["experiment.axes.train.steps = 1", "a list"],
        ),
        ("experiment.axes.train.steps = []".to_owned(), ["at least one value", "steps"]),
        (
            "experiment.axes.train.stops = [1]".to_owned(),
            ["unknown key train.stops", "variant stops-1"],
        ),
        (
            "experiment.axes.train.steps = [40_000, 0]".to_owned(),
            ["train.steps = 0", "variant steps-0"],
        ),
        (
            "experiment.axes.env.start = [[1, 1]]".to_owned(),
            ["gets its name", "[[experiment.variant]]"],
        ),
        ("experiment.axes.env.map = [\"S.G/..\"]".to_owned(), ["cannot be a name", "S.G/.."]),
    ] {
        let message = refusal(Some(&text), &[]);
        for part in parts {
            assert!(message.contains(part), "{text}: {message:?} lacks {part:?}");
        }
    }
    let many: Vec<String> = (1..=40).map(|number| number.to_string()).collect();
    let many = many.join(", ");
    let text = format!(
        "[experiment.axes]\n\"train.follower_updates\" = [{many}]\n\"train.protagonist.epochs\" = [{many}]"
    );
    assert!(refusal(Some(&text), &[]).contains("1600 variants"));
}

#[test]
fn a_file_may_extend_another() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, text).unwrap();
        path
    };
    let load = |path: &Path| Config::resolve(standard().catalogue(), Source::File(path), &[]);
    write("base.toml", "train.steps = 80_000\nenv.lava-point.train.steps = 30_000\n");
    let over = write("sub/over.toml", "extends = \"../base.toml\"\n[train]\nsteps = 40_000\n");
    let last = write("last.toml", "extends = \"sub/over.toml\"\nenv.lava-grid.slip = 0.2\n");
    // A later file wins, also over a world's own section of an earlier one.
    let steps = |config: &Config| WORLDS.map(|world| config.world(world).train.steps);
    assert_eq!(steps(&load(&folder.path().join("base.toml")).unwrap()), [80_000, 30_000]);
    assert_eq!(steps(&load(&over).unwrap()), [40_000, 40_000]);
    let config = load(&last).unwrap();
    assert_eq!(steps(&config), [40_000, 40_000]);
    assert_eq!(config.world("lava-grid").constants.of::<LavaGrid>().unwrap().slip, 0.2);
    for (name, text, part) in [
        ("self.toml", "extends = \"self.toml\"", "in a circle"),
        ("circle.toml", "extends = \"sub/circle.toml\"", "in a circle"),
        ("number.toml", "extends = 3", "3 is no path of a file"),
        ("nowhere.toml", "extends = \"nothing.toml\"", "cannot read "),
        ("below.toml", "[train]\nextends = \"base.toml\"", "unknown key train.extends"),
    ] {
        write("sub/circle.toml", "extends = \"../circle.toml\"");
        let message = load(&write(name, text)).unwrap_err().to_string();
        assert!(message.contains(part), "{name}: {message}");
    }
    for file in 0..20 {
        write(&format!("long-{file}.toml"), &format!("extends = \"long-{}.toml\"", file + 1));
    }
    let message = load(&folder.path().join("long-0.toml")).unwrap_err().to_string();
    assert!(message.contains("more than 16 files"), "{message}");
    let message = refusal(None, &["extends=base.toml"]);
    assert!(message.contains("unknown key extends"), "{message}");
}
