//! The runner: order, number at a time, failures, what is kept and what is refused; with a mock in
//! place of training, and with a shell script in place of a worker.

use cvar_game::experiment::archive::{self, PackedWeights};
use cvar_game::experiment::artefacts::{Evaluation, Manifest, SCHEMA};
use cvar_game::experiment::config::{Config, RunConfig, Setting, Source};
use cvar_game::experiment::lock::RunLock;
use cvar_game::experiment::plan;
use cvar_game::experiment::registry::standard;
use cvar_game::experiment::runner::{
    self, Event, Failure, Launcher, Outcome, Prepared, Report, RunnerError, Tick, Workers,
};
use cvar_game::experiment::stop::Stop;
use std::collections::BTreeMap;
use std::fs;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Barrier, Mutex, OnceLock};
use std::time::{Duration, Instant};

/// A sweep over one world at eta 1 with these seeds.
fn config(seeds: &[u64]) -> Config {
    config_with(seeds, &[])
}

fn config_with(seeds: &[u64], sets: &[&str]) -> Config {
    let seeds = format!("experiment.seeds={seeds:?}");
    let mut settings = vec!["experiment.envs=[\"lava-grid\"]", "experiment.etas=[1]", &seeds];
    settings.extend(sets);
    let settings: Vec<Setting> =
        settings.into_iter().map(|set| Setting::parse(set).unwrap()).collect();
    Config::resolve(standard().catalogue(), Source::Default, &settings).unwrap()
}

fn prepare(config: &Config, out: &Path) -> Result<Prepared<'static>, RunnerError> {
    runner::prepare(standard().catalogue(), config, &plan::runs(config), out)
}

fn run_folder(out: &Path, seed: u64) -> PathBuf {
    out.join(format!("lava-grid/game/eta-1/seed-{seed}"))
}

/// What `sweep` did, and what it told, as short texts.
fn sweep(
    config: &Config,
    out: &Path,
    jobs: usize,
    launcher: &dyn Launcher,
    stop: &Stop,
) -> (Outcome, Vec<String>) {
    let mut told = Vec::new();
    let mut watch = |event: &Event| {
        told.push(match event {
            Event::Started { run, .. } => format!("{} started", run.seed),
            Event::Ticked { run, tick } => format!("{} at {}", run.seed, tick.steps),
            Event::Evaluating { run, evaluated } => {
                format!("{} evaluated on {}", run.seed, evaluated.episodes)
            }
            Event::Noted { run, note } => format!("{} noted: {note}", run.seed),
            Event::Finished { run, .. } => format!("{} finished", run.seed),
            Event::Failed { run, reason, .. } => format!("{} failed: {reason}", run.seed),
            Event::Stopped { run } => format!("{} stopped", run.seed),
            Event::Quiet => return,
        });
    };
    let prepared = prepare(config, out).unwrap();
    let jobs = NonZeroUsize::new(jobs).unwrap();
    let outcome = runner::sweep(&prepared, jobs, launcher, stop, &mut watch);
    (outcome, told)
}

fn finish(run: &RunConfig, folder: &Path) {
    let evaluation = Evaluation {
        schema: SCHEMA,
        env: run.env.world.to_string(),
        eta: run.eta.get(),
        seed: run.seed,
        steps: run.train.steps,
        seconds: 1.0,
        plays: Vec::new(),
        audit: None,
        certificate: None,
    };
    let text = serde_json::to_string(&evaluation).unwrap();
    fs::write(folder.join("evaluation.json"), text).unwrap();
}

/// Trains in no time; `act` decides how the run of a seed ends.
struct Mock<F: Fn(u64, &Path, &Stop) -> Result<(), Failure> + Sync>(F);

impl<F: Fn(u64, &Path, &Stop) -> Result<(), Failure> + Sync> Launcher for Mock<F> {
    fn launch(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
    ) -> Result<(), Failure> {
        assert_eq!(
            RunConfig::load(&folder.join("config.toml"), standard().catalogue()).unwrap(),
            *run
        );
        report(Report::Tick(Tick { steps: 10, mean_return: f64::NAN }));
        (self.0)(run.seed, folder, stop)?;
        finish(run, folder);
        Ok(())
    }
}

