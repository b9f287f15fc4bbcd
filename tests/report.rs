//! Tables from synthetic results folders with known answers.

use cvar_game::exact::yardstick::Exploitability;
use cvar_game::experiment::archive::{self, PackedWeights};
use cvar_game::experiment::artefacts::{
    Audit, Certificate, Chance, Close, Evaluation, Manifest, Play, SCHEMA,
};
use cvar_game::experiment::clock::Clock;
use cvar_game::experiment::registry::standard;
use cvar_game::game::returns::{Atom, ReturnLaw};
use cvar_game::learn::policy::Mode;
use cvar_game::report::{self, ReportError};
use lava_envs::End;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Columns of text of the terminal.
const WIDTH: usize = 140;

const STEP: f64 = -0.035;

/// An episode of so many steps: each but the last costs 0.035, lava and goal pay at the last.
fn atom(end: End, steps: u32, mass: f64) -> Atom {
    let value = match end {
        End::Goal => 1.0 + STEP * f64::from(steps - 1),
        End::Lava => -1.0 + STEP * f64::from(steps - 1),
        End::Timeout => STEP * f64::from(steps),
    };
    Atom { value, undiscounted: value, steps, end, mass }
}

fn recorded(atoms: &[(End, u32, usize)]) -> ReturnLaw {
    ReturnLaw::recorded(
        atoms
            .iter()
            .flat_map(|&(end, steps, count)| std::iter::repeat_n(atom(end, steps, 0.0), count)),
    )
}

fn play(protagonist: Mode, chance: Chance, law: ReturnLaw) -> Play {
    let nominal = chance == Chance::Nominal;
    // Some clearance that tells runs apart.
    let clearance = nominal.then(|| (2.0 + law.mean()) * 0.75);
    Play { protagonist, chance, law, mean_clearance: clearance }
}

fn evaluation(env: &str, eta: f64, seed: u64, plays: Vec<Play>) -> Evaluation {
    Evaluation {
        schema: SCHEMA,
        env: env.to_owned(),
        eta,
        seed,
        steps: 1_000_000,
        seconds: 12.5,
        plays,
        audit: None,
        certificate: None,
    }
}

