//! Scenes: every one of the program keeps the promises of a world, in both worlds, and configurations place worlds on
//! them.

use cvar_game::exact::oracle::{Effort, shipped, shipped_bound};
use cvar_game::experiment::config::{Config, ConfigError, Setting, Source, scenes};
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::plan;
use cvar_game::experiment::registry::standard;
use lava_envs::conformance::check;
use lava_envs::map::{Map, Tile};
use lava_envs::random::{Purpose, stream};
use lava_envs::{GridConfig, LavaGrid, LavaPoint, PointConfig, World};
use rand::RngExt;
use std::path::Path;

fn resolved(scenes: &[&str], settings: &[&str]) -> Result<Config, ConfigError> {
    let settings: Vec<Setting> =
        settings.iter().map(|text| Setting::parse(text).unwrap()).collect();
    let scenes: Vec<String> = scenes.iter().map(|&scene| scene.to_owned()).collect();
    Config::resolve_on(standard().catalogue(), Source::Default, &settings, &scenes)
}

fn on(scenes: &[&str], settings: &[&str]) -> Config {
    resolved(scenes, settings).unwrap()
}

fn refused(scenes: &[&str], settings: &[&str]) -> String {
    resolved(scenes, settings).expect_err("it should be refused").to_string()
}

/// The rows of the table of docs/scenes.md with so many columns of numbers: the scene's name, then these.
fn documented(columns: usize) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string("docs/scenes.md").unwrap();
    let cells = |line: &str| -> Vec<String> {
        let cells = line.trim_matches('|').split('|');
        cells.map(|cell| cell.trim().trim_matches('`').to_owned()).collect()
    };
    let rows = text.lines().filter(|line| line.starts_with("| `")).map(cells);
    let rows: Vec<Vec<String>> = rows.filter(|row| row.len() == 1 + columns).collect();
    let all = scenes::all().map(|(name, _)| name);
    assert!(all.eq(rows.iter().map(|row| row[0].as_str())), "the documented scenes: {rows:?}");
    rows
}

fn grid(config: &Config, name: &str) -> GridConfig {
    config.world(name).constants.of::<LavaGrid>().unwrap()
}

fn point(config: &Config, name: &str) -> PointConfig {
    config.world(name).constants.of::<LavaPoint>().unwrap()
}

#[test]
fn every_scene_keeps_the_promises_of_both_worlds() {
    for (name, scene) in scenes::all() {
        let config = on(&[name], &[]);
        let cells = grid(&config, &format!("lava-grid/{name}"));
        assert_eq!(Map::parse(&cells.map).unwrap(), scene.map);
        check::<LavaGrid>(&cells);
        check::<LavaPoint>(&point(&config, &format!("lava-point/{name}")));
        assert!(scene.about.ends_with('.'), "{name} says {:?}", scene.about);
        let difficulty = scene.difficulty.unwrap();
        let known = ["distance", "gap", "route", "goal", "memory"];
        assert!(known.contains(&&*difficulty), "{name} says {difficulty:?}");
    }
}

/// The areas of the plane are those of the map, cell by cell.
#[test]
fn the_plane_has_the_cells_of_the_map() {
    let mut random = stream(1, Purpose::Outcomes, 0);
    for _ in 0..300 {
        let size = [random.random_range(2..9), random.random_range(2..9)];
        let mut cells: Vec<char> = (0..size[0] * size[1])
            .map(|_| ['.', '.', '.', 'L', 'G', 'g', '#'][random.random_range(0..7)])
            .collect();
        // One start, and one of each that a plane needs.
        (cells[0], cells[1], cells[2]) = ('S', 'L', 'G');
        let picture: Vec<String> = cells.chunks(size[0]).map(|row| row.iter().collect()).collect();
        let map = Map::parse(&picture.join("\n")).unwrap();
        let config: PointConfig = {
            let mut table = toml::Table::try_from(PointConfig::default()).unwrap();
            table.extend(LavaPoint::of_map(&map).unwrap());
            table.try_into().unwrap()
        };
        let world = LavaPoint::new(&config, 1).unwrap();
        let [width, height] = world.scene().size;
        assert_eq!([width, height], size.map(|cells| cells as f64));
        for cell in 0..map.cells() {
            let (x, y) = map.coordinates(cell);
            let centre = [x as f64 + 0.5, y as f64 + 0.5];
            let inside = |min: [f64; 2], max: [f64; 2]| {
                (0..2).all(|axis| (min[axis]..max[axis]).contains(&centre[axis]))
            };
            let kinds: Vec<lava_envs::AreaKind> = (world.scene().areas.iter())
                .filter(|area| inside(area.min, area.max))
                .map(|area| area.kind)
                .collect();
            use lava_envs::AreaKind::{Goal, Lava, LesserGoal, Wall};
            let expected = match map.tile(cell) {
                Tile::Free => vec![],
                Tile::Lava => vec![Lava],
                Tile::Goal => vec![Goal],
                Tile::LesserGoal => vec![LesserGoal],
                Tile::Wall => vec![Wall],
            };
            assert_eq!(kinds, expected, "cell ({x}, {y}) of\n{map}");
        }
    }
}