fn succeed(_: u64, _: &Path, _: &Stop) -> Result<(), Failure> {
    Ok(())
}

fn never(seed: u64, _: &Path, _: &Stop) -> Result<(), Failure> {
    panic!("the run of seed {seed} was started");
}

/// All files below a folder with their contents.
fn files(folder: &Path) -> BTreeMap<PathBuf, String> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.insert(path.clone(), fs::read_to_string(&path).unwrap());
        }
    }
    found
}

#[test]
fn runs_are_carried_out_in_the_order_of_the_plan() {
    let out = tempfile::tempdir().unwrap();
    let (outcome, told) =
        sweep(&config(&[3, 1, 2]), out.path(), 1, &Mock(succeed), &Stop::default());
    assert_eq!(outcome, Outcome { finished: 3, ..Outcome::default() });
    assert_eq!(
        told,
        [
            "3 started",
            "3 at 10",
            "3 finished",
            "1 started",
            "1 at 10",
            "1 finished",
            "2 started",
            "2 at 10",
            "2 finished"
        ]
    );
}

#[test]
fn as_many_as_jobs_run_at_once() {
    let out = tempfile::tempdir().unwrap();
    let (running, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let pair = Barrier::new(2); // lets nobody pass alone
    let mock = Mock(|_, _: &Path, _: &Stop| {
        most.fetch_max(1 + running.fetch_add(1, Ordering::SeqCst), Ordering::SeqCst);
        pair.wait();
        running.fetch_sub(1, Ordering::SeqCst);
        Ok(())
    });
    let (outcome, _) = sweep(&config(&[1, 2, 3, 4]), out.path(), 2, &mock, &Stop::default());
    assert_eq!(outcome.finished, 4);
    assert_eq!(most.into_inner(), 2);
}

#[test]
fn a_failed_run_is_told_and_the_others_go_on() {
    let out = tempfile::tempdir().unwrap();
    let mock =
        Mock(
            |seed, _: &Path, _: &Stop| {
                if seed == 1 { Err(Failure::Failed("NaN in the loss".into())) } else { Ok(()) }
            },
        );
    let (outcome, told) = sweep(&config(&[1, 2]), out.path(), 1, &mock, &Stop::default());
    assert_eq!(outcome.finished, 1);
    assert_eq!(outcome.failed.len(), 1);
    assert_eq!(told[2], "1 failed: NaN in the loss");
    let manifest = fs::read(run_folder(out.path(), 1).join("manifest.json")).unwrap();
    let manifest: Manifest = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest.failure.as_deref(), Some("NaN in the loss"));
    assert_eq!((manifest.run.as_str(), manifest.steps), ("lava-grid/game/eta-1/seed-1", 10));
}

#[test]
fn a_run_without_an_evaluation_has_failed() {
    struct Nothing;
    impl Launcher for Nothing {
        fn launch(
            &self,
            _: &RunConfig,
            _: &Path,
            _: &Stop,
            _: &mut dyn FnMut(Report),
        ) -> Result<(), Failure> {
            Ok(())
        }
    }
    let out = tempfile::tempdir().unwrap();
    let (outcome, _) = sweep(&config(&[1]), out.path(), 1, &Nothing, &Stop::default());
    assert_eq!(outcome.failed[0].1, "it ended without an evaluation.json");
}

#[test]
fn a_run_with_an_evaluation_is_finished_however_its_process_ended() {
    let out = tempfile::tempdir().unwrap();
    let config = config(&[1]);
    let run = config.run(&plan::runs(&config)[0]);
    let mock = Mock(|_, folder: &Path, _: &Stop| {
        finish(&run, folder);
        Err(Failure::Failed("killed in its last moment".into()))
    });
    let (outcome, _) = sweep(&config, out.path(), 1, &mock, &Stop::default());
    assert_eq!((outcome.finished, outcome.failed.len()), (1, 0));
    assert!(!run_folder(out.path(), 1).join("manifest.json").exists());
}

