//! The benchmarks of speed as one table, from the files that criterion writes.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result, ensure};
use serde_json::Value;

/// Groups of benchmarks in the order of the table.
const GROUPS: [&str; 7] =
    ["control-steps", "perturbation", "rollout", "limit", "network", "update", "train"];

/// The group of the arithmetic alone, and those that do the arithmetic of its benchmark of the same name, with how many
/// times for each of their steps: an update has four epochs.
const LIMIT: &str = "limit";
const LIMITED: [(&str, f64); 2] = [("network", 1.0), ("update", 4.0)];

/// One finished benchmark.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    group: String,
    name: String,
    /// Median time of an iteration with its 95 % interval, in ns.
    median: f64,
    interval: [f64; 2],
    /// Environment steps of an iteration.
    steps: f64,
}

impl Row {
    fn steps_per_second(&self) -> f64 {
        self.steps / self.median * 1e9
    }
}

/// What to run: the benchmarks of both crates.
pub const CARGO: [&str; 9] =
    ["bench", "-p", "cvar-game", "-p", "lava-envs", "--bench", "speed", "--bench", "stepping"];

/// Where cargo builds.
pub fn target(repository: &Path) -> PathBuf {
    // A relative folder is relative to where cargo runs: the repository.
    let folder = std::env::var_os("CARGO_TARGET_DIR").unwrap_or_else(|| OsString::from("target"));
    repository.join(folder)
}

/// Makes the table of the benchmarks that ran since `start`, prints it, and writes it to
/// `speed.md` in the target folder.
pub fn report(target: &Path, start: SystemTime) -> Result<()> {
    let mut rows = Vec::new();
    collect(&target.join("criterion"), start, &mut rows)?;
    ensure!(!rows.is_empty(), "no benchmark ran; does its filter name any?");
    let place = |row: &Row| GROUPS.iter().position(|&group| group == row.group);
    rows.sort_by(|a, b| (place(a), &a.name).cmp(&(place(b), &b.name)));
    let table = table(&rows);
    print!("\n{table}");
    let path = target.join("speed.md");
    fs::write(&path, table).with_context(|| format!("{} cannot be written", path.display()))?;
    println!("\nwritten to {}", path.display());
    Ok(())
}

/// Walks criterion's folders; a benchmark's last result is in its folder `new`.
fn collect(folder: &Path, start: SystemTime, rows: &mut Vec<Row>) -> Result<()> {
    let unreadable = || format!("{} cannot be read", folder.display());
    for entry in fs::read_dir(folder).with_context(unreadable)? {
        let path = entry.with_context(unreadable)?.path();
        if !path.is_dir() {
            continue;
        }
        let estimates = path.join("estimates.json");
        if path.ends_with("new") && estimates.is_file() {
            let written = fs::metadata(&estimates).and_then(|file| file.modified());
            // File systems round times down, some to two seconds.
            if written.with_context(unreadable)? + Duration::from_secs(2) >= start {
                rows.push(row(&json(&path.join("benchmark.json"))?, &json(&estimates)?)?);
            }
        } else {
            collect(&path, start, rows)?;
        }
    }
    Ok(())
}

fn json(path: &Path) -> Result<Value> {
    let text =
        fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("{} is not JSON", path.display()))
}

