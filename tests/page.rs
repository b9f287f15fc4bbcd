//! Figures and page, from artefacts made up here; the page in a browser.

use cvar_game::experiment::artefacts::{Chance, Evaluation, Play, SCHEMA};
use cvar_game::experiment::config::Config;
use cvar_game::experiment::config::Source;
use cvar_game::experiment::figure_data::{
    BudgetByTime, CellData, Deviations, FigureData, PlaneData, ShiftMap, StoredEpisode, WorldData,
};
use cvar_game::experiment::plan;
use cvar_game::experiment::registry::standard;
use cvar_game::game::returns::{Atom, ReturnLaw};
use cvar_game::learn::policy::Mode;
use cvar_game::report;
use lava_envs::End;
use std::fs;
use std::path::Path;
use std::process::Command;

/// Both worlds at eta 1 and 25, two seeds each, with everything a run leaves behind that is read here.
fn results(dir: &Path) {
    let settings = ["experiment.etas=[1,25]", "experiment.seeds=[1,2]"]
        .map(|text| cvar_game::experiment::config::Setting::parse(text).unwrap());
    let config = Config::resolve(standard().catalogue(), Source::Default, &settings).unwrap();
    for id in plan::runs(&config) {
        let folder = id.folder(dir);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("config.toml"), config.run(&id).to_toml()).unwrap();
        let progress = "steps,player,mean_return,regret\n10000,protagonist,-1.5,1.5\n20000,antagonist,0.25,0.25\n";
        fs::write(folder.join("progress.csv"), progress).unwrap();
        let law = || {
            ReturnLaw::recorded((0..1000).map(|episode| Atom {
                value: f64::from(episode % 100) / 100.0,
                undiscounted: 0.0,
                steps: 9,
                end: if episode == 0 { End::Lava } else { End::Goal },
                mass: 1.0,
            }))
        };
        let play =
            |protagonist, chance| Play { protagonist, chance, law: law(), mean_clearance: None };
        let evaluation = Evaluation {
            schema: SCHEMA,
            env: id.world.to_string(),
            eta: id.eta.get(),
            seed: id.seed,
            steps: 20_000,
            seconds: 1.0,
            plays: vec![play(Mode::Greedy, Chance::Nominal), play(Mode::Sampled, Chance::Nominal)],
            audit: None,
            certificate: None,
        };
        let text = serde_json::to_string(&evaluation).unwrap();
        fs::write(folder.join("evaluation.json"), text).unwrap();
        let text =
            serde_json::to_string(&figure_data(id.world.as_str(), id.eta.is_neutral())).unwrap();
        fs::write(folder.join("figure_data.json"), text).unwrap();
    }
}

fn figure_data(env: &str, neutral: bool) -> FigureData {
    let counts =
        |share: f64| Deviations { visits: vec![1000.0; 70], deviations: vec![1000.0 * share; 70] };
    let shifts = ShiftMap {
        visits: vec![1000; 280],
        shift: vec![[0.5, -0.5]; 280],
        divergence: vec![0.1; 280],
    };
    let world = if env == "lava-grid" {
        WorldData::Cells(CellData {
            occupancy: vec![0.5; 70],
            learned: (!neutral).then(|| counts(0.375)),
            exact: (!neutral).then(|| counts(0.625)),
            exact_budget: if neutral { Vec::new() } else { vec![1.0, 0.5] },
        })
    } else {
        WorldData::Plane(PlaneData {
            trajectories: vec![vec![[0.5, 0.5], [1.5, 3.0]]],
            bin: 0.5,
            bins: if neutral { [0, 0] } else { [20, 14] },
            shifts: if neutral { Vec::new() } else { vec![shifts; 3] },
        })
    };
    let stored = |chance| StoredEpisode {
        chance,
        index: 0,
        end: End::Lava,
        value: -1.035,
        path: vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]],
        actions: vec![[0.0, 1.0]; 2],
        outcomes: vec![[1.0, 0.0]; 2],
        ratios: vec![2.0, 4.0],
        budgets: vec![25.0, 12.5, 3.125],
    };
    let kinds =
        if neutral { vec![Chance::Nominal] } else { vec![Chance::Nominal, Chance::Antagonist] };
    FigureData {
        schema: SCHEMA,
        run: None,
        episodes: 1000,
        world,
        budget: (!neutral).then(|| BudgetByTime {
            every: 1,
            running: vec![1000, 900],
            mean: vec![1.0, 0.4],
            low: vec![1.0, 0.1],
            high: vec![1.0, 0.8],
        }),
        stored: kinds.into_iter().map(stored).collect(),
    }
}

