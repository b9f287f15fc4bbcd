//! What the intervals of the tables cover: simulated seeds, with and without failures, and the committed table of it,
//! `results/coverage.md`. Where the simulation changes, `COVERAGE=write cargo test --test coverage` writes it again.

use cvar_game::report::statistics::{
    Interval, clopper_pearson, difference, improvement, improvement_interval, iqm, iqm_estimate,
    mean_estimate, overall, student_estimate, wilson,
};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use rand::RngExt as _;
use rand_distr::{Distribution as _, Exp1, StandardNormal};
use std::fmt::Write as _;
use std::path::Path;

const TRIALS: usize = 10_000;
const SEEDS: [usize; 3] = [3, 10, 20];
const FAILURES: [f64; 3] = [0.0, 0.05, 0.1];

/// Less than this is not printed without a warning.
const ENOUGH: f64 = 0.92;

/// How the CVaR of runs that succeed is spread: as a normal law, or as most seeds near the optimum and a tail below.
#[derive(Clone, Copy, PartialEq)]
enum Shape {
    Normal,
    Skewed,
}

/// The range of returns of lava-grid, rounded.
const RANGE: [f64; 2] = [-2.4, 1.0];

/// Runs of a row: a share fails, with returns near -1.1; the others have the given mean and a deviation of 0.02.
#[derive(Clone, Copy)]
struct Population {
    shape: Shape,
    mean: f64,
    failures: f64,
}

const DEVIATION: f64 = 0.02;
const OF_FAILED: f64 = -1.1;

impl Population {
    fn success(self, random: &mut ChaCha8Rng) -> f64 {
        let normal: f64 = StandardNormal.sample(random);
        let exponential: f64 = Exp1.sample(random);
        let spread = if self.shape == Shape::Normal { normal } else { 1.0 - exponential };
        self.mean + DEVIATION * spread
    }

    fn run(self, random: &mut ChaCha8Rng) -> Run {
        let failed = random.random_bool(self.failures);
        let normal: f64 = StandardNormal.sample(random);
        let value = if failed { OF_FAILED + 0.1 * normal } else { self.success(random) };
        Run { value, failed }
    }

    fn runs(self, count: usize, random: &mut ChaCha8Rng) -> Vec<Run> {
        (0..count).map(|_| self.run(random)).collect()
    }

    fn overall(self) -> f64 {
        (1.0 - self.failures) * self.mean + self.failures * OF_FAILED
    }
}

struct Run {
    value: f64,
    failed: bool,
}

fn succeeded(runs: &[Run]) -> Vec<f64> {
    runs.iter().filter(|run| !run.failed).map(|run| run.value).collect()
}

fn values(runs: &[Run]) -> Vec<f64> {
    runs.iter().map(|run| run.value).collect()
}

fn of_all(runs: &[Run]) -> cvar_game::report::statistics::Estimate {
    let failed: Vec<Option<f64>> =
        runs.iter().filter(|run| run.failed).map(|run| Some(run.value)).collect();
    overall(&succeeded(runs), &failed, RANGE, 0.0).unwrap()
}

/// What is true of a long sample.
fn long_run(
    random: &mut ChaCha8Rng,
    statistic: impl Fn(&[Run], &[Run]) -> f64,
    of: [Population; 2],
) -> f64 {
    let [x, y] = of.map(|population| population.runs(20_000, random));
    statistic(&x, &y)
}

/// The share of so many samples whose interval has the truth; samples without an interval count as none.
fn coverage(
    truth: f64,
    random: &mut ChaCha8Rng,
    interval: impl Fn(&mut ChaCha8Rng) -> Option<Interval>,
) -> Option<f64> {
    let (mut covered, mut all) = (0, 0);
    for _ in 0..TRIALS {
        if let Some(of) = interval(random) {
            all += 1;
            // What is computed twice differs in the last digit.
            covered += usize::from(of.low - 1e-9 <= truth && truth <= of.high + 1e-9);
        }
    }
    (all > 0).then(|| f64::from(covered as u32) / f64::from(all as u32))
}

type Simulation = fn(usize, Population, &mut ChaCha8Rng) -> Option<f64>;

/// The other row of a comparison: a worse one, which fails as often.
fn other(of: Population) -> Population {
    Population { mean: of.mean - 0.02, ..of }
}