fn folder(dir: &Path, env: &str, eta: f64, seed: u64) -> PathBuf {
    let folder = dir.join(format!("{env}/eta-{eta}/seed-{seed}"));
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn store(dir: &Path, evaluation: &Evaluation) {
    let folder = folder(dir, &evaluation.env, evaluation.eta, evaluation.seed);
    fs::write(folder.join("evaluation.json"), serde_json::to_string(evaluation).unwrap()).unwrap();
}

fn manifest(dir: &Path, env: &str, eta: f64, seed: u64, failure: Option<&str>) {
    let manifest = Manifest {
        schema: SCHEMA,
        run: format!("{env}/eta-{eta}/seed-{seed}"),
        version: "0.1.0".to_owned(),
        commit: None,
        libtorch: Some("2.13.0".to_owned()),
        device: "cpu".to_owned(),
        cpu: "a processor".to_owned(),
        cores: Some(2),
        seconds: 3.0,
        clock: Some(Clock::Processor),
        steps: 250_000,
        close: (seed != 2).then_some(Close { steps: 10_000 * seed, seconds: 0.5 }),
        notes: Vec::new(),
        evaluation_seconds: None,
        failure: failure.map(str::to_owned),
    };
    let folder = folder(dir, env, eta, seed);
    fs::write(folder.join("manifest.json"), serde_json::to_string(&manifest).unwrap()).unwrap();
}

/// What a quick benchmark looks like: exact laws and certificates on the grid, recorded episodes at
/// the point mass.
fn realistic(dir: &Path) {
    realistic_of(dir, 3);
}

fn realistic_of(dir: &Path, seeds: u64) {
    for seed in 1..=seeds {
        let nudge = seed as f64;
        for (eta, lava, steps) in [(1.0, 0.052, 12), (25.0, 0.006, 16), (100.0, 0.0011, 20)] {
            let lava = lava * (0.8 + 0.1 * nudge);
            let law = |lava: f64| {
                ReturnLaw::exact(vec![
                    atom(End::Lava, 4, lava),
                    atom(End::Goal, steps, 0.6),
                    atom(End::Goal, steps + 2, 0.3 - lava),
                    atom(End::Goal, steps + 5, 0.1),
                ])
            };
            let mut plays = vec![
                play(Mode::Greedy, Chance::Nominal, law(lava)),
                play(Mode::Sampled, Chance::Nominal, law(lava * 1.3)),
            ];
            let (optimum, mut gap, mut audit) = (law(lava * 0.9).cvar(1.0 / eta), 0.0, None);
            if eta > 1.0 {
                let share = |rate: f64| (rate * eta * 0.97 * 20_000.0) as usize;
                let under = |rate: f64| {
                    let lost = share(rate).min(20_000);
                    recorded(&[(End::Lava, 4, lost), (End::Goal, steps + 5, 20_000 - lost)])
                };
                let greedy = under(lava);
                gap = greedy.mean() - law(lava).cvar(1.0 / eta);
                plays.push(play(Mode::Greedy, Chance::Antagonist, greedy));
                plays.push(play(Mode::Sampled, Chance::Antagonist, under(lava * 1.3)));
                audit = Some(Audit {
                    trajectories: 20_000,
                    max_budget_use: 1.0 - 1e-9,
                    max_normalisation_error: 1e-12,
                    violations: 0,
                    antagonist_mean: 0.1,
                    antagonist_standard_error: 0.01,
                    weighted_nominal_mean: 0.1,
                    weighted_nominal_standard_error: 0.01,
                });
            }
            let regret = optimum - law(lava).cvar(1.0 / eta);
            let response_gain = if eta > 1.0 { 0.02 + 0.001 * seed as f64 } else { 0.0 };
            let certificate = Certificate {
                optimum,
                regret,
                antagonist_gap: gap,
                regret_standard_error: 0.0,
                antagonist_gap_standard_error: if eta > 1.0 { 0.002 } else { 0.0 },
                class_regret: Some(regret - 0.001),
                exploitability: Some(Exploitability {
                    epsilon: regret.max(response_gain),
                    response_gain,
                    response_error: 1e-5,
                }),
            };
            let mut run = evaluation("lava-grid", eta, seed, plays);
            (run.audit, run.certificate) = (audit, Some(certificate));
            store(dir, &run);
            manifest(dir, "lava-grid", eta, seed, None);

            let lost = (lava * 10_000.0) as usize;
            let episodes = |lost: usize| {
                recorded(&[
                    (End::Lava, 9, lost),
                    (End::Timeout, 40, 20),
                    (End::Goal, steps + 6, 5_000),
                    (End::Goal, steps + 8 + seed as u32, 4_980 - lost),
                ])
            };
            let mut plays = vec![
                play(Mode::Greedy, Chance::Nominal, episodes(lost)),
                play(Mode::Sampled, Chance::Nominal, episodes(lost * 2)),
            ];
            if eta > 1.0 {
                let lost = |lost: usize| (lost as f64 * eta).min(4_900.0) as usize;
                let (greedy, sampled) = (lost((lava * 1e4) as usize), lost((lava * 2e4) as usize));
                plays.push(play(Mode::Greedy, Chance::Antagonist, episodes(greedy)));
                plays.push(play(Mode::Sampled, Chance::Antagonist, episodes(sampled)));
            }
            store(dir, &evaluation("lava-point", eta, seed, plays));
        }
    }
}

fn csv(dir: &Path, file: &str) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(dir.join(file)).unwrap();
    reader.deserialize().map(|row| row.unwrap()).collect()
}

/// The row that has these fields.
fn row<'a>(
    rows: &'a [BTreeMap<String, String>],
    fields: &[(&str, &str)],
) -> &'a BTreeMap<String, String> {
    rows.iter().find(|row| fields.iter().all(|(key, value)| row[*key] == *value)).unwrap()
}

#[test]
fn a_realistic_folder_makes_the_golden_table() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    let markdown = fs::read_to_string(dir.path().join("table.md")).unwrap();
    insta::assert_snapshot!("terminal", terminal);
    insta::assert_snapshot!("markdown", markdown);
    // Three budgets in each world, and the best policy and the best risk-neutral one at each but the first.
    for (file, rows) in [("runs.csv", 18), ("table.csv", 6 + 2 * 5), ("cross.csv", 42)] {
        assert_eq!(csv(dir.path(), file).len(), rows, "{file}");
    }
}

/// Interquartile means, failures and numbers of four digits and a sign included.
#[test]
fn the_terminal_table_fits_140_columns() {
    let dir = tempfile::tempdir().unwrap();
    realistic_of(dir.path(), 10);
    fs::remove_file(dir.path().join("lava-grid/eta-25/seed-10/evaluation.json")).unwrap();
    manifest(dir.path(), "lava-grid", 25.0, 10, Some("update 17: loss of the antagonist is NaN"));
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    assert!(terminal.contains("IQM"));
    let widest = terminal.lines().map(|line| line.chars().count()).max().unwrap();
    assert!(widest <= 140, "the terminal table is {widest} columns wide:\n{terminal}");
}