#[test]
fn finished_runs_are_kept_and_unfinished_ones_are_launched_again() {
    let out = tempfile::tempdir().unwrap();
    let half = Mock(|seed, folder: &Path, _: &Stop| {
        fs::write(folder.join("progress.csv"), "old").unwrap();
        if seed == 2 { Err(Failure::Failed("power cut".into())) } else { Ok(()) }
    });
    sweep(&config(&[1, 2]), out.path(), 1, &half, &Stop::default());
    let before = files(&run_folder(out.path(), 1));
    let again = Mock(|seed, folder: &Path, _: &Stop| {
        assert_eq!(seed, 2);
        // What there is to go on from is the launcher's business.
        assert_eq!(fs::read_to_string(folder.join("progress.csv")).unwrap(), "old");
        Ok(())
    });
    let prepared = prepare(&config(&[1, 2]), out.path()).unwrap();
    assert_eq!((prepared.todo.len(), prepared.finished.len()), (1, 1));
    drop(prepared);
    let (outcome, _) = sweep(&config(&[1, 2]), out.path(), 1, &again, &Stop::default());
    assert_eq!(outcome.finished, 1);
    assert_eq!(files(&run_folder(out.path(), 1)), before);
    sweep(&config(&[1, 2]), out.path(), 1, &Mock(never), &Stop::default());
}

/// Also under the name that runs have without their method.
#[test]
fn a_packed_run_is_finished_and_not_carried_out_again() {
    let out = tempfile::tempdir().unwrap();
    let config = config(&[1, 2]);
    sweep(&config, out.path(), 1, &Mock(succeed), &Stop::default());
    assert_eq!(archive::pack(out.path(), PackedWeights::None).unwrap().packed, 2);
    assert!(!out.path().join("lava-grid").exists());
    let evaluation = runner::read_evaluation(&run_folder(out.path(), 2)).unwrap().unwrap();
    assert_eq!(evaluation.seed, 2);

    let prepared = prepare(&config, out.path()).unwrap();
    assert_eq!((prepared.todo.len(), prepared.finished.len()), (0, 2));
    let other = config_with(&[1, 2], &["env.slip=0.1"]);
    let error = prepare(&other, out.path()).unwrap_err().to_string();
    assert!(error.contains("another configuration (env.lava-grid.slip is 0.05 there"), "{error}");
    let more = config_with(&[1, 2, 3], &[]);
    let (outcome, told) = sweep(&more, out.path(), 1, &Mock(succeed), &Stop::default());
    assert_eq!(outcome.finished, 1);
    assert_eq!(told.first().map(String::as_str), Some("3 started"));
    fs::write(out.path().join("runs.zip"), "damaged").unwrap();
    assert!(prepare(&config, out.path()).unwrap_err().to_string().contains("cannot be read"));
}

#[test]
fn weights_of_the_first_seed_are_packed_unless_others_are_asked_for() {
    let packed = |whose: PackedWeights| {
        let out = tempfile::tempdir().unwrap();
        sweep(&config(&[3, 1, 2]), out.path(), 1, &Mock(succeed), &Stop::default());
        for seed in 1..=3_u8 {
            fs::write(run_folder(out.path(), seed.into()).join("final.safetensors"), [seed])
                .unwrap();
        }
        archive::pack(out.path(), whose).unwrap();
        let runs = archive::Store::open(out.path()).unwrap().list().unwrap().runs;
        assert_eq!(runs.len(), 3);
        let read = |run: archive::RunFiles| run.read("final.safetensors").unwrap();
        runs.into_iter().filter_map(read).flatten().collect::<Vec<u8>>()
    };
    assert_eq!(packed(PackedWeights::First), [1]);
    assert_eq!(packed(PackedWeights::All), [1, 2, 3]);
    assert!(packed(PackedWeights::None).is_empty());
}

