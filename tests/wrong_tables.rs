//! Tables, figures and pages that would be wrong: runs of different tasks, files of other runs, impossible
//! results, damaged files. All of it through the command line.

#[path = "support/program.rs"]
#[expect(dead_code, reason = "other tests compare CSV without its times")]
mod support;

use std::collections::BTreeMap;
use std::fs;
use std::ops::Index;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use support::{program, succeed};
use tempfile::TempDir;

fn said(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Standard output and error of a command that must succeed, each on one line.
#[track_caller]
fn told(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    format!("{} {}", said(&output.stdout), said(&output.stderr))
}

/// The key of the episodes for the figures, which former versions called otherwise.
fn figure_episodes() -> &'static str {
    static KEY: OnceLock<&str> = OnceLock::new();
    KEY.get_or_init(|| {
        let output = succeed(&mut program("config"));
        let text = String::from_utf8(output.stdout).unwrap();
        let former = text.contains("exhibit_episodes");
        if former { "evaluation.exhibit_episodes=500" } else { "evaluation.figure_episodes=500" }
    })
}

fn train(out: &Path, world: &str, eta: &str, seed: u64, sets: &[&str]) {
    let mut command = program("train");
    command.args(["--env", world, "--eta", eta, "--seed", &seed.to_string(), "--out"]).arg(out);
    let all = ["train.steps=30000", "evaluation.episodes=1000", figure_episodes()];
    for set in all.iter().chain(sets) {
        command.args(["--set", set]);
    }
    succeed(&mut command);
}

/// A folder with runs of lava-grid: eta 25 with seeds 1 and 2, and with slip = 0.3 seed 3.
fn trained() -> &'static Path {
    static DIR: OnceLock<TempDir> = OnceLock::new();
    let dir = DIR.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        train(dir.path(), "lava-grid", "25", 1, &[]);
        train(dir.path(), "lava-grid", "25", 2, &[]);
        train(dir.path(), "lava-grid", "25", 3, &["env.slip=0.3"]);
        dir
    });
    dir.path()
}

/// The folders of runs below a folder, by path.
fn runs(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.join("config.toml").exists() {
            found.push(path);
        } else if path.is_dir() {
            found.extend(runs(&path));
        }
    }
    found.sort();
    found
}

/// The run of a seed of [`trained`].
fn run(dir: &Path, seed: u64) -> PathBuf {
    let name = format!("seed-{seed}");
    runs(dir).into_iter().find(|path| path.ends_with(&name)).unwrap()
}

/// A copy of some runs of [`trained`].
fn copy(seeds: &[u64]) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    for seed in seeds {
        let from = run(trained(), *seed);
        let to = dir.path().join(from.strip_prefix(trained()).unwrap());
        fs::create_dir_all(&to).unwrap();
        for entry in fs::read_dir(&from).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    }
    dir
}

/// A file with a header. Columns that it does not have are empty.
fn csv(path: &Path) -> Vec<Row> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    reader.deserialize().map(|row| Row(row.unwrap())).collect()
}

struct Row(BTreeMap<String, String>);

impl Index<&str> for Row {
    type Output = str;

    fn index(&self, column: &str) -> &str {
        self.0.get(column).map_or("", String::as_str)
    }
}

#[test]
fn runs_of_different_tasks_are_not_pooled() {
    let dir = copy(&[1, 2, 3]);
    let text = told(&succeed(program("table").arg(dir.path())));
    let rows = csv(&dir.path().join("table.csv"));
    let found: Vec<(&str, &str)> = rows.iter().map(|row| (&row["method"], &row["seeds"])).collect();
    let (trained, references) = found.split_at(2);
    assert_eq!(trained, [("game, slip=0.05", "2"), ("game, slip=0.3", "1")]);
    let best = ["optimum, slip=0.05", "optimum at eta = 1, slip=0.05", "optimum, slip=0.3"];
    assert_eq!(references.iter().map(|of| of.0).collect::<Vec<_>>()[..3], best);
    assert!(rows[1]["versus"].is_empty(), "{text}");
    for words in ["slip=0.05 | slip=0.3", "rows of their own", "slip (0.05 and 0.3)"] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let runs = csv(&dir.path().join("runs.csv"));
    let settings: Vec<&str> = runs.iter().map(|row| &row["settings"]).collect();
    assert_eq!(settings, ["slip=0.05", "slip=0.05", "slip=0.3"]);
}