#[test]
fn the_same_artefacts_give_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let read = || {
        let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
        let files = ["runs.csv", "table.csv", "table.md", "cross.csv"];
        (terminal, files.map(|file| fs::read(dir.path().join(file)).unwrap()))
    };
    assert_eq!(read(), read());
    let left: Vec<String> = fs::read_dir(dir.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.starts_with('.'))
        .collect();
    assert_eq!(left, Vec::<String>::new(), "temporary files stayed behind");
}

/// Four outcomes whose every number can be told by head.
#[test]
fn numbers_of_a_run_are_the_known_ones() {
    let dir = tempfile::tempdir().unwrap();
    let law = recorded(&[(End::Lava, 1, 10), (End::Timeout, 40, 4), (End::Goal, 11, 986)]);
    let game = recorded(&[(End::Lava, 1, 500), (End::Goal, 11, 500)]);
    let plays = vec![
        play(Mode::Greedy, Chance::Nominal, law.clone()),
        play(Mode::Sampled, Chance::Nominal, law),
        play(Mode::Sampled, Chance::Antagonist, game),
    ];
    let mut run = evaluation("lava-point", 100.0, 7, plays);
    run.certificate = Some(Certificate {
        optimum: 0.5,
        regret: 1.5,
        antagonist_gap: -1e-12,
        regret_standard_error: 0.0,
        antagonist_gap_standard_error: 0.0,
        class_regret: Some(-0.25),
        exploitability: Some(Exploitability {
            epsilon: 1.75,
            response_gain: 1.75,
            response_error: 0.125,
        }),
    });
    store(dir.path(), &run);
    report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "runs.csv");
    let found = row(&rows, &[("env", "lava-point"), ("eta", "100"), ("seed", "7")]);
    for (key, expected) in [
        ("status", "finished"),
        ("steps", "1000000"),
        ("seconds", "12.500000"),
        ("greedy_mean", "0.625300"),
        ("greedy_cvar", "-1.160000"),
        ("greedy_lava", "0.010000"),
        ("greedy_goal", "0.986000"),
        ("greedy_timeout", "0.004000"),
        ("greedy_cvar_0.04", "0.032500"),
        ("greedy_cvar_0.01", "-1.160000"),
        ("greedy_var", "-1.000000"),
        ("greedy_steps_to_goal", "11.000000"),
        ("greedy_clearance", "1.968975"),
        ("game_value", "-0.175000"),
        ("game_value_se", "0.026089"),
        ("greedy_game_value", ""),
        ("bound_slack", "0.985000"),
        ("regret", "1.500000"),
        ("antagonist_gap", "0.000000"),
        ("class_regret", "-0.250000"),
        ("response_gain", "1.750000"),
        ("response_error", "0.125000"),
        ("exploitability", "1.750000"),
        ("budget_use", ""),
        ("budget_violations", ""),
    ] {
        assert_eq!(found[key], expected, "{key}");
    }
}

/// At every level of the cross matrix: a law whose lower tail is known.
#[test]
fn cross_matrix_has_every_policy_at_every_alpha() {
    let dir = tempfile::tempdir().unwrap();
    for seed in 1..=2 {
        let law = ReturnLaw::exact(vec![atom(End::Lava, 1, 0.02), atom(End::Goal, 1, 0.98)]);
        let plays = vec![play(Mode::Greedy, Chance::Nominal, law)];
        store(dir.path(), &evaluation("lava-grid", 3.0, seed, plays));
    }
    report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "cross.csv");
    for (alpha, cvar) in [("1", 0.96), ("0.5", 0.92), ("0.1", 0.6), ("0.04", 0.0), ("0.01", -1.0)] {
        let found = row(&rows, &[("eta", "3"), ("alpha", alpha)]);
        for key in ["cvar", "lo", "hi"] {
            assert_eq!(found[key], format!("{cvar:.6}"), "{key} at {alpha}");
        }
    }
    assert_eq!(rows.len(), 7);
}

