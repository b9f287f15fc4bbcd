//! What a training run costs against its sizes: parallel episodes, hidden units, horizon, jobs.
//!
//! Runs the release build of `cvar-game` and writes `scaling.md`, `scaling.csv` and `scaling.svg` to
//! `results/speed`. Every size is measured several times in an order that alternates between sizes, so
//! that a drift of the machine hits all of them; the median counts.

use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use plotters::prelude::*;

/// Measurements of each size.
const REPEATS: usize = 3;

/// One question: a name, the option that is changed, its values, and how the option is written.
struct Axis {
    name: &'static str,
    unit: &'static str,
    values: &'static [u64],
    options: fn(u64) -> Vec<String>,
}

/// Environment steps of a run.
const STEPS: u64 = 600_000;

const AXES: [Axis; 3] = [
    Axis {
        name: "parallel episodes",
        unit: "episodes, 10,000 steps per update throughout",
        values: &[64, 250, 1_000, 4_096],
        options: |n| {
            let steps = (10_000 / n).max(1);
            vec![
                format!("train.parallel_episodes={n}"),
                format!("train.rollout_steps={steps}"),
                format!("train.protagonist.minibatch={}", 2_500.min(n * steps)),
                format!("train.antagonist.minibatch={}", 2_500.min(n * steps)),
            ]
        },
    },
    Axis {
        name: "hidden units",
        unit: "units of actor and of critic each",
        values: &[32, 64, 128, 256, 512],
        options: |n| {
            vec![format!("train.protagonist.hidden={n}"), format!("train.antagonist.hidden={n}")]
        },
    },
    Axis {
        name: "horizon",
        unit: "steps T, and steps of a rollout",
        values: &[20, 40, 80, 160],
        options: |n| vec![format!("env.horizon={n}"), format!("train.rollout_steps={n}")],
    },
];

/// A line of the figure: a world, what the players see of it, and its colour.
type Line = (&'static str, &'static str, RGBColor);

const LINES: [Line; 4] = [
    ("lava-grid", "coordinates", RGBColor(0x00, 0x72, 0xB2)),
    ("lava-grid", "features", RGBColor(0x56, 0xB4, 0xE9)),
    ("lava-point", "coordinates", RGBColor(0xD5, 0x5E, 0x00)),
    ("lava-point", "features", RGBColor(0xE6, 0x9F, 0x00)),
];

/// Environment steps per second of training, by line, axis and value, and the gain of a second job.
pub fn measure(repository: &Path, target: &Path) -> Result<()> {
    let program = target.join("release").join("cvar-game");
    let mut speeds =
        vec![Vec::new(); LINES.len() * AXES.iter().map(|a| a.values.len()).sum::<usize>()];
    let mut sweeps = Vec::new();
    for repeat in 0..REPEATS {
        eprintln!("round {} of {REPEATS}", repeat + 1);
        let mut index = 0;
        for (world, sight, _) in LINES {
            for axis in &AXES {
                for &value in axis.values {
                    let mut options = (axis.options)(value);
                    options.push(format!("train.observation={sight:?}"));
                    speeds[index].push(train(&program, world, &options)?);
                    index += 1;
                }
            }
        }
        sweeps.push([sweep(&program, 1)?, sweep(&program, 2)?]);
    }
    let folder = repository.join("results").join("speed");
    std::fs::create_dir_all(&folder)?;
    let speeds: Vec<f64> = speeds.into_iter().map(median).collect();
    let seconds = [0, 1].map(|jobs| median(sweeps.iter().map(|pair| pair[jobs]).collect()));
    let gain = median(sweeps.iter().map(|[one, two]| one / two).collect());
    std::fs::write(folder.join("scaling.csv"), csv(&speeds))?;
    std::fs::write(folder.join("scaling.md"), document(&speeds, seconds, gain))?;
    draw(&folder.join("scaling.svg"), &speeds)?;
    println!("{}", document(&speeds, seconds, gain));
    Ok(())
}

/// Environment steps per second of one run.
fn train(program: &Path, world: &str, options: &[String]) -> Result<f64> {
    let out = tempfile::tempdir()?;
    let mut command = Command::new(program);
    command.args(["train", "--json", "--eta", "25", "--seed", "1", "--env", world, "--steps"]);
    command.arg(STEPS.to_string()).arg("--out").arg(out.path());
    command.args(["--set", "evaluation.episodes=100", "--set", "evaluation.figure_episodes=100"]);
    for option in options {
        command.arg("--set").arg(option);
    }
    let output = command.output().context("cvar-game could not be started")?;
    if !output.status.success() {
        bail!("cvar-game failed: {}", String::from_utf8_lossy(&output.stderr));
    }
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    answer["steps_per_second"].as_f64().context("the run reports no speed")
}

/// Seconds of a sweep of eight equal runs with `jobs` jobs, with its evaluations and its report.
fn sweep(program: &Path, jobs: usize) -> Result<f64> {
    let out = tempfile::tempdir()?;
    let config = out.path().join("sweep.toml");
    std::fs::write(
        &config,
        "[experiment]\nenvs = [\"lava-grid\"]\netas = [25]\nseeds = [1, 2, 3, 4, 5, 6, 7, 8]\n\
         [train]\nsteps = 2_000_000\n",
    )?;
    let start = std::time::Instant::now();
    let mut command = Command::new(program);
    command.arg("bench").arg("--config").arg(&config).arg("--out").arg(out.path().join("out"));
    command.args(["--jobs", &jobs.to_string()]).stdout(Stdio::null()).stderr(Stdio::null());
    if !command.status()?.success() {
        bail!("the sweep failed");
    }
    Ok(start.elapsed().as_secs_f64())
}

fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers[numbers.len() / 2]
}

/// Line, axis, value and speed of every measurement.
fn rows(speeds: &[f64]) -> impl Iterator<Item = (Line, &'static Axis, u64, f64)> + '_ {
    let keys = LINES.into_iter().flat_map(|line| {
        AXES.iter().flat_map(move |axis| axis.values.iter().map(move |&value| (line, axis, value)))
    });
    keys.zip(speeds).map(|((line, axis, value), &speed)| (line, axis, value, speed))
}

fn csv(speeds: &[f64]) -> String {
    let mut text = "env,observation,axis,value,steps_per_second\n".to_owned();
    for ((world, sight, _), axis, value, speed) in rows(speeds) {
        let _ = writeln!(text, "{world},{sight},{},{value},{speed:.0}", axis.name);
    }
    text
}

fn document(speeds: &[f64], [one, two]: [f64; 2], gain: f64) -> String {
    let mut text = format!(
        "# What training costs\n\nEnvironment steps per second of one run on one core, eta = 25, \
         {} thousand steps; medians of {REPEATS} runs, in an order that alternates between the sizes. All \
         else is as in `configs/default.toml` (250 parallel episodes, 64 hidden units, T = 40); with features the players see \
         the cell, or the waves of the position, and not the time. Made by `cargo xtask scaling`, which wants a machine that does nothing else. The default size stands in all \
         three tables: how far its numbers differ is the noise of the machine.\n\n\
         ![steps per second against the sizes](scaling.svg)\n",
        STEPS / 1_000
    );
    for axis in &AXES {
        let _ = write!(text, "\n## {}\n\nIn {}.\n\n| |", capital(axis.name), axis.unit);
        for value in axis.values {
            let _ = write!(text, " {value} |");
        }
        let _ = write!(text, "\n|---|{}\n", "---:|".repeat(axis.values.len()));
        for line in LINES {
            let _ = write!(text, "| {}, {} |", line.0, line.1);
            for (_, _, _, speed) in rows(speeds).filter(|r| r.0 == line && r.1.name == axis.name) {
                let _ = write!(text, " {:.0}k |", speed / 1e3);
            }
            text.push('\n');
        }
    }
    let _ = write!(
        text,
        "\n## Jobs\n\nEight runs of 2 million steps on lava-grid take {one:.1} s in one job and {two:.1} s in two, \
         on two cores, evaluations and report included; {gain:.2} times as long, the median of {REPEATS} pairs.\n"
    );
    text
}

fn capital(name: &str) -> String {
    let mut letters = name.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

/// A panel per axis: steps per second against its values.
fn draw(path: &Path, speeds: &[f64]) -> Result<()> {
    let area = SVGBackend::new(path, (1080, 340)).into_drawing_area();
    area.fill(&WHITE)?;
    let top = speeds.iter().copied().fold(0.0, f64::max) * 1.3 / 1e3;
    for (panel, axis) in area.split_evenly((1, AXES.len())).iter().zip(&AXES) {
        // The values double or quadruple: equal distances are a logarithmic axis whose marks are theirs.
        let last = axis.values.len() as f64 - 1.0;
        let mut chart = ChartBuilder::on(panel)
            .caption(axis.name, ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(30)
            .y_label_area_size(64)
            .build_cartesian_2d(-0.3..last + 0.3, 0.0..top)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .max_light_lines(0)
            .label_style(("sans-serif", 14))
            .y_desc("thousand steps per second")
            .y_label_formatter(&|y| format!("{y:.0}"))
            .x_labels(axis.values.len())
            .x_label_formatter(&|&x| axis.values[x.round() as usize].to_string())
            .draw()?;
        for line @ (world, sight, colour) in LINES {
            let points: Vec<(f64, f64)> = rows(speeds)
                .filter(|row| row.0 == line && row.1.name == axis.name)
                .enumerate()
                .map(|(place, (.., speed))| (place as f64, speed / 1e3))
                .collect();
            chart
                .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)).point_size(3))?
                .label(format!("{world}, {sight}"))
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour));
        }
        chart
            .configure_series_labels()
            .label_font(("sans-serif", 13))
            .position(SeriesLabelPosition::UpperRight)
            .draw()?;
    }
    area.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_size_has_its_mark_and_its_point() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scaling.svg");
        let sizes = AXES.iter().map(|axis| axis.values.len()).sum::<usize>();
        let speeds: Vec<f64> = (0..LINES.len() * sizes).map(|i| 7e5 + 1e3 * i as f64).collect();
        draw(&path, &speeds).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        // The marks of the speeds are hundreds up to 700; no size equals one of them.
        let all = || AXES.iter().flat_map(|axis| axis.values);
        for value in all() {
            let axes = all().filter(|&other| other == value).count();
            assert_eq!(svg.matches(&format!("\n{value}\n")).count(), axes, "marks at {value}");
        }
        assert_eq!(svg.matches("<circle").count(), speeds.len());
        assert_eq!(csv(&speeds).lines().count(), 1 + speeds.len());
    }
}