#[test]
fn runs_of_different_training_are_not_pooled_and_compared_all_the_same() {
    let dir = copy(&[1, 2]);
    let path = run(dir.path(), 2).join("config.toml");
    let text = fs::read_to_string(&path).unwrap();
    let other = text.replacen("follower_updates = 2", "follower_updates = 4", 1);
    // What is only evaluated otherwise is in one row, with a note.
    let other = other.replacen("episodes = 1000", "episodes = 1001", 1);
    assert_ne!(text, other);
    fs::write(&path, other).unwrap();
    let text = told(&succeed(program("table").arg(dir.path())));
    let rows = csv(&dir.path().join("table.csv"));
    let names: Vec<&str> = rows.iter().map(|row| &row["method"]).collect();
    assert_eq!(names[..2], ["game, follower_updates=2", "game, follower_updates=4"]);
    assert_eq!(names[2..], ["optimum", "optimum at eta = 1"], "they have one task");
    assert!(text.contains("evaluation.episodes is 1000 in 1 run, 1001 in 1 run"), "{text}");
    assert!(text.contains("against game, follower_updates=2"), "{text}");
}

#[test]
fn folders_of_different_tasks_are_shown_without_differences() {
    let (ours, theirs) = (copy(&[1]), copy(&[3]));
    // The same seed, so that the former pairs would be found.
    let (from, seed) = (run(theirs.path(), 3), "seed-1");
    let to = from.with_file_name(seed);
    fs::rename(&from, &to).unwrap();
    for file in ["evaluation.json", "manifest.json", "config.toml"] {
        let text = fs::read_to_string(to.join(file)).unwrap();
        let text = text.replace("seed-3", seed).replace("\"seed\": 3", "\"seed\": 1");
        fs::write(to.join(file), text.replacen("seed = 3", "seed = 1", 1)).unwrap();
    }
    let mut command = program("table");
    let text = told(&succeed(command.arg(ours.path()).arg("--compare").arg(theirs.path())));
    let rows = csv(&ours.path().join("comparison.csv"));
    assert_eq!(rows.iter().filter(|row| &row["seeds"] != "0").count(), 2, "{text}");
    assert!(rows.iter().all(|row| row["versus"].is_empty()), "{text}");
    assert!(text.contains("different tasks: slip (0.05 and 0.3)"), "{text}");
    assert!(text.contains("no difference is shown"), "{text}");
}

/// A few episodes of the run in a folder.
fn played(verb: &str, folder: &Path) -> Command {
    let mut command = program(verb);
    if verb == "rollout" {
        command.arg("--run");
    }
    command.arg(folder).args(["--episodes", "10"]);
    command
}

/// Of one seed under the name of another one.
#[test]
fn weights_and_data_of_figures_are_used_only_in_the_folder_of_their_run() {
    let dir = copy(&[1, 2]);
    let (from, to) = (run(dir.path(), 2), run(dir.path(), 1));
    let names = |dir: &Path| -> Vec<String> {
        let names = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().file_name());
        names.map(|name| name.into_string().unwrap()).collect()
    };
    for verb in ["evaluate", "rollout"] {
        succeed(&mut played(verb, &to));
    }
    for file in names(&from) {
        if file == "final.safetensors" || file == "figure_data.json" || file == "exhibits.json" {
            fs::copy(from.join(&file), to.join(&file)).unwrap();
        }
    }
    for verb in ["evaluate", "rollout"] {
        let output = played(verb, &to).output().unwrap();
        let text = said(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{verb}: {text}");
        for words in ["final.safetensors", "eta-25/seed-1", "eta-25/seed-2"] {
            assert!(text.contains(words), "{verb}, {words}: {text}");
        }
    }
    for verb in ["figures", "report"] {
        let text = told(&succeed(program(verb).arg(dir.path())));
        assert!(text.contains("it is of the run lava-grid/game/eta-25/seed-2"), "{verb}: {text}");
        assert!(
            text.contains("this is the folder of lava-grid/game/eta-25/seed-1"),
            "{verb}: {text}"
        );
    }
}

/// Results of another program: its episodes, and perhaps a `config.toml`.
fn own(dir: &Path, run: &str, episodes: &str, config: Option<&str>) {
    let folder = dir.join(run);
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("episodes.csv"), episodes).unwrap();
    if let Some(config) = config {
        fs::write(folder.join("config.toml"), config).unwrap();
    }
}

fn episodes(lava: usize, goal: usize) -> String {
    let (lava, goal) = ("-1.07,3,lava\n".repeat(lava), "0.475,16,goal\n".repeat(goal));
    format!("return,steps,end\n{lava}{goal}")
}