#[test]
fn differences_are_paired_by_seed_and_level() {
    let dir = tempfile::tempdir().unwrap();
    // eta = 1 loses 10 + seed of 100 episodes, eta = 2 one episode fewer at seed 1, three at seed 2.
    for (eta, lost) in [(1.0, [11, 12]), (2.0, [10, 9])] {
        for (seed, lost) in (1..).zip(lost) {
            let law = recorded(&[(End::Lava, 1, lost), (End::Goal, 1, 100 - lost)]);
            let plays = vec![play(Mode::Greedy, Chance::Nominal, law)];
            store(dir.path(), &evaluation("lava-point", eta, seed, plays));
        }
    }
    report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "table.csv");
    let found = row(&rows, &[("eta", "2")]);
    // One episode of 100 between -1 and 1 moves CVaR_{1/2} by 0.04: differences 0.04 and 0.12.
    assert_eq!(found["gain"], "0.080000");
    assert_eq!(found["gain_pairs"], "2");
    let half = 12.706_205 * 0.04;
    approx::assert_relative_eq!(
        found["gain_lo"].parse::<f64>().unwrap(),
        0.08 - half,
        epsilon = 1e-5
    );
    assert_eq!(found["improvement"], "1.000000");
    assert_eq!(found["cvar_worst"], "0.600000");
    assert_eq!(found["cvar_worst_seed"], "1");
    assert_eq!(row(&rows, &[("eta", "1")])["gain"], "");
}

#[test]
fn an_event_that_never_happened_has_wilsons_interval() {
    let dir = tempfile::tempdir().unwrap();
    for seed in 1..=2 {
        let law = recorded(&[(End::Goal, 1, 500)]);
        let plays = vec![play(Mode::Greedy, Chance::Nominal, law)];
        store(dir.path(), &evaluation("lava-point", 1.0, seed, plays));
    }
    report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "table.csv");
    assert_eq!((rows[0]["lava"].as_str(), rows[0]["lava_lo"].as_str()), ("0.000000", "0.000000"));
    assert_eq!(rows[0]["lava_hi"], "0.003827");
}

#[test]
fn failed_runs_stay_in_and_rank_last() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    fs::remove_file(dir.path().join("lava-grid/eta-25/seed-2/evaluation.json")).unwrap();
    manifest(dir.path(), "lava-grid", 25.0, 2, Some("update 17: loss of the antagonist is NaN"));
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    let runs = csv(dir.path(), "runs.csv");
    let failed = row(&runs, &[("env", "lava-grid"), ("eta", "25"), ("seed", "2")]);
    assert_eq!((failed["status"].as_str(), failed["steps"].as_str()), ("failed", "250000"));
    assert_eq!(failed["greedy_mean"], "");
    let rows = csv(dir.path(), "table.csv");
    let found = row(&rows, &[("env", "lava-grid"), ("eta", "25")]);
    assert_eq!((found["seeds"].as_str(), found["failures"].as_str()), ("3", "1"));
    assert_eq!((found["cvar_worst"].as_str(), found["cvar_worst_seed"].as_str()), ("", "2"));
    assert_eq!(found["gain_pairs"], "2");
    // Two of three runs beat all three at eta = 1; the failed one loses to all.
    assert_eq!(found["improvement"], "0.666667");
    for said in ["1 failed", "FAILED: lava-grid/eta-25/seed-2", "update 17"] {
        assert!(terminal.contains(said), "{said} is not in\n{terminal}");
    }
}

#[test]
fn a_run_in_progress_is_left_out_and_mentioned() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    fs::remove_file(dir.path().join("lava-grid/eta-25/seed-3/evaluation.json")).unwrap();
    fs::create_dir_all(dir.path().join("lava-grid/eta-100/seed-4")).unwrap();
    fs::create_dir_all(dir.path().join("lava-grid/eta-many/seed-4")).unwrap();
    fs::create_dir_all(dir.path().join("figures")).unwrap();
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    assert!(terminal.contains("lava-grid/eta-100/seed-4, lava-grid/eta-25/seed-3"), "{terminal}");
    assert!(terminal.contains("lava-grid/eta-many left out"), "{terminal}");
    assert_eq!(csv(dir.path(), "runs.csv").len(), 17);
}

#[test]
fn a_leaking_or_violated_budget_is_shouted() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let path = dir.path().join("lava-grid/eta-25/seed-1/evaluation.json");
    let mut run: Evaluation = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    run.audit.as_mut().unwrap().violations = 3;
    run.plays[3].law = recorded(&[(End::Lava, 4, 1000)]);
    store(dir.path(), &run);
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    assert!(
        terminal.contains("BUDGET VIOLATED: lava-grid/eta-25/seed-1, 3 violations"),
        "{terminal}"
    );
    assert!(terminal.contains("BUDGET LEAKS: lava-grid/eta-25/seed-1"), "{terminal}");
    assert_eq!(terminal.matches("BUDGET").count(), 2);
}