/// The default worlds are the first scene.
#[test]
fn the_paper_s_scene_is_the_default() {
    let config = on(&["strait"], &[]);
    assert_eq!(grid(&config, "lava-grid/strait"), GridConfig::default());
    assert_eq!(point(&config, "lava-point/strait"), PointConfig::default());
}

/// A scene's other constants yield to a setting of the world; its map does not, and a setting of the world on the scene
/// wins over both.
#[test]
fn settings_of_a_world_hold_on_its_scenes() {
    let own_map = r#"env.lava-grid.map="S.G""#;
    let config = on(&["island"], &["env.slip=0.2", own_map, "env.lava-grid/island.horizon=77"]);
    let island = grid(&config, "lava-grid/island");
    assert_eq!((island.slip, island.horizon), (0.2, 77));
    assert_eq!(Map::parse(&island.map).unwrap(), scenes::shipped("island").unwrap().map);
    assert_eq!(grid(&config, "lava-grid").map, "S.G");
    let training = on(&["island"], &["env.lava-grid.train.steps=123456"]);
    assert_eq!(training.world("lava-grid/island").train.steps, 123_456);
    let training =
        on(&["island"], &["train.steps=7777777", "env.lava-grid/island.train.steps=654321"]);
    assert_eq!(training.world("lava-grid/island").train.steps, 654_321);
    assert_eq!(training.world("lava-point/island").train.steps, 7_777_777);
}

/// The resolved configuration of a sweep on scenes resolves to itself, without the file of a scene.
#[test]
fn a_resolved_configuration_needs_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let own = folder.path().join("my-own.toml");
    let text = "about = \"Two lanes.\"\nhorizon = 25\nmap = \"\"\"\nS.LL.G\n......\n\"\"\"\n[lava-point]\nnoise = 1.0\n";
    std::fs::write(&own, text).unwrap();
    let config = on(&[own.to_str().unwrap(), "detour"], &["experiment.seeds=[1]"]);
    std::fs::remove_file(&own).unwrap();
    let (cells, plane) = (grid(&config, "lava-grid/my-own"), point(&config, "lava-point/my-own"));
    assert_eq!((cells.horizon, plane.horizon, plane.noise), (25, 25, 1.0));
    assert_eq!((plane.arena, plane.start), ([6.0, 2.0], [0.5, 0.5]));

    let resolved = folder.path().join("resolved.toml");
    std::fs::write(&resolved, config.to_toml()).unwrap();
    let source = Source::File(&resolved);
    let again = Config::resolve(standard().catalogue(), source, &[]).unwrap();
    assert_eq!(again.to_toml(), config.to_toml());
    assert_eq!(plan::runs(&again), plan::runs(&config));
    for id in plan::runs(&config) {
        assert_eq!(id.to_string().parse::<RunId>().unwrap(), id);
        assert!(id.folder(Path::new("out")).starts_with(format!("out/{}", id.world.as_file())));
        let run = config.run(&id);
        assert_eq!(again.run(&id), run);
        let path = folder.path().join("config.toml");
        let catalogue = standard().catalogue();
        let parsed =
            cvar_game::experiment::config::RunConfig::parse(&path, &run.to_toml(), catalogue);
        assert_eq!(parsed.unwrap(), run);
    }
}