#[test]
fn impossible_results_of_other_programs_are_refused_by_line() {
    let head = "return,steps,end,clearance\n0.5,12,goal,1\n";
    for (line, words) in [
        ("9.0,12,goal,1", "the return 9 is impossible"),
        ("-9.0,12,lava,1", "the return -9 is impossible"),
        ("0.5,12,goal,nan", "the clearance NaN is no distance"),
        ("0.5,12,goal,-1", "the clearance -1 is no distance"),
        ("inf,12,goal,1", "the return inf is no finite number"),
        ("0.5,41,goal,1", "an episode of 41 steps is impossible"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        own(dir.path(), "lava-grid/eta-2/seed-1", &episodes(10, 90), None);
        own(dir.path(), "lava-grid/eta-2/seed-2", &format!("{head}{line}\n"), None);
        let text = told(&succeed(program("table").arg(dir.path())));
        assert!(text.contains("LEFT OUT: lava-grid/eta-2/seed-2."), "{line}: {text}");
        assert!(text.contains(&format!("line 3: {words}")), "{line}: {text}");
        assert_eq!(&csv(&dir.path().join("table.csv"))[0]["seeds"], "1");
    }
    // With other constants, which the results bring, the same return is possible.
    let dir = tempfile::tempdir().unwrap();
    let config = "[env.lava-grid]\ngoal_reward = 10\n";
    let text = format!("return,steps,end\n{}", "9.475,16,goal\n".repeat(50));
    own(dir.path(), "lava-grid/eta-2/seed-1", &text, Some(config));
    succeed(program("table").arg(dir.path()));
    assert_eq!(&csv(&dir.path().join("table.csv"))[0]["cvar"], "9.475000");
}

/// V*(eta) is exact on lava-grid. It is that of the constants which the results bring.
#[test]
fn results_of_other_programs_have_a_regret() {
    let optimum = |sets: &[&str]| -> f64 {
        let mut command = program("exact");
        command.args(["--env", "lava-grid", "--eta", "2", "--json"]);
        for set in sets {
            command.args(["--set", set]);
        }
        let answer: serde_json::Value =
            serde_json::from_slice(&succeed(&mut command).stdout).unwrap();
        let found = answer["optimal_cvar"].as_f64().or(answer["cvar"].as_f64());
        found.unwrap_or_else(|| panic!("{answer}"))
    };
    for (config, sets) in
        [(None, &[][..]), (Some("[env.lava-grid]\nslip = 0.2\n"), &["env.slip=0.2"])]
    {
        let dir = tempfile::tempdir().unwrap();
        own(dir.path(), "lava-grid/eta-2/seed-1", &episodes(10, 90), config);
        succeed(program("table").arg(dir.path()));
        let row = &csv(&dir.path().join("runs.csv"))[0];
        let number = |key: &str| -> f64 { row[key].parse().unwrap_or_else(|_| panic!("no {key}")) };
        let regret = optimum(sets) - (0.2 * -1.07 + 0.8 * 0.475);
        assert!((number("regret") - regret).abs() < 2e-6, "{} {regret}", number("regret"));
        // Of (w - J)^+ / alpha, which is 2 * 1.545 in a tenth of 100 episodes.
        let error = 2.0 * 1.545 * (0.1 * 0.9 / 100.0f64).sqrt();
        assert!((number("regret_se") - error).abs() < 1e-6, "{}", number("regret_se"));
    }
    // A certificate of lava-point comes with the program at eta = 2 of the default world, and at no other
    // budget near it.
    let dir = tempfile::tempdir().unwrap();
    own(dir.path(), "lava-point/eta-2/seed-1", &episodes(10, 90), None);
    own(dir.path(), "lava-point/eta-3/seed-1", &episodes(10, 90), None);
    let text = told(&succeed(program("table").arg(dir.path())));
    let rows = csv(&dir.path().join("table.csv"));
    assert!(!rows[0]["regret"].is_empty() && rows[1]["regret"].is_empty(), "{text}");
    for words in [
        "lava-point, eta = 3: some rows have no regret",
        "evaluation.oracle=computed",
        "exact --env lava-point --eta 3",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
}

/// The run's folder holds what `table`, `figures` and `report` can read, on any world.
#[test]
fn a_large_arena_leaves_files_that_can_be_read() {
    let dir = tempfile::tempdir().unwrap();
    let sets = ["env.lava-point.arena=[1000, 900]", "env.lava-point.horizon=30"];
    train(dir.path(), "lava-point", "5", 1, &sets);
    let folder = &runs(dir.path())[0];
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let size = entry.metadata().unwrap().len();
        assert!(size < 16 << 20, "{} has {size} bytes", entry.path().display());
    }
    for verb in ["table", "figures", "report"] {
        let text = told(&succeed(program(verb).arg(dir.path())));
        assert!(!text.contains("larger than") && !text.contains("LEFT OUT"), "{verb}: {text}");
    }
}

/// One damaged file costs one row or one figure, and is named.
#[test]
fn a_damaged_file_is_named_and_costs_its_own_row() {
    let dir = copy(&[1, 2]);
    let damaged = run(dir.path(), 2);
    let path = damaged.join("evaluation.json");
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    // An archive of which nothing is left, beside them.
    fs::write(dir.path().join("runs.zip"), "not an archive").unwrap();
    for verb in ["table", "figures", "report"] {
        let text = told(&succeed(program(verb).arg(dir.path())));
        for words in ["seed-2/evaluation.json is damaged", "runs.zip"] {
            assert!(text.contains(words), "{verb}, {words}: {text}");
        }
    }
    assert_eq!(&csv(&dir.path().join("table.csv"))[0]["seeds"], "1");
    // All that figures need, but no numbers.
    fs::write(&path, bytes).unwrap();
    for entry in fs::read_dir(&damaged).unwrap() {
        let path = entry.unwrap().path();
        if ["figure_data.json", "exhibits.json", "progress.csv"].iter().any(|of| path.ends_with(of))
        {
            fs::write(path, "{").unwrap();
        }
    }
    succeed(program("report").arg(dir.path()));
    assert_eq!(&csv(&dir.path().join("table.csv"))[0]["seeds"], "2");
    assert!(dir.path().join("figures/lava-grid-learning.svg").exists());
}

/// Where there is no terminal, in 100 columns.
#[test]
fn the_printed_table_is_narrow_and_its_words_are_few() {
    let dir = copy(&[1, 2]);
    let output = succeed(program("table").arg(dir.path()));
    let text = String::from_utf8(output.stdout).unwrap();
    let widest = text.lines().map(|line| line.chars().count()).max().unwrap();
    assert!(widest <= 100, "{widest} columns:\n{text}");
    // The legend is after the last table, before the first note.
    let legend = text.split("\n\n").find(|part| part.contains("table.md explains every column"));
    let legend = legend.unwrap_or_else(|| panic!("no legend in\n{text}"));
    assert!(legend.lines().count() <= 8, "{legend}");
    for column in ["steps/s", "CVaR_0.25", "difference"] {
        assert!(!legend.contains(column), "{column} is not in the tables:\n{text}");
    }
    let file = fs::read_to_string(dir.path().join("table.md")).unwrap();
    assert!(file.contains("**steps/s**") && file.contains("**CVaR_0.25**"), "{file}");
}

#[test]
fn the_page_says_how_its_runs_were_made() {
    let dir = copy(&[1]);
    let folder = run(dir.path(), 1);
    succeed(program("report").arg(dir.path()));
    let page = fs::read_to_string(dir.path().join("report.html")).unwrap();
    let manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.join("manifest.json")).unwrap()).unwrap();
    assert!(page.contains("<details>"), "nothing is folded");
    for words in ["follower_updates = 2", "[env.lava-grid]", "slip = 0.05", "Program and machine"] {
        assert!(page.contains(words), "{words}");
    }
    assert!(page.contains(manifest["version"].as_str().unwrap()));
    assert!(page.contains(manifest["cpu"].as_str().unwrap()));
    assert!(manifest["cores"].as_u64().unwrap() > 0);
}

/// Runs that differ in one constant of the world are drawn over it; others are not.
#[test]
fn what_one_constant_does_is_drawn() {
    let drawn = |seeds: &[u64]| {
        let folder = copy(seeds);
        succeed(program("figures").arg(folder.path()));
        let path = |name: &str| folder.path().join(format!("figures/lava-grid-slip-{name}.svg"));
        ["cvar", "regret", "gap"].map(|name| fs::read_to_string(path(name)).ok())
    };
    let [cvar, regret, gap] = drawn(&[1, 2, 3]);
    for (figure, words) in [(cvar, "CVaR_1/eta"), (regret, "regret"), (gap, "antagonist gap")] {
        let figure = figure.expect("the constant is drawn");
        for part in [words, ">\nslip", "eta = 25"] {
            assert!(figure.contains(part), "{words}: no {part:?}");
        }
    }
    assert_eq!(drawn(&[1, 2]), [None, None, None]);
}
