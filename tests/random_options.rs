//! Random values of all options, within their documented ranges, given to all verbs: nothing panics, keeps silent
//! for more than a minute, or takes more memory than the documents allow. Takes ten minutes, or as many as
//! CVAR_GAME_MINUTES says:
//!
//! ```text
//! cargo test --release --test random_options -- --ignored --nocapture
//! ```

#[path = "support/program.rs"]
#[expect(dead_code, reason = "other tests expect success")]
mod support;

use cvar_game::experiment::config::OptionInfo;
use cvar_game::experiment::registry::standard;
use lava_envs::random::ChaCha8Rng;
use rand::{Rng, RngExt as _, SeedableRng as _};
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use support::program;
use toml::Value;

/// Longest silence.
const SILENCE: Duration = Duration::from_secs(63);

/// Most memory of the program and its workers together, in KiB.
const MEMORY: u64 = 4 << 20;

/// Bounds that an option's words state: `a whole number from 1 to 10`, `a finite number above 0 and at most 1`.
fn bounds(allowed: &str) -> [Option<f64>; 2] {
    let after = |word: &str| {
        let (_, rest) = allowed.split_once(word)?;
        rest.split_whitespace().next()?.parse().ok()
    };
    let least = after(" from ").or_else(|| after("at least ")).or_else(|| after("above "));
    let most = after(" to ").or_else(|| after("at most ")).or_else(|| after("below "));
    [least, most]
}

/// A number in the bounds: an end, or uniform, or uniform in its logarithm.
fn number([least, most]: [Option<f64>; 2], default: f64, random: &mut impl Rng) -> f64 {
    let least = least.unwrap_or(if most.is_some_and(|most| most < 0.0) { -1e12 } else { 0.0 });
    let most = most.unwrap_or(1e12);
    match random.random_range(0..8) {
        0 => least,
        1 => most,
        2 => random.random_range(least..=most),
        3..=5 => (default * 10_f64.powf(random.random_range(-1.0..1.0))).clamp(least, most),
        _ => {
            let low = least.max(1e-6).ln();
            let high = most.max(1e-6).ln().max(low);
            random.random_range(low..=high).exp().clamp(least, most)
        }
    }
}

/// A random value of an option, as TOML.
fn value(option: &OptionInfo, random: &mut impl Rng) -> Option<String> {
    let quoted: Vec<&str> = option.allowed.split('"').skip(1).step_by(2).collect();
    let element = |default: &Value, random: &mut _| match default {
        Value::Boolean(_) => Some(random_bool(random).to_string()),
        Value::String(_) if !quoted.is_empty() => {
            Some(format!("\"{}\"", quoted[index(quoted.len(), random)]))
        }
        Value::Integer(default) => {
            let number = number(bounds(&option.allowed), *default as f64, random);
            Some((number as i64).to_string())
        }
        Value::Float(default) => {
            // An exponent alone is no TOML float on the command line: `1e300` is.
            Some(format!("{:e}", number(bounds(&option.allowed), *default, random)))
        }
        _ => None,
    };
    match &option.default {
        Value::Array(list) => {
            let list: Option<Vec<String>> =
                list.iter().map(|default| element(default, random)).collect();
            Some(format!("[{}]", list?.join(", ")))
        }
        default => element(default, random),
    }
}

fn random_bool(random: &mut impl Rng) -> bool {
    random.random()
}

fn index(count: usize, random: &mut impl Rng) -> usize {
    random.random_range(0..count)
}

/// Resident memory of a process and its children, in KiB.
fn memory(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let own = status.lines().find_map(|line| {
        line.strip_prefix("VmRSS:")?.split_whitespace().next()?.parse::<u64>().ok()
    });
    let children =
        fs::read_to_string(format!("/proc/{process}/task/{process}/children")).unwrap_or_default();
    let children = children.split_whitespace().filter_map(|child| child.parse().ok());
    own.unwrap_or(0) + children.map(memory).sum::<u64>()
}

/// Reads what a process says to the end; the time of the last word is kept in milliseconds since `start`.
fn listen(
    mut from: impl Read + Send + 'static,
    start: Instant,
    last: &Arc<AtomicU64>,
) -> std::thread::JoinHandle<String> {
    let last = Arc::clone(last);
    std::thread::spawn(move || {
        let (mut said, mut buffer) = (Vec::new(), [0; 1 << 16]);
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            last.store(start.elapsed().as_millis() as u64, Ordering::Relaxed);
            // Rows may be endless.
            if said.len() < 1 << 20 {
                said.extend_from_slice(&buffer[..count]);
            }
        }
        String::from_utf8_lossy(&said).into_owned()
    })
}