#[test]
fn wrong_scenes_are_refused_in_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let map = "map = \"\"\"\nS.L.G\n.....\n\"\"\"\n";
    let wrong = [
        (refused(&["nowhere"], &[]), "there is no scene \"nowhere\"; the scenes are strait, "),
        (refused(&["nowhere.toml"], &[]), "cannot read nowhere.toml"),
        (refused(&[&file("a.toml", "about = \"A.\"")], &[]), "a scene needs the key map"),
        (refused(&[&file("b.toml", map)], &[]), "a scene needs the key about"),
        (
            refused(&[&file("c.toml", "about = \"C.\"\nmap = \"S.X\"")], &[]),
            "c.toml: map, row 1, column 3: 'X' is no cell",
        ),
        (
            refused(
                &[&file("d.toml", &format!("about = \"D.\"\n{map}[lava-grid]\nnoise = 1"))],
                &[],
            ),
            "lava-grid has no constant noise",
        ),
        (
            refused(&[&file("e.toml", "about = \"E.\"\nmap = \"S.G\"")], &[]),
            "lava-point cannot be played here: the map has no lava `L`",
        ),
        (
            refused(&[&file("f.toml", &format!("about = \"F.\"\nhorizont = 3\n{map}"))], &[]),
            "no world has a constant horizont",
        ),
        (
            refused(&[], &["experiment.envs=[\"lava-grid/x y\"]"]),
            "\"lava-grid/x y\" cannot be a name",
        ),
    ];
    for (message, part) in wrong {
        assert!(message.contains(part), "{message:?} does not contain {part:?}");
        assert!(!message.contains('\n'), "{message:?}");
    }
}

/// The best CVaR of a scene on lava-grid, and what the risk-neutral policy and Chow's programme say.
fn solved(name: &str, eta: f64) -> serde_json::Value {
    let config = on(&[name], &[]);
    let constants = &config.world(format!("lava-grid/{name}")).constants;
    let options = Default::default();
    let answer = standard().world(constants).unwrap().solve(constants, 1.0, eta, &options, &());
    serde_json::from_str(&answer.unwrap().json()).unwrap()
}

/// The table of docs/scenes.md.
#[test]
fn the_documented_optima_are_those_of_the_solver() {
    for row in documented(5) {
        let [neutral, twentyfifth, hundredth] = [1.0, 25.0, 100.0].map(|eta| solved(&row[0], eta));
        let found = [
            &neutral["optimal_cvar"],
            &twentyfifth["optimal_cvar"],
            &twentyfifth["risk_neutral_cvar"],
            &hundredth["optimal_cvar"],
            &hundredth["risk_neutral_cvar"],
        ];
        let found = found.map(|number| format!("{:.4}", number.as_f64().unwrap()));
        assert_eq!(found, row[1..], "{}", row[0]);
    }
}

/// On five scenes, against `tests/data/scene_optima.py`.
#[test]
fn the_optima_are_those_of_an_independent_programme() {
    let reference: serde_json::Value =
        serde_json::from_str(include_str!("data/scene_optima.json")).unwrap();
    let etas: Vec<f64> = serde_json::from_value(reference["etas"].clone()).unwrap();
    let scenes = reference["scenes"].as_object().unwrap();
    assert_eq!(scenes.len(), 5);
    for (name, expected) in scenes {
        for (place, &eta) in etas.iter().enumerate() {
            let found = solved(name, eta)["optimal_cvar"].as_f64().unwrap();
            let expected = expected[place].as_f64().unwrap();
            assert!((found - expected).abs() < 1e-9, "{name}, eta {eta}: {found}, {expected}");
        }
    }
}