#[test]
fn json_has_every_row_and_says_null_where_there_is_no_number() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let value = report::table_json(dir.path(), &[], standard()).unwrap();
    assert_eq!(value["schema"], SCHEMA);
    let all = value["worlds"][0]["rows"].as_array().unwrap();
    let (references, rows): (Vec<_>, Vec<_>) = all.iter().partition(|row| row["reference"] == true);
    assert_eq!((rows.len(), references.len()), (3, 5));
    for reference in references {
        assert!(reference["cvar"]["value"].is_f64() && reference["regret"].is_null());
    }
    assert!(rows[1]["cvar"]["low"].as_f64() <= rows[1]["cvar"]["value"].as_f64());
    assert!(rows[0]["gain"].is_null());
    let point = value["worlds"][1]["rows"].as_array().unwrap();
    let trained = point.iter().find(|row| row["eta"] == 25.0 && row["reference"] == false).unwrap();
    assert!(trained["antagonist_gap"].is_null());
    assert!(!dir.path().join("table.csv").exists(), "asking for JSON writes nothing");
}

/// The report of a folder in which something is spoilt: what it says, and the number of its runs.
fn spoilt(spoil: impl FnOnce(&Path)) -> (String, usize) {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    spoil(dir.path());
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    let text = terminal.split_whitespace().collect::<Vec<_>>().join(" ");
    (text, csv(dir.path(), "runs.csv").len())
}

const VICTIM: &str = "lava-point/eta-25/seed-2/evaluation.json";

fn edit(dir: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let path = dir.join(VICTIM);
    let mut value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut value);
    fs::write(path, value.to_string()).unwrap();
}

/// A damaged file costs the row of its run, and no more.
#[test]
fn damaged_and_foreign_files_are_named_and_left_out() {
    type Spoil = Box<dyn FnOnce(&Path)>;
    let cases: [(&str, Spoil); 9] = [
        (
            "EOF",
            Box::new(|dir| {
                let text = fs::read_to_string(dir.join(VICTIM)).unwrap();
                fs::write(dir.join(VICTIM), &text[..text.len() / 2]).unwrap();
            }),
        ),
        ("expected value", Box::new(|dir| fs::write(dir.join(VICTIM), [0xff, 0xfe]).unwrap())),
        ("names no schema", Box::new(|dir| fs::write(dir.join(VICTIM), "[]").unwrap())),
        (
            "schema 999, this program reads schema 1",
            Box::new(|dir| {
                edit(dir, |value| value["schema"] = 999.into());
            }),
        ),
        (
            "missing field `plays`",
            Box::new(|dir| {
                edit(dir, |value| drop(value.as_object_mut().unwrap().remove("plays")));
            }),
        ),
        (
            "belongs to lava-point/eta-25/seed-9",
            Box::new(|dir| {
                edit(dir, |value| value["seed"] = 9.into());
            }),
        ),
        (
            "sum to",
            Box::new(|dir| {
                edit(dir, |value| value["plays"][0]["law"]["atoms"][0]["mass"] = 0.9.into());
            }),
        ),
        (
            "out of order",
            Box::new(|dir| {
                edit(dir, |value| value["plays"][0]["law"]["atoms"][0]["value"] = 9.0.into());
            }),
        ),
        (
            "no episodes",
            Box::new(|dir| {
                edit(dir, |value| value["plays"][0]["law"]["atoms"] = serde_json::json!([]));
            }),
        ),
    ];
    for (what, spoil) in cases {
        let (said, runs) = spoilt(spoil);
        assert!(said.contains(VICTIM) && said.contains(what), "{what}: {said}");
        assert!(said.contains("! LEFT OUT: lava-point/eta-25/seed-2."), "{said}");
        assert_eq!(runs, 17, "{what}");
    }
    let (said, runs) = spoilt(|dir| {
        fs::write(dir.join("lava-grid/eta-1/seed-1/manifest.json"), "{").unwrap();
    });
    assert!(said.contains("lava-grid/eta-1/seed-1/manifest.json is damaged"), "{said}");
    assert_eq!(runs, 17);
}

#[test]
fn a_run_in_two_folders_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let world = dir.path().join("lava-grid");
    for twin in ["eta-25.0/seed-1", "game/eta-25/seed-1"] {
        fs::create_dir_all(world.join(twin)).unwrap();
        let file = "evaluation.json";
        fs::copy(world.join("eta-25/seed-1").join(file), world.join(twin).join(file)).unwrap();
        let error = report::write(dir.path(), standard(), WIDTH).unwrap_err().to_string();
        assert!(error.contains("two folders hold lava-grid/eta-25/seed-1"), "{error}");
        assert!(!dir.path().join("runs.csv").exists(), "nothing is written after {error}");
        fs::remove_dir_all(world.join(twin)).unwrap();
    }
}