#[test]
fn a_stopped_sweep_starts_nothing_more_and_keeps_what_is_finished() {
    let out = tempfile::tempdir().unwrap();
    let mock = Mock(|seed, _: &Path, stop: &Stop| {
        if seed == 2 {
            stop.request(15);
            return Err(Failure::Unfinished);
        }
        assert_eq!(seed, 1);
        Ok(())
    });
    let (outcome, told) = sweep(&config(&[1, 2, 3]), out.path(), 1, &mock, &Stop::default());
    assert_eq!(outcome, Outcome { finished: 1, failed: Vec::new(), stopped: Some(15) });
    assert_eq!(told.last().unwrap(), "2 stopped");
    assert!(run_folder(out.path(), 1).join("evaluation.json").exists());
    assert!(!run_folder(out.path(), 3).exists());
}

/// Makes a finished sweep of seed 1, spoils it, and expects the next one to be refused untouched.
fn refusal(spoil: impl Fn(&Path), next: &Config) -> String {
    let out = tempfile::tempdir().unwrap();
    sweep(&config(&[1]), out.path(), 1, &Mock(succeed), &Stop::default());
    spoil(&run_folder(out.path(), 1));
    let before = files(out.path());
    let message = prepare(next, out.path()).unwrap_err().to_string();
    assert_eq!(files(out.path()), before, "something was overwritten");
    assert!(!message.contains('\n'), "{message}");
    assert!(message.contains("seed-1"), "{message}");
    message
}

#[test]
fn a_folder_of_another_configuration_is_refused() {
    let next = config_with(&[2, 1], &["train.steps=20_000"]);
    let message = refusal(|_| {}, &next);
    assert!(
        message.contains(
            "holds a run with another configuration (train.steps is 5000000 there and 20000 here); \
             choose another folder with --out or remove that one"
        ),
        "{message}"
    );
}

#[test]
fn folders_of_other_schema_versions_are_refused() {
    let replace = |name: &'static str, from: &'static str, to: &'static str| {
        move |folder: &Path| {
            let text = fs::read_to_string(folder.join(name)).unwrap();
            assert!(text.contains(from), "{text}");
            fs::write(folder.join(name), text.replace(from, to)).unwrap();
        }
    };
    let message = refusal(replace("config.toml", "schema = 1", "schema = 7"), &config(&[1]));
    assert!(message.contains("has schema version 7, this program writes"), "{message}");
    assert!(message.contains("another output folder"), "{message}");
    let message =
        refusal(replace("evaluation.json", "\"schema\":1", "\"schema\":7"), &config(&[1]));
    assert!(message.contains("evaluation.json of schema version 7"), "{message}");
}

#[test]
fn folders_with_something_else_are_refused() {
    let remove = |folder: &Path| fs::remove_file(folder.join("config.toml")).unwrap();
    assert!(refusal(remove, &config(&[1])).contains("holds files but no config.toml"));
    let nonsense = |folder: &Path| fs::write(folder.join("config.toml"), "schema = 1\nx").unwrap();
    assert!(refusal(nonsense, &config(&[1])).contains("does not fit this program"));
}

#[test]
fn a_damaged_evaluation_is_told_and_the_run_done_again() {
    let out = tempfile::tempdir().unwrap();
    let config = config(&[1, 2]);
    sweep(&config, out.path(), 1, &Mock(succeed), &Stop::default());
    let path = run_folder(out.path(), 1).join("evaluation.json");
    fs::write(&path, "{\"sche").unwrap();
    let (outcome, told) = sweep(&config, out.path(), 1, &Mock(succeed), &Stop::default());
    assert_eq!(outcome, Outcome { finished: 1, ..Outcome::default() });
    let note = format!("1 noted: {} is damaged", path.display());
    assert!(told[1].starts_with(&note), "{told:?}");
    assert_eq!((&told[0][..], &told[3][..]), ("1 started", "1 finished"));
}