#[test]
fn every_figure_is_drawn_as_svg_with_text_and_as_png() {
    let dir = tempfile::tempdir().unwrap();
    results(dir.path());
    let written = report::write_all(dir.path(), standard()).unwrap();
    assert_eq!(written.figures.missing, Vec::<String>::new());
    let names: Vec<&str> =
        written.figures.drawn.iter().map(|figure| figure.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "lava-grid-overview",
            "lava-grid-map",
            "lava-grid-occupancy",
            "lava-grid-deviations",
            "lava-grid-frontier",
            "lava-grid-regret",
            "lava-grid-profile",
            "lava-grid-cross",
            "lava-grid-learning",
            "lava-grid-budget",
            "lava-point-overview",
            "lava-point-trajectories",
            "lava-point-shifts",
            "lava-point-race",
            "lava-point-frontier",
            "lava-point-regret",
            "lava-point-profile",
            "lava-point-cross",
            "lava-point-learning",
            "lava-point-budget",
        ]
    );
    for figure in &written.figures.drawn {
        let stem = dir.path().join("figures").join(&figure.name);
        assert_eq!(fs::read_to_string(stem.with_extension("svg")).unwrap(), figure.picture.svg);
        assert!(figure.picture.svg.contains("<text"), "{} has no text", figure.name);
        let png = fs::read(stem.with_extension("png")).unwrap();
        assert!(png.starts_with(b"\x89PNG"), "{} is no PNG", figure.name);
    }
    let figure = |name| written.figures.drawn.iter().find(|figure| figure.name == name).unwrap();
    // The shares of both antagonists, which no axis can show by chance.
    let deviations = &figure("lava-grid-deviations").picture.svg;
    assert!(deviations.contains(".38") && deviations.contains(".62"), "{deviations}");
    let caption = &figure("lava-grid-deviations").caption;
    assert!(caption.contains("1000 trajectories"));
    assert!(caption.contains("eta = 25: (0, 0) 0.38 and 0.62, (1, 0) 0.38 and 0.62"), "{caption}");
    // Two dots that move, one for each budget.
    let race = &figure("lava-point-race").picture.svg;
    assert_eq!(race.matches("attributeName=\"cx\"").count(), 2, "{race}");
}

/// The committed figures are those of the committed archive.
#[test]
fn committed_results_make_their_figures_again() {
    let results = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/paper");
    let dir = tempfile::tempdir().unwrap();
    fs::copy(results.join("runs.zip"), dir.path().join("runs.zip")).unwrap();
    let figures = report::write_figures(dir.path(), standard()).unwrap();
    assert_eq!(figures.drawn.len(), fs::read_dir(results.join("figures")).unwrap().count() / 2);
    for figure in &figures.drawn {
        let file = format!("figures/{}.svg", figure.name);
        let committed = fs::read_to_string(results.join(&file)).unwrap();
        assert!(figure.picture.svg == committed, "results/paper/{file} differs");
    }
}

