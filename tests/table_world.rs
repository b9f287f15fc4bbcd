//! The world `table`: any finite process, from its CSV file to the table of results.

use assert_cmd::Command;
use cvar_game::exact::finite::ExactWorld;
use lava_envs::{ConfigError, FiniteModel as _, Table, TableConfig, World, conformance};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// FrozenLake 8x8 of Gymnasium, as its Python package writes it (`FiniteMDP.to_csv`; a test there compares).
const LAKE: &str = include_str!("data/frozen-lake-8x8.csv");

fn lake() -> TableConfig {
    TableConfig { model: LAKE.to_owned(), columns: 8, horizon: 200, ..TableConfig::default() }
}

fn refusal(model: &str) -> String {
    let config = TableConfig { model: model.to_owned(), ..TableConfig::default() };
    Table::validate(&config).unwrap_err().to_string()
}

const HEAD: &str = "idstatefrom,idaction,idstateto,probability,reward\n";

#[test]
fn tables_keep_the_promises_of_a_world() {
    conformance::check::<Table>(&Table::defaults());
    conformance::check::<Table>(&lake());
}

/// GAME: the best CVaR of the counterexample at eta = 2 is 0, and Chow's programme says 1/12.
#[test]
fn the_default_table_is_the_counterexample() {
    let exact = ExactWorld::<Table>::new(&Table::defaults(), 1.0).unwrap();
    let summary = exact.solve(2.0).unwrap();
    assert!(summary.optimal_cvar.abs() < 1e-12, "{}", summary.optimal_cvar);
    assert!((summary.chow_value - 1.0 / 12.0).abs() < 1e-3, "{}", summary.chow_value);
}

/// Value iteration over the lines of the file, which knows nothing of worlds.
#[test]
fn the_optimum_at_eta_1_is_that_of_value_iteration() {
    let mut transitions: BTreeMap<[usize; 2], Vec<(usize, f64, f64)>> = BTreeMap::new();
    for line in LAKE.lines().skip(1) {
        let fields: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let [from, action, to] = [0, 1, 2].map(|place| fields[place] as usize);
        transitions.entry([from, action]).or_default().push((to, fields[3], fields[4]));
    }
    let mut value = [0.0; 70];
    for _ in 0..200 {
        let mut next = [f64::NEG_INFINITY; 70];
        for ([from, _], outcomes) in &transitions {
            let mean: f64 = outcomes.iter().map(|(to, p, reward)| p * (reward + value[*to])).sum();
            next[*from] = next[*from].max(mean);
        }
        value = next.map(|of| if of.is_finite() { of } else { 0.0 });
    }
    let exact = ExactWorld::<Table>::new(&lake(), 1.0).unwrap();
    let found = exact.solve(1.0).unwrap().optimal_cvar;
    assert!((found - value[0]).abs() < 1e-9, "{found} is not {}", value[0]);
}

#[test]
fn ids_may_start_at_one_and_columns_may_be_in_any_order() {
    let zero = format!("{HEAD}0,0,1,1,0.5\n0,1,1,1,0.25\n");
    let one =
        "reward,note,idstateto,idaction,probability,idstatefrom\n0.5,x,2,1,1,1\n0.25,,2,2,1,1\n";
    let world = |model: &str| {
        let config = TableConfig { model: model.to_owned(), ..TableConfig::default() };
        Table::new(&config, 1).unwrap()
    };
    let (a, b) = (world(&zero), world(one));
    assert_eq!((a.states(), b.states()), (2, 2));
    for action in 0..a.actions() {
        assert_eq!(a.successor(0, action, 0), b.successor(0, action, 0));
        assert_eq!(a.probabilities(0, action), b.probabilities(0, action));
    }
    // A state with two actions counts them through.
    assert_eq!(a.successor(0, 0, 0), a.successor(0, 2, 0));
    assert_ne!(a.successor(0, 0, 0), a.successor(0, 1, 0));
}