#[test]
fn an_output_folder_that_cannot_be_written_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    let message = prepare(&config(&[1]), &file.join("out")).unwrap_err().to_string();
    assert!(message.starts_with("cannot write to "), "{message}");
    assert!(message.contains("choose another folder with --out"), "{message}");
}

#[test]
fn a_run_that_another_process_works_on_is_left_alone_until_it_is_free() {
    let out = tempfile::tempdir().unwrap();
    let busy = run_folder(out.path(), 1);
    fs::create_dir_all(&busy).unwrap();
    let lock = Mutex::new(RunLock::take(&busy).unwrap());
    let launched = Mutex::new(Vec::new());
    let mock = Mock(|seed, _: &Path, _: &Stop| {
        launched.lock().unwrap().push(seed);
        if seed == 3 {
            lock.lock().unwrap().take(); // the other process dies
        }
        Ok(())
    });
    let (outcome, told) = sweep(&config(&[1, 2, 3]), out.path(), 1, &mock, &Stop::default());
    assert_eq!(outcome.finished, 3);
    assert_eq!(launched.into_inner().unwrap(), [2, 3, 1]);
    assert_eq!(told.iter().filter(|event| event.ends_with("started")).count(), 3, "{told:?}");
}

#[test]
fn a_run_that_another_process_finishes_meanwhile_is_not_done_again() {
    let out = tempfile::tempdir().unwrap();
    let config = config(&[1, 2]);
    let other = config.run(&plan::runs(&config)[1]);
    let mock = Mock(|seed, _: &Path, _: &Stop| {
        assert_eq!(seed, 1);
        let folder = run_folder(out.path(), 2);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("config.toml"), other.to_toml()).unwrap();
        finish(&other, &folder);
        Ok(())
    });
    let (outcome, told) = sweep(&config, out.path(), 1, &mock, &Stop::default());
    assert_eq!(outcome.finished, 2);
    assert!(!told.contains(&"2 started".to_owned()), "{told:?}");
}

#[test]
fn two_sweeps_at_once_do_every_run_once() {
    let out = tempfile::tempdir().unwrap();
    let launched = Mutex::new(Vec::new());
    // As a worker does.
    let mock = Mock(|seed, folder: &Path, _: &Stop| {
        let Some(_lock) = RunLock::take(folder).unwrap() else { return Err(Failure::Unfinished) };
        if folder.join("evaluation.json").exists() {
            return Ok(());
        }
        launched.lock().unwrap().push(seed);
        std::thread::sleep(Duration::from_millis(20));
        fs::write(folder.join("done"), "").unwrap();
        let run = RunConfig::load(&folder.join("config.toml"), standard().catalogue()).unwrap();
        finish(&run, folder);
        Ok(())
    });
    let config = config(&[1, 2, 3, 4, 5, 6]);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                let (outcome, _) = sweep(&config, out.path(), 2, &mock, &Stop::default());
                assert_eq!(outcome.failed, []);
            });
        }
    });
    let mut launched = launched.into_inner().unwrap();
    launched.sort();
    assert_eq!(launched, [1, 2, 3, 4, 5, 6]);
}

#[test]
fn what_a_killed_process_leaves_at_its_start_does_not_block_the_run() {
    let out = tempfile::tempdir().unwrap();
    let folder = run_folder(out.path(), 1);
    fs::create_dir_all(&folder).unwrap();
    for name in [".lock", ".part-Xy12"] {
        fs::write(folder.join(name), "").unwrap();
    }
    let (outcome, _) = sweep(&config(&[1]), out.path(), 1, &Mock(succeed), &Stop::default());
    assert_eq!(outcome.finished, 1);
}

/// A worker that does what its run's seed says.
fn script() -> Workers {
    const TEXT: &str = r#"#!/bin/sh
folder=$3
case $(grep -m 1 '^seed' "$folder/config.toml") in
"seed = 1")
    echo '{"steps":20,"mean_return":null}'
    echo 'chatter of a library'
    echo '{"note":"goes on after update 7"}'
    echo '{"schema":1,"env":"lava-grid","eta":1.0,"seed":1,"steps":20,"seconds":1.0,"plays":[]}' \
        > "$folder/evaluation.json" ;;