/// A variant and a method with constants of its own: all are in the curves, and in the maps those that have
/// the same world.
#[test]
fn figures_name_methods_and_variants() {
    let dir = tempfile::tempdir().unwrap();
    results(dir.path());
    for (from, to) in
        [("lava-grid/game", "lava-grid/game/k-1"), ("lava-point/game", "lava-point/mine")]
    {
        for seed in ["eta-25/seed-1", "eta-25/seed-2"] {
            let (from, to) = (dir.path().join(from).join(seed), dir.path().join(to).join(seed));
            fs::create_dir_all(&to).unwrap();
            for entry in fs::read_dir(from).unwrap() {
                let entry = entry.unwrap();
                fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
            }
        }
    }
    for seed in [1, 2] {
        let other = dir.path().join(format!("lava-point/mine/eta-25/seed-{seed}/config.toml"));
        let text = fs::read_to_string(&other).unwrap().replace("noise = 1.5", "noise = 0.5");
        assert!(text.contains("noise = 0.5"), "{text}");
        fs::write(&other, text).unwrap();
    }
    let written = report::write_all(dir.path(), standard()).unwrap();
    let svg = |name: &str| {
        let drawn = written.figures.drawn.iter().find(|figure| figure.name == name);
        &drawn.unwrap_or_else(|| panic!("{name} is missing")).picture.svg
    };
    for name in ["frontier", "cross", "learning", "occupancy", "deviations"] {
        assert!(svg(&format!("lava-grid-{name}")).contains("game/k-1"), "{name}");
    }
    assert!(svg("lava-grid-improvement").contains("game  &gt;  game/k-1, eta = 25"));
    let improvement =
        written.figures.drawn.iter().any(|figure| figure.name == "lava-point-improvement");
    assert!(!improvement, "it compares what was not in the same world");
    let learning = svg("lava-point-learning");
    assert!(learning.contains("mine\n") && learning.contains("eta = 25\n"));
    assert!(!svg("lava-point-shifts").contains("mine"), "it has another world");
    let missing = "lava-point: maps of mine, eta = 25, whose constants are not those of the others";
    assert_eq!(written.figures.missing, [missing]);
    let page = fs::read_to_string(dir.path().join("report.html")).unwrap();
    assert!(page.contains("game/k-1, eta = 25 (2 seeds)"));
}

#[test]
fn the_same_artefacts_give_the_same_page() {
    let dir = tempfile::tempdir().unwrap();
    results(dir.path());
    let page = || {
        report::write_all(dir.path(), standard()).unwrap();
        fs::read_to_string(dir.path().join("report.html")).unwrap()
    };
    let text = page();
    assert_eq!(text, page());
    // Nothing is fetched: the only address is the name of SVG's language.
    assert_eq!(text.matches("http").count(), text.matches("http://www.w3.org/2000/svg").count());
    assert!(!text.contains("src=") && !text.contains("@import"));
}

/// Those of former versions and of other programs.
#[test]
fn runs_without_figure_data_report_all_the_same() {
    let dir = tempfile::tempdir().unwrap();
    results(dir.path());
    for entry in ["lava-grid", "lava-point"] {
        for (eta, seed) in [(1, 1), (1, 2), (25, 1), (25, 2)] {
            let folder = dir.path().join(format!("{entry}/game/eta-{eta}/seed-{seed}"));
            fs::remove_file(folder.join("figure_data.json")).unwrap();
            if entry == "lava-point" {
                fs::remove_file(folder.join("config.toml")).unwrap();
                fs::remove_file(folder.join("progress.csv")).unwrap();
            }
        }
    }
    let written = report::write_all(dir.path(), standard()).unwrap();
    let drawn: Vec<&str> =
        written.figures.drawn.iter().map(|figure| figure.name.as_str()).collect();
    assert_eq!(
        drawn,
        [
            "lava-grid-overview",
            "lava-grid-map",
            "lava-grid-frontier",
            "lava-grid-regret",
            "lava-grid-profile",
            "lava-grid-cross",
            "lava-grid-learning",
            "lava-point-overview",
            "lava-point-frontier",
            "lava-point-profile",
            "lava-point-cross",
        ]
    );
    assert!(
        written
            .figures
            .missing
            .contains(&"lava-grid: where the antagonist changes moves".to_owned())
    );
    let page = fs::read_to_string(dir.path().join("report.html")).unwrap();
    assert!(page.contains("No episodes were stored.") && page.contains("Left out"), "{page}");
}

/// They are missing in the figures, and the page says so.
#[test]
fn damaged_figure_data_is_named_and_left_out() {
    for (spoil, said) in
        [("divergence", "maps are of unequal size"), ("ratios", "episode lacks a part")]
    {
        let dir = tempfile::tempdir().unwrap();
        results(dir.path());
        let path = dir.path().join("lava-point/game/eta-25/seed-2/figure_data.json");
        let mut value: serde_json::Value =
            serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        let list = match spoil {
            "divergence" => &mut value["world"]["plane"]["shifts"][1][spoil],
            _ => &mut value["stored"][0][spoil],
        };
        list.as_array_mut().unwrap().pop();
        fs::write(&path, value.to_string()).unwrap();
        let written = report::write_all(dir.path(), standard()).unwrap();
        let [note] = &written.figures.notes[..] else { panic!("{:?}", written.figures.notes) };
        assert!(note.contains("seed-2/figure_data.json") && note.contains(said), "{note}");
        assert_eq!(written.figures.drawn.len(), 20);
        let page = fs::read_to_string(dir.path().join("report.html")).unwrap();
        assert!(page.contains("Missing in the figures: ") && page.contains(said));
    }
}