#[test]
fn a_folder_without_runs_says_what_is_expected() {
    let dir = tempfile::tempdir().unwrap();
    let error = report::write(dir.path(), standard(), WIDTH).unwrap_err();
    assert!(matches!(error, ReportError::NoRuns { .. }));
    assert!(error.to_string().contains("WORLD/METHOD/eta-E/seed-N"), "{error}");
    folder(dir.path(), "lava-grid", 1.0, 1);
    let error = report::write(dir.path(), standard(), WIDTH).unwrap_err();
    assert!(error.to_string().contains("in progress"), "{error}");
    let error = report::write(&dir.path().join("nowhere"), standard(), WIDTH).unwrap_err();
    assert!(matches!(error, ReportError::Read { .. }) && error.to_string().contains("nowhere"));
    // Of one damaged run nothing is left to report.
    store(dir.path(), &evaluation("lava-grid", 1.0, 1, Vec::new()));
    fs::write(dir.path().join("lava-grid/eta-1/seed-1/evaluation.json"), "{").unwrap();
    let error = report::write(dir.path(), standard(), WIDTH).unwrap_err();
    assert!(matches!(error, ReportError::Corrupt { .. }), "{error}");
    assert_eq!(error.to_string().lines().count(), 1, "{error}");
}

/// The folder beside itself with three seeds worse and one method of another program.
#[test]
fn folders_are_put_side_by_side() {
    let (ours, theirs) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (ours, theirs) = (ours.path().join("ours"), theirs.path().join("theirs"));
    for (dir, lost) in [(&ours, [1, 2, 3]), (&theirs, [11, 12, 13])] {
        for (seed, lost) in (1..).zip(lost) {
            let folder = folder(dir, "lava-point", 2.0, seed);
            let mut text = "steps,end,return,clearance\n".to_owned();
            text += &"1,lava,-1,0\n".repeat(10 * lost);
            text += &"1,goal,1,0.5\n".repeat(10 * (100 - lost));
            fs::write(folder.join("episodes.csv"), text).unwrap();
        }
    }
    let terminal =
        report::write_comparison(&ours, std::slice::from_ref(&theirs), standard(), WIDTH).unwrap();
    let rows = csv(&ours, "comparison.csv");
    let (first, second) = (row(&rows, &[("folder", "ours")]), row(&rows, &[("folder", "theirs")]));
    // An episode of 100 between -1 and 1 moves CVaR_{1/2} by 0.04; ten more are lost at every seed.
    assert_eq!((first["cvar"].as_str(), second["cvar"].as_str()), ("0.920000", "0.520000"));
    assert_eq!(
        (second["versus"].as_str(), second["versus_lo"].as_str()),
        ("-0.400000", "-0.400000")
    );
    assert_eq!(
        (second["versus_pairs"].as_str(), second["versus_improvement"].as_str()),
        ("3", "0.000000")
    );
    assert_eq!(first["versus"], "");
    assert_eq!(first["clearance"], "0.490000");
    for said in ["lava-point: against ours", "0.920*", "0.520 "] {
        assert!(terminal.contains(said), "{said} is not in\n{terminal}");
    }
    let latex = fs::read_to_string(ours.join("comparison.tex")).unwrap();
    assert!(latex.contains("\\textbf{0.920}") && !latex.contains("\\textbf{0.520}"), "{latex}");
    fs::write(theirs.join("lava-point/eta-2/seed-2/episodes.csv"), "return,steps\n1,2\n").unwrap();
    let said = report::write_comparison(&ours, &[theirs], standard(), WIDTH).unwrap();
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(said.contains("! theirs: LEFT OUT: lava-point/eta-2/seed-2."), "{said}");
    assert!(said.contains("episodes.csv") && said.contains("missing field `end`"), "{said}");
    assert_eq!(row(&csv(&ours, "comparison.csv"), &[("folder", "theirs")])["versus_pairs"], "2");
}