/// The intervals, by the columns that have them.
const SIMULATIONS: [(&str, Simulation); 11] = [
    ("failed % (Clopper and Pearson)", |seeds, of, random| {
        coverage(of.failures, random, |random| {
            let failed = of.runs(seeds, random).iter().filter(|run| run.failed).count();
            clopper_pearson(failed, seeds)
        })
    }),
    ("for comparison: failed % (Wilson, not printed)", |seeds, of, random| {
        coverage(of.failures, random, |random| {
            let failed = of.runs(seeds, random).iter().filter(|run| run.failed).count();
            wilson(f64::from(failed as u32), f64::from(seeds as u32))
        })
    }),
    ("means, CVaR, regret, gap: seeds that succeed (t and Hall)", |seeds, of, random| {
        coverage(of.mean, random, |random| {
            mean_estimate(&succeeded(&of.runs(seeds, random)), 0.0)?.interval
        })
    }),
    ("for comparison: the same by t alone (not printed)", |seeds, of, random| {
        coverage(of.mean, random, |random| {
            student_estimate(&succeeded(&of.runs(seeds, random)))?.interval
        })
    }),
    ("CVaR, all", |seeds, of, random| {
        coverage(of.overall(), random, |random| of_all(&of.runs(seeds, random)).interval)
    }),
    ("for comparison: CVaR of all seeds (t, not printed)", |seeds, of, random| {
        coverage(of.overall(), random, |random| {
            student_estimate(&values(&of.runs(seeds, random)))?.interval
        })
    }),
    ("IQM (trimmed t)", |seeds, of, random| {
        if seeds < 4 {
            return None; // The table has none.
        }
        // What so many seeds estimate: the mean of what is left when as many are cut off.
        let cut = f64::from((seeds / 4) as u32) / f64::from(seeds as u32);
        let long = |x: &[Run], _: &[Run]| {
            let mut sorted = values(x);
            sorted.sort_by(f64::total_cmp);
            let off = (cut * sorted.len() as f64) as usize;
            let kept = &sorted[off..sorted.len() - off];
            kept.iter().sum::<f64>() / kept.len() as f64
        };
        let truth = long_run(random, long, [of, of]);
        coverage(truth, random, |random| {
            let runs = values(&of.runs(seeds, random));
            iqm(&runs)?;
            iqm_estimate(&runs, 0.0)?.interval
        })
    }),
    ("gain, difference: pairs that succeed (t)", |seeds, of, random| {
        coverage(of.mean - other(of).mean, random, |random| {
            let (x, y) = (of.runs(seeds, random), other(of).runs(seeds, random));
            let pairs = x.iter().zip(&y).filter(|(x, y)| !x.failed && !y.failed);
            let differences: Vec<f64> = pairs.map(|(x, y)| x.value - y.value).collect();
            student_estimate(&differences)?.interval
        })
    }),
    ("gain, all; difference, all", |seeds, of, random| {
        coverage(of.overall() - other(of).overall(), random, |random| {
            let (x, y) = (of.runs(seeds, random), other(of).runs(seeds, random));
            difference(of_all(&x), of_all(&y)).interval
        })
    }),
    ("P(better) (Newcombe)", |seeds, of, random| {
        let probability = |x: &[Run], y: &[Run]| improvement(&values(x), &values(y)).unwrap();
        // 500 against 500, forty times.
        let mut found = 0.0;
        for _ in 0..40 {
            let (x, y) = (of.runs(500, random), other(of).runs(500, random));
            found += probability(&x, &y) / 40.0;
        }
        coverage(found, random, |random| {
            let (x, y) = (of.runs(seeds, random), other(of).runs(seeds, random));
            improvement_interval(probability(&x, &y), seeds, seeds)
        })
    }),
    ("regret to an oracle of error 0.01 (t, Hall and that error)", |seeds, of, random| {
        coverage(of.mean, random, |random| {
            let normal: f64 = StandardNormal.sample(random);
            let (oracle, runs) = (0.01 * normal, succeeded(&of.runs(seeds, random)));
            let regrets: Vec<f64> = runs.iter().map(|value| value + oracle).collect();
            mean_estimate(&regrets, 0.01)?.interval
        })
    }),
];

/// By interval and number of seeds, what it covers for each share of failures and both shapes.
fn simulated() -> Vec<(&'static str, usize, Vec<Option<f64>>)> {
    let mut rows = Vec::new();
    for (place, (name, simulation)) in SIMULATIONS.iter().enumerate() {
        for seeds in SEEDS {
            let mut cells = Vec::new();
            for shape in [Shape::Normal, Shape::Skewed] {
                for failures in FAILURES {
                    let mut random = stream(seeds as u64, Purpose::Bootstrap, place as u64);
                    let of = Population { shape, mean: 0.2, failures };
                    cells.push(simulation(seeds, of, &mut random));
                }
            }
            rows.push((*name, seeds, cells));
        }
    }
    rows
}

fn table(rows: &[(&str, usize, Vec<Option<f64>>)]) -> String {
    let mut text = format!(
        "# What the 95 % intervals cover\n\n\
         Made by `tests/coverage.rs`: {TRIALS} simulated rows for each cell. A run fails with a probability of 0, 5 or 10 %\n\
         and has a return near {OF_FAILED} then; the CVaR of the others has a deviation of {DEVIATION}, as a normal law or skewed \
         (an\n\
         exponential law: most seeds near the best, a tail below). Other rows of comparisons fail as often. Bold: below \
         {:.0} %.\n\n",
        100.0 * ENOUGH
    );
    text += "| interval | seeds | normal, 0 % | 5 % | 10 % | skewed, 0 % | 5 % | 10 % |\n";
    text += "|---|---:|---:|---:|---:|---:|---:|---:|\n";
    for (name, seeds, cells) in rows {
        write!(text, "| {name} | {seeds} |").unwrap();
        for cell in cells {
            match cell {
                None => text += " – |",
                Some(share) => {
                    let bold = if *share < ENOUGH { "**" } else { "" };
                    write!(text, " {bold}{:.1}{bold} |", 100.0 * share).unwrap();
                }
            }
        }
        text += "\n";
    }
    text
}

#[test]
fn the_committed_table_of_coverage_is_that_of_the_simulation() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("results/coverage.md");
    let found = table(&simulated());
    if std::env::var_os("COVERAGE").is_some_and(|value| value == "write") {
        std::fs::write(&path, &found).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap();
    assert!(found == committed, "results/coverage.md is not what is simulated:\n{found}");
}