fn row(benchmark: &Value, estimates: &Value) -> Result<Row> {
    let text = |key: &str| benchmark[key].as_str().map(str::to_owned);
    let full = text("full_id").context("criterion names no benchmark")?;
    let group = text("group_id").with_context(|| format!("{full} has no group"))?;
    let name = full.strip_prefix(&format!("{group}/")).unwrap_or(&full).to_owned();
    let steps = benchmark["throughput"]["Elements"]
        .as_f64()
        .with_context(|| format!("{full} does not count environment steps"))?;
    let median = &estimates["median"];
    let number = |value: &Value| {
        value.as_f64().with_context(|| format!("criterion has no median time of {full}"))
    };
    let interval = &median["confidence_interval"];
    Ok(Row {
        group,
        name,
        median: number(&median["point_estimate"])?,
        interval: [number(&interval["lower_bound"])?, number(&interval["upper_bound"])?],
        steps,
    })
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| benchmark | time | environment steps per second (95 %) | share of the arithmetic limit |\n\
         |---|---:|---:|---:|\n",
    );
    let share = |row: &Row| {
        let (_, times) = LIMITED.iter().find(|(group, _)| *group == row.group)?;
        let limit = rows.iter().find(|of| of.group == LIMIT && of.name == row.name)?;
        Some(times * row.steps_per_second() / limit.steps_per_second())
    };
    for row in rows {
        let rate = row.steps_per_second();
        let [fast, slow] = row.interval.map(|time| row.steps / time * 1e9);
        let share = share(row).map_or("–".to_owned(), |share| format!("{:.0} %", 100.0 * share));
        text += &format!(
            "| {}/{} | {} | {} ({} to {}) | {share} |\n",
            row.group,
            row.name,
            duration(row.median),
            thousands(rate),
            thousands(slow),
            thousands(fast),
        );
    }
    text += "\nThe arithmetic limit is the networks' arithmetic on registers alone, without anything to read or write\n\
             (rows `limit`). An update does it four times per environment step, and more besides.\n";
    text
}

/// A time in ns with three digits and its unit.
fn duration(nanoseconds: f64) -> String {
    let (value, unit) = match nanoseconds {
        t if t < 1e3 => (t, "ns"),
        t if t < 1e6 => (t / 1e3, "us"),
        t if t < 1e9 => (t / 1e6, "ms"),
        t => (t / 1e9, "s"),
    };
    let decimals = if value < 10.0 { 2 } else { usize::from(value < 100.0) };
    format!("{value:.decimals$} {unit}")
}

/// A number rounded to three digits, with commas between thousands.
fn thousands(number: f64) -> String {
    let unit = 10f64.powf((number.abs().max(1.0).log10().floor() - 2.0).max(0.0));
    let digits = format!("{:.0}", (number / unit).round() * unit);
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i) % 3 == 0 {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(group: &str, name: &str) -> (Value, Value) {
        let benchmark = serde_json::json!({
            "group_id": group,
            "full_id": format!("{group}/{name}"),
            "throughput": {"Elements": 60_000},
        });
        let interval = serde_json::json!({"lower_bound": 1.2e8, "upper_bound": 3e8});
        let median = serde_json::json!({"point_estimate": 2e8, "confidence_interval": interval});
        (benchmark, serde_json::json!({"median": median}))
    }

    #[test]
    fn what_does_the_arithmetic_has_a_share_of_its_limit() {
        let rows = [("limit", 6e7), ("network", 2e8), ("update", 6e8), ("rollout", 2e8)].map(
            |(group, time)| {
                let (benchmark, mut estimates) = files(group, "lava-grid/antagonist");
                estimates["median"]["point_estimate"] = time.into();
                row(&benchmark, &estimates).unwrap()
            },
        );
        let table = table(&rows);
        let shares: Vec<&str> =
            table.lines().skip(2).take(4).map(|line| line.rsplit("| ").next().unwrap()).collect();
        assert_eq!(shares, ["– |", "30 % |", "40 % |", "– |"], "{table}");
        let expected =
            "| network/lava-grid/antagonist | 200 ms | 300,000 (200,000 to 500,000) | 30 % |";
        assert_eq!(table.lines().nth(3), Some(expected));
    }

    #[test]
    fn results_of_earlier_runs_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let new = folder.path().join("train/lava-grid/new");
        fs::create_dir_all(&new).unwrap();
        let (benchmark, estimates) = files("train", "lava-grid");
        fs::write(new.join("benchmark.json"), benchmark.to_string()).unwrap();
        fs::write(new.join("estimates.json"), estimates.to_string()).unwrap();
        let found = |start| {
            let mut rows = Vec::new();
            collect(folder.path(), start, &mut rows).unwrap();
            rows.len()
        };
        let now = SystemTime::now();
        assert_eq!(found(now), 1);
        assert_eq!(found(now + Duration::from_secs(60)), 0);
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!(thousands(1_234_567.0), "1,230,000");
        assert_eq!(thousands(999.6), "1,000");
        assert_eq!(thousands(12.3), "12");
        assert_eq!(duration(1234.0), "1.23 us");
        assert_eq!(duration(98.76e6), "98.8 ms");
    }
}