#[test]
fn a_wrong_table_is_refused_with_its_line() {
    for (rows, said) in [
        ("", "model, line 1: it has no transitions"),
        (
            "0,0,1,0.4,0\n",
            "model, line 2: the probabilities of action 0 in state 0 sum to 0.4, not to 1",
        ),
        ("0,0,1,1,0\n0,0,x,1,0\n", "model, line 3: idstateto = \"x\" is no number"),
        ("0,0,1,1,0\n0,2,1,1,0\n", "model, line 3: state 0 has an action 2 but no action 1"),
        (
            "0,0,1.5,1,0\n",
            "model, line 2: idstateto = 1.5 must be a whole number of at most 100000",
        ),
        ("0,0,1,1.5,0\n", "model, line 2: probability = 1.5 must be in [0, 1]"),
        ("0,0,1,1\n", "model, line 2: reward = \"\" is no number"),
        ("0,0,1,1,inf\n", "model, line 2: reward = \"inf\" is no number"),
        (
            "5,0,6,1,0\n",
            "model, line 1: the ids of states must start at 0 or 1, and the first one is 5",
        ),
    ] {
        let found = refusal(&format!("{HEAD}{rows}"));
        assert_eq!(found, said);
    }
    assert!(refusal("a,b\n1,2\n").contains("the header must have idstatefrom,idaction"));
    let many: String = (0..17).map(|action| format!("0,{action},1,1,0\n")).collect();
    assert!(refusal(&(HEAD.to_owned() + &many)).contains("more than 16 actions"));
    let wide: String = (0..20).map(|to| format!("0,0,{},0.05,0\n", to + 1)).collect();
    assert!(refusal(&(HEAD.to_owned() + &wide)).contains("more than 16 different outcomes"));
    let config = TableConfig { start: 3, ..TableConfig::default() };
    let error = Table::validate(&config).unwrap_err();
    assert!(matches!(error, ConfigError::Value { field: "start", .. }), "{error}");
}

fn program(folder: &Path) -> Command {
    let mut command = Command::cargo_bin("cvar-game").unwrap();
    command.current_dir(folder);
    command
}

fn succeed(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// From a file to the page: exact values, training, table, figures.
#[test]
fn a_file_is_solved_trained_on_and_reported() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("lake.csv");
    fs::write(&file, LAKE).unwrap();
    let on_lake = ["--env", "table", "--file", "lake.csv", "--set", "env.horizon=200"];
    let answer =
        succeed(program(folder.path()).arg("exact").args(on_lake).args(["--eta", "1", "--json"]));
    let answer: Value = serde_json::from_str(&answer).unwrap();
    assert!(answer["optimal_cvar"].as_f64().unwrap() > 0.8, "{answer}");
    for eta in ["1", "25"] {
        let run = ["--eta", eta, "--seed", "1", "--steps", "60000", "--out", "out"];
        let small =
            ["--set", "evaluation.episodes=2000", "--set", "evaluation.figure_episodes=2000"];
        succeed(program(folder.path()).arg("train").args(on_lake).args(run).args(small));
    }
    let place: PathBuf = folder.path().join("out/table+lake/game/eta-25/seed-1");
    assert!(place.join("evaluation.json").is_file());
    succeed(program(folder.path()).args(["report", "out"]));
    for figure in ["occupancy", "deviations", "budget"] {
        let path = folder.path().join(format!("out/figures/table+lake-{figure}.png"));
        assert!(path.is_file(), "{figure}");
    }
    let table = succeed(program(folder.path()).args(["table", "out"]));
    assert!(table.contains("table/lake"), "{table}");
    assert!(folder.path().join("out/report.html").is_file());
    // The run knows its process without the file.
    fs::remove_file(&file).unwrap();
    succeed(program(folder.path()).args(["evaluate", "out/table+lake/game/eta-25/seed-1"]));
    let refused = program(folder.path())
        .args(["exact", "--env", "lava-grid", "--file", "x.csv", "--eta", "2"])
        .output()
        .unwrap();
    assert!(!refused.status.success());
}