/// Lets a command run for a while, and ends it. Whether it ended well by itself.
fn watch(mut command: Command, patience: Duration) -> bool {
    let described = format!("{command:?}");
    let start = Instant::now();
    let mut child: Child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .env("RUST_BACKTRACE", "0")
        .spawn()
        .unwrap();
    let last = Arc::new(AtomicU64::new(0));
    let output = listen(child.stdout.take().unwrap(), start, &last);
    let errors = listen(child.stderr.take().unwrap(), start, &last);
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break Some(status);
        }
        let used = memory(child.id());
        assert!(used < MEMORY, "{described}: {} MiB", used >> 10);
        let silent = start.elapsed() - Duration::from_millis(last.load(Ordering::Relaxed));
        assert!(silent < SILENCE, "{described}: silent for {silent:?}");
        if start.elapsed() > patience {
            let _ = child.kill();
            let _ = child.wait();
            break None;
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    // A worker that is still there holds the pipe until it notices that its parent has ended.
    let Some(status) = status else { return false };
    let (said, errors) = (output.join().unwrap(), errors.join().unwrap());
    assert!(!errors.contains("panicked") && !said.contains("panicked"), "{described}: {errors}");
    let code = status.code().unwrap_or_else(|| panic!("{described}: {status}, {errors}"));
    assert!([0, 1, 2].contains(&code), "{described}: exit code {code}, {errors}");
    // A run may fail; that its worker crashed or its memory ran out would be told here.
    assert!(!errors.contains("crashed") && !errors.contains("killed"), "{described}: {errors}");
    code == 0
}

/// Folders of finished runs.
fn finished(dir: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(dir) else { return Vec::new() };
    let mut found = Vec::new();
    for path in entries.map(|entry| entry.unwrap().path()) {
        if path.ends_with("evaluation.json") {
            found.push(dir.to_owned());
        } else if path.is_dir() {
            found.extend(finished(&path));
        }
    }
    found
}

#[test]
#[ignore = "takes ten minutes"]
fn random_options_within_their_ranges_do_no_harm() {
    let minutes = std::env::var("CVAR_GAME_MINUTES").map_or(10.0, |text| text.parse().unwrap());
    let seed = std::env::var("CVAR_GAME_SEED").map_or(1, |text| text.parse().unwrap());
    let random = &mut ChaCha8Rng::seed_from_u64(seed);
    let options: Vec<OptionInfo> = standard().catalogue().options().collect();
    let end = Instant::now() + Duration::from_secs_f64(60.0 * minutes);
    let (mut cases, mut done, mut verbs) = (0, 0, [0; 8]);
    while Instant::now() < end {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let world = ["lava-grid", "lava-point"][index(2, random)];
        let eta = number([Some(1.0), Some(1e6)], 25.0, random);
        let mut settings: Vec<String> = Vec::new();
        // Mostly so small that it ends.
        if random.random_bool(0.8) {
            for small in
                ["train.steps=30000", "evaluation.episodes=2000", "evaluation.figure_episodes=2000"]
            {
                settings.push(small.to_owned());
            }
        }
        for _ in 0..random.random_range(1..=5) {
            let option = &options[index(options.len(), random)];
            let other = ["lava-grid", "lava-point"].into_iter().find(|of| *of != world).unwrap();
            if option.key.starts_with("experiment") || option.key.contains(other) {
                continue;
            }
            settings.extend(value(option, random).map(|value| format!("{}={value}", option.key)));
        }
        let with = |verb: &str| {
            let mut command = program(verb);
            command.env("XDG_CACHE_HOME", folder.path().join("cache"));
            for setting in &settings {
                command.args(["--set", setting]);
            }
            command
        };
        let patience = Duration::from_secs(if random.random_bool(0.1) { 70 } else { 5 });
        let verb = index(4, random);
        verbs[verb] += 1;
        cases += 1;
        let ended = match verb {
            0 => {
                let mut exact = with("exact");
                exact.args(["--env", world, "--eta", &eta.to_string()]);
                watch(exact, patience)
            }
            1 => {
                let mut config = with("config");
                config.args(["--env", world]);
                watch(config, patience)
            }
            2 => {
                let mut train = with("train");
                train
                    .args(["--env", world, "--eta", &eta.to_string(), "--seed", "1", "--out"])
                    .arg(&out);
                watch(train, patience)
            }
            _ => {
                let mut bench = with("bench");
                bench.args(["--set", "experiment.seeds=[1, 2]", "--set"]);
                bench.arg(format!("experiment.envs=[\"{world}\"]")).arg("--out").arg(&out);
                bench.args(["--set", &format!("experiment.etas=[1.0, {eta:e}]")]);
                watch(bench, patience)
            }
        };
        done += usize::from(ended);
        if let Some(run) = finished(&out).first() {
            let episodes = number([Some(1.0), Some(1e7)], 1000.0, random) as u64;
            for (verb, name) in ["evaluate", "rollout"].into_iter().enumerate() {
                let mut play = program(name);
                play.arg(run).args(["--episodes", &episodes.to_string()]);
                play.args(["--seed", &random.random::<u64>().to_string()]);
                watch(play, Duration::from_secs(3));
                verbs[4 + verb] += 1;
            }
            for name in ["table", "report", "pack"] {
                let mut verb = program(name);
                verb.arg(&out);
                watch(verb, Duration::from_secs(5));
                verbs[6] += 1;
            }
        }
        let file = folder.path().join("some.toml");
        fs::write(&file, "experiment.seeds = [1]\n").unwrap();
        let mut slurm = with("slurm");
        slurm.arg("--config").arg(&file).arg("--out").arg(folder.path().join("sweep"));
        watch(slurm, Duration::from_secs(5));
        verbs[7] += 1;
    }
    println!("{cases} cases, of which {done} ended well in their time; by verb {verbs:?}");
    assert!(done > 0, "nothing was tried");
}