/// A folder with the method `game`, a variant of it and a method of another program.
#[test]
fn methods_and_variants_of_one_folder_are_compared() {
    let dir = tempfile::tempdir().unwrap();
    let names =
        [("lava-point", [1, 2]), ("lava-point/game/k-1", [11, 12]), ("lava-point/mine", [6, 7])];
    let lose = |world: &str, lost: [usize; 2]| {
        for (seed, lost) in (1..).zip(lost) {
            let folder = folder(dir.path(), world, 2.0, seed);
            let mut text = "steps,end,return\n".to_owned();
            text += &"1,lava,-1\n".repeat(lost);
            text += &"1,goal,1\n".repeat(100 - lost);
            fs::write(folder.join("episodes.csv"), text).unwrap();
        }
    };
    names[..2].iter().for_each(|(name, lost)| lose(name, *lost));
    report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "table.csv");
    let names_of = |rows: &[BTreeMap<String, String>]| -> Vec<String> {
        let trained = rows.iter().filter(|row| row["seeds"] != "0");
        trained.map(|row| row["method"].clone()).collect()
    };
    assert_eq!(
        names_of(&rows),
        ["game", "k-1"],
        "only one method: its variants need no other name"
    );
    names[2..].iter().for_each(|(name, lost)| lose(name, *lost));
    let terminal = report::write(dir.path(), standard(), WIDTH).unwrap();
    let rows = csv(dir.path(), "table.csv");
    assert_eq!(names_of(&rows), ["game", "game/k-1", "mine"]);
    // An episode of 100 between -1 and 1 moves CVaR_{1/2} by 0.04.
    for (name, versus) in [("game", ""), ("game/k-1", "-0.400000"), ("mine", "-0.200000")] {
        assert_eq!(row(&rows, &[("method", name)])["versus"], versus, "{name}");
    }
    assert!(terminal.contains("lava-point: against game"), "{terminal}");
    let runs = csv(dir.path(), "runs.csv");
    assert_eq!(runs.len(), 6);
    row(
        &runs,
        &[("method", "game"), ("variant", "k-1"), ("seed", "2"), ("greedy_lava", "0.120000")],
    );
    row(&runs, &[("method", "mine"), ("variant", ""), ("seed", "1")]);
    assert_eq!(csv(dir.path(), "cross.csv").len(), 21);
    let json = report::table_json(dir.path(), &[], standard()).unwrap();
    let of = &json["worlds"][0]["rows"][1];
    assert_eq!((of["method"].as_str(), of["variant"].as_str()), (Some("game"), Some("k-1")));
}

/// What `write` leaves in a folder, but for the folders of runs and the archive.
fn written(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    report::write(dir, standard(), WIDTH).unwrap();
    let names = ["runs.csv", "table.csv", "table.md", "table.tex", "cross.csv"];
    names.into_iter().map(|name| (name.to_owned(), fs::read(dir.join(name)).unwrap())).collect()
}

#[test]
fn packed_runs_are_read_as_if_their_folders_were_there() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    manifest(dir.path(), "lava-grid", 25.0, 9, Some("update 17: loss of the antagonist is NaN"));
    fs::create_dir_all(dir.path().join("lava-grid/eta-25/seed-8")).unwrap();
    let weights = dir.path().join("lava-grid/eta-25/seed-3/final.safetensors");
    fs::write(&weights, "weights").unwrap();
    let evaluation = dir.path().join("lava-grid/eta-25/seed-2/evaluation.json");
    let text = fs::read(&evaluation).unwrap();
    let before = written(dir.path());

    let summary = archive::pack(dir.path(), PackedWeights::None).unwrap();
    assert_eq!((summary.packed, summary.runs), (19, 19));
    // A run that has not ended stays, and so do weights.
    let left = ["lava-grid/eta-25/seed-3", "lava-grid/eta-25/seed-8"].map(|of| dir.path().join(of));
    assert_eq!(BTreeSet::from_iter(summary.left), BTreeSet::from_iter(left));
    assert!(weights.exists() && !evaluation.exists() && !dir.path().join("lava-point").exists());
    assert_eq!(written(dir.path()), before);
    let bytes = fs::read(dir.path().join("runs.zip")).unwrap();

    // A run in a folder wins over the archive, and another `pack` replaces it there.
    fs::create_dir_all(evaluation.parent().unwrap()).unwrap();
    fs::write(&evaluation, String::from_utf8(text.clone()).unwrap().replace("12.5", "99.5"))
        .unwrap();
    let changed = written(dir.path());
    assert_ne!(changed, before);
    let summary = archive::pack(dir.path(), PackedWeights::None).unwrap();
    assert_eq!((summary.packed, summary.runs), (1, 19));
    assert_eq!(written(dir.path()), changed);
    // The same files, the same bytes; the name of the folder may be that of this version.
    let renamed = dir.path().join("lava-grid/game/eta-25/seed-2/");
    fs::create_dir_all(&renamed).unwrap();
    fs::write(renamed.join("evaluation.json"), &text).unwrap();
    manifest(dir.path(), "lava-grid/game", 25.0, 2, None);
    assert_eq!(archive::pack(dir.path(), PackedWeights::None).unwrap().runs, 19);
    assert_eq!(written(dir.path()), before);
    let again = tempfile::tempdir().unwrap();
    realistic(again.path());
    manifest(again.path(), "lava-grid", 25.0, 9, Some("update 17: loss of the antagonist is NaN"));
    archive::pack(again.path(), PackedWeights::None).unwrap();
    assert_eq!(fs::read(again.path().join("runs.zip")).unwrap(), bytes);
}