"seed = 2") echo '{"failure":"NaN in update 7"}'; exit 1 ;;
"seed = 3")
    printf 'thread main panicked at src/x.rs:1:1:\nindex out of bounds\nnote: backtrace\n' >&2
    exit 101 ;;
"seed = 4") kill -9 $$ ;;
"seed = 5") echo $$ > "$folder/pid"; cat; exit 75 ;;
"seed = 6") echo $$ > "$folder/pid"; exec sleep 600 ;;
"seed = 7") if ! [ -e "$folder/pid" ]; then echo $$ > "$folder/pid"; exit 75; fi
    echo '{"schema":1,"env":"lava-grid","eta":1.0,"seed":7,"steps":20,"seconds":1.0,"plays":[]}' \
        > "$folder/evaluation.json" ;;
esac
"#;
    static SCRIPT: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = SCRIPT.get_or_init(|| {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("worker.sh");
        fs::write(&path, TEXT).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        folder
    });
    Workers::of(folder.path().join("worker.sh"))
}

#[test]
fn what_workers_report_and_how_they_die_is_told() {
    let out = tempfile::tempdir().unwrap();
    let (outcome, told) = sweep(&config(&[1, 2, 3, 4]), out.path(), 1, &script(), &Stop::default());
    assert_eq!(outcome.finished, 1, "{outcome:?}");
    let note = "1 noted: goes on after update 7";
    assert_eq!(told[..4], ["1 started", "1 at 20", note, "1 finished"]);
    let reasons: Vec<&str> = outcome.failed.iter().map(|(_, reason)| reason.as_str()).collect();
    assert_eq!(reasons[0], "NaN in update 7");
    assert!(reasons[1].contains("exit status: 101) and said: index out of bounds; see "));
    assert!(reasons[2].contains("killed by signal 9, as the system does when memory runs out"));
    assert!(!run_folder(out.path(), 1).join("worker.log").exists(), "an empty log is removed");
    assert!(run_folder(out.path(), 3).join("worker.log").exists());
}

/// Stops a sweep of one run as soon as its worker has started.
fn stop_a_worker(seed: u64, workers: &Workers) -> Vec<String> {
    let out = tempfile::tempdir().unwrap();
    let stop = Stop::default();
    let pid = run_folder(out.path(), seed).join("pid");
    let start = Instant::now();
    let (outcome, told) = std::thread::scope(|scope| {
        let sweeping = scope.spawn(|| sweep(&config(&[seed, 1]), out.path(), 1, workers, &stop));
        while fs::read_to_string(&pid).unwrap_or_default().is_empty() {
            std::thread::sleep(Duration::from_millis(5));
            assert!(start.elapsed() < Duration::from_secs(60), "the worker did not start");
        }
        stop.request(15);
        sweeping.join().unwrap()
    });
    assert_eq!((outcome.stopped, outcome.finished), (Some(15), 0));
    let pid = fs::read_to_string(pid).unwrap();
    assert!(!Path::new("/proc").join(pid.trim()).exists(), "the worker is still there");
    told
}

#[test]
fn a_stopped_worker_is_asked_to_end_and_reaped() {
    assert_eq!(stop_a_worker(5, &script()), ["5 started", "5 stopped"]);
}

#[test]
fn a_worker_that_does_not_stop_is_killed() {
    let workers = script().with_patience(Duration::from_millis(100));
    assert_eq!(stop_a_worker(6, &workers), ["6 started", "6 stopped"]);
}

#[test]
fn a_worker_that_was_stopped_from_elsewhere_is_started_again() {
    let out = tempfile::tempdir().unwrap();
    let (outcome, told) = sweep(&config(&[7]), out.path(), 1, &script(), &Stop::default());
    assert_eq!(outcome.finished, 1, "{told:?}");
    assert_eq!(told, ["7 started", "7 started", "7 finished"]);
}