/// In headless Chromium, at a desk's and a phone's width: no error, tables sort, the player advances
/// and is worked by keyboard.
#[test]
#[ignore = "needs chromium"]
fn the_page_works_in_a_browser() {
    let dir = tempfile::tempdir().unwrap();
    results(dir.path());
    report::write_all(dir.path(), standard()).unwrap();
    let page = fs::read_to_string(dir.path().join("report.html")).unwrap();
    let first = "<script>window.errors = []; window.onerror = (text) => errors.push(text); \
                 console.error = (...all) => errors.push(all.join(' '));</script>";
    let last = r#"<script>
        const of = (id) => document.getElementById(id);
        const rows = () => [...document.querySelector("tbody").rows].map((row) => row.cells[0].textContent).join();
        const result = { before: rows() };
        const pick = (id, value) => { of(id).value = value; of(id).dispatchEvent(new Event("change")); };
        pick("only-world", "lava-grid");
        result.worlds = [...document.querySelectorAll("[data-world]")]
          .filter((part) => part.offsetParent !== null).map((part) => part.dataset.world);
        result.env = of("env").value;
        pick("only-world", "");
        const best = [...of("beside").options].find((option) => option.text === "the best known, eta = 1");
        pick("beside", best.value);
        result.beside = of("beside-step").textContent;
        pick("beside", "");
        result.alone = of("beside-stage").hidden;
        document.querySelector("th button").click();
        document.querySelector("th button").click();
        result.sorted = rows();
        pick("env", "lava-point");
        pick("eta", "25");
        pick("chance", "antagonist");
        result.start = of("step").textContent;
        of("play").click();
        setTimeout(() => {
          result.end = of("step").textContent;
          of("scrub").value = 1;
          of("scrub").dispatchEvent(new Event("input"));
          result.scrubbed = of("step").textContent;
          result.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
          result.errors = errors;
          document.title = JSON.stringify(result);
        }, 1500);
        </script></body>"#;
    let path = dir.path().join("driven.html");
    let driven = page.replacen("<head>", &format!("<head>{first}"), 1);
    fs::write(&path, driven.replacen("</body>", last, 1)).unwrap();
    for width in [1280, 390] {
        let output = Command::new("chromium")
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"])
            .arg(format!("--window-size={width},900"))
            .arg("--virtual-time-budget=5000")
            .arg(format!("--user-data-dir={}", dir.path().join("profile").display()))
            .arg(format!("file://{}", path.display()))
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        let title = text.split("<title>").nth(1).and_then(|rest| rest.split("</title>").next());
        let result: serde_json::Value = serde_json::from_str(title.unwrap()).unwrap();
        assert_eq!(result["errors"], serde_json::json!([]), "{result}");
        assert_eq!(
            (result["before"].as_str(), result["sorted"].as_str()),
            (Some("1,1,25,25,25"), Some("25,25,25,1,1"))
        );
        let said = |key: &str, what: &str| {
            assert!(result[key].as_str().unwrap().contains(what), "{key}: {result}");
        };
        said("start", "step 0 of 2 · remaining budget 25");
        said("end", "product so far 8.00 · ended: lava, return -1.035");
        said(
            "scrubbed",
            "step 1 of 2 · remaining budget 12.5 · likelihood ratio of the last outcome 2.00",
        );
        let worlds = result["worlds"].as_array().unwrap();
        assert!(worlds.len() > 5 && worlds.iter().all(|world| world == "lava-grid"), "{result}");
        assert_eq!((&result["env"], &result["alone"]), (&"lava-grid".into(), &true.into()));
        said("beside", "the best known, eta = 1 · step 0 of");
        assert_eq!(result["wide"], 0, "the page is wider than {width} pixels");
    }
}