#[test]
fn damaged_archives_and_members_are_named() {
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    archive::pack(dir.path(), PackedWeights::None).unwrap();
    let path = dir.path().join("runs.zip");
    let sound = fs::read(&path).unwrap();
    // In the middle of the first member's data.
    let mut bytes = sound.clone();
    bytes[200] ^= 0xff;
    fs::write(&path, &bytes).unwrap();
    let said = report::write(dir.path(), standard(), WIDTH).unwrap();
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(said.contains("LEFT OUT: lava-grid/eta-1/seed-1."), "{said}");
    assert!(said.contains("runs.zip/lava-grid/eta-1/seed-1/"), "{said}");
    assert_eq!(csv(dir.path(), "runs.csv").len(), 17);
    for bytes in [&sound[..sound.len() / 2], b"not an archive"] {
        fs::write(&path, bytes).unwrap();
        let error = report::write(dir.path(), standard(), WIDTH).unwrap_err().to_string();
        assert!(error.contains("runs.zip"), "{error}");
        assert!(archive::pack(dir.path(), PackedWeights::None).is_err());
    }
}

/// A member that is far larger than any file of a run takes no more memory than one.
#[test]
fn a_bomb_in_an_archive_is_refused() {
    use std::io::Write;
    let dir = tempfile::tempdir().unwrap();
    realistic(dir.path());
    let file = fs::File::create(dir.path().join("runs.zip")).unwrap();
    let mut bomb = zip::ZipWriter::new(file);
    let options = zip::write::SimpleFileOptions::default();
    bomb.start_file("lava-grid/eta-25/seed-77/evaluation.json", options).unwrap();
    let zeros = vec![0; 1 << 20];
    (0..65).for_each(|_| bomb.write_all(&zeros).unwrap());
    // Names that lead out of the folder are no runs.
    bomb.start_file("../../lava-grid/eta-25/seed-78/evaluation.json", options).unwrap();
    bomb.finish().unwrap();
    let said = report::write(dir.path(), standard(), WIDTH).unwrap();
    assert!(
        said.contains("LEFT OUT: lava-grid/eta-25/seed-77") && said.contains("larger than"),
        "{said}"
    );
    assert_eq!(csv(dir.path(), "runs.csv").len(), 18);
}

/// The committed tables are those of the committed archives.
#[test]
fn committed_results_make_their_tables_again() {
    let results = Path::new(env!("CARGO_MANIFEST_DIR")).join("results");
    let paper = ["paper", "paper-timeless", "paper-plain"];
    for sweep in paper.iter().chain(&[
        "equal-updates",
        "published",
        "response",
        "coordinates",
        "coordinates-held-out",
        "ablations",
        "methods",
        "suite",
        "frozen-lake",
    ]) {
        let dir = tempfile::tempdir().unwrap();
        let (from, to) = (results.join(sweep), dir.path().join(sweep));
        fs::create_dir(&to).unwrap();
        fs::copy(from.join("runs.zip"), to.join("runs.zip")).unwrap();
        for (name, bytes) in written(&to) {
            assert!(bytes == fs::read(from.join(&name)).unwrap(), "results/{sweep}/{name} differs");
        }
    }
}

/// With TeX Live's pdflatex (Debian: texlive-latex-base, texlive-latex-recommended).
#[test]
#[ignore = "needs pdflatex"]
fn the_latex_tables_compile_and_fit() {
    let dir = tempfile::tempdir().unwrap();
    realistic_of(dir.path(), 10);
    manifest(dir.path(), "lava-grid", 25.0, 11, Some("100 % of \\ {broken} $ & _ # ~ ^"));
    report::write(dir.path(), standard(), WIDTH).unwrap();
    report::write_comparison(
        dir.path(),
        &[dir.path().join("../").join(dir.path().file_name().unwrap())],
        standard(),
        WIDTH,
    )
    .unwrap();
    let document = "\\documentclass{article}\\usepackage{booktabs,graphicx}\\begin{document}\n\
                    \\input{table}\\input{comparison}\n\\end{document}\n";
    fs::write(dir.path().join("paper.tex"), document).unwrap();
    let output = std::process::Command::new("pdflatex")
        .args(["-halt-on-error", "paper.tex"])
        .current_dir(dir.path())
        .output()
        .unwrap();
    let log = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{log}");
    assert!(!log.contains("Overfull"), "{log}");
}