/// The certificates of lava-point and its upper bounds come with the program, and docs/scenes.md has their values.
#[test]
fn every_scene_has_shipped_certificates() {
    for row in documented(3) {
        let name = row[0].as_str();
        let config = point(&on(&[name], &[]), &format!("lava-point/{name}"));
        let found = [1.0, 25.0, 100.0].map(|eta| {
            let certified = shipped(&config, 1.0, eta, &Effort::of(&config))
                .unwrap_or_else(|| panic!("{name} has no certificate at {eta}"));
            let best =
                certified.baselines.iter().map(|script| script.cvar).fold(f64::MIN, f64::max);
            assert!(certified.certified_cvar >= best, "{name}, eta {eta}: {certified}");
            let bound = shipped_bound(&config).unwrap_or_else(|| panic!("{name} has no bound"));
            let above = bound.at(1.0 / eta);
            assert!(above > certified.certified_cvar_hi, "{name}, eta {eta}: {above}");
            format!("{:.3} ({above:.3})", certified.certified_cvar)
        });
        assert_eq!(found, row[1..], "{name}");
    }
}

#[test]
fn chow_s_programme_is_far_off_on_its_scene() {
    let off = |name, eta| {
        let answer = solved(name, eta);
        answer["chow_value"].as_f64().unwrap() - answer["optimal_cvar"].as_f64().unwrap()
    };
    assert!(off("chow-gap", 4.0) > 0.05 && off("strait", 4.0) < 0.002);
}

/// The corridor up to a budget, the long way from there on.
#[test]
fn the_optimum_of_the_detour_changes_its_way_once() {
    let corridor = |eta: f64| {
        let path = solved("detour", eta)["path"].clone();
        path.as_array().unwrap().iter().all(|step| step["y"] == 5)
    };
    let (mut low, mut high) = (1.0_f64, 25.0_f64);
    assert!(corridor(low) && !corridor(high));
    while high - low > 0.02 {
        let middle = low.midpoint(high);
        *if corridor(middle) { &mut low } else { &mut high } = middle;
    }
    assert!((low..=high).contains(&SWITCH), "between {low} and {high}");
}

/// The budget at which it does, as the scene says.
const SWITCH: f64 = 2.069;

/// A disc that barely fits finds the way of the map's cells, and one that does not is refused.
#[test]
fn a_way_of_cells_is_a_way_for_every_disc_that_fits() {
    let map = Map::parse("S.#....\n.L#.L#.\n.L...L.\nGLL.L..").unwrap();
    let mut random = stream(2, Purpose::Outcomes, 0);
    let laid = |radius: f64, start: [f64; 2]| {
        let mut table = toml::Table::try_from(PointConfig::default()).unwrap();
        table.extend(LavaPoint::of_map(&map).unwrap());
        let config: PointConfig = table.try_into().unwrap();
        PointConfig { radius, start, ..config }
    };
    for _ in 0..50 {
        let radius = random.random_range(0.01..0.49);
        laid(radius, [0.5, 0.5]).validate().unwrap();
        // On the other side of walls and lava.
        let error = laid(radius, [6.5, 0.5]).validate().unwrap_err().to_string();
        assert!(error.contains("the disc must reach it"), "{error}");
    }
}

/// A variant may have worlds that the experiment does not name; a scene's file holds for them too.
#[test]
fn a_file_of_a_scene_holds_for_the_worlds_of_variants() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, file) = (folder.path().join("own.toml"), folder.path().join("sweep.toml"));
    std::fs::write(&scene, "about = \"Own.\"\nmap = \"\"\"\nS.L.G\n.....\n\"\"\"\n").unwrap();
    let sweep = "[experiment]\nenvs = [\"lava-grid\"]\n\
                 [[experiment.variant]]\nname = \"a\"\nenvs = [\"lava-point\"]\nset = {}\n";
    std::fs::write(&file, sweep).unwrap();
    let scenes = [scene.to_str().unwrap().to_owned()];
    let source = Source::File(&file);
    let config = Config::resolve_on(standard().catalogue(), source, &[], &scenes).unwrap();
    let runs = plan::runs(&config);
    assert!(runs.iter().all(|id| id.world == "lava-point/own"), "{runs:?}");
    let constants = config.run(&runs[0]).env.of::<LavaPoint>().unwrap();
    assert_eq!((constants.arena, constants.start), ([5.0, 2.0], [0.5, 0.5]));
}
