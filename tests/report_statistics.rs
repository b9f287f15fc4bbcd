//! The statistics against rliable and SciPy (`tests/data/statistics_reference.py`), and what is
//! claimed of the intervals.

use cvar_game::game::returns::{Atom, ReturnLaw};
use cvar_game::report::statistics::{
    cvar, improvement, iqm, mean, median, nested_bootstrap, paired_difference, percentile_interval,
    redraw, student_quantile, wilson,
};
use lava_envs::End;
use lava_envs::random::{Purpose, stream};
use rand_distr::{Distribution as _, StandardNormal};
use serde_json::Value;

fn reference() -> Value {
    serde_json::from_str(include_str!("data/statistics_reference.json")).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn tasks(value: &Value) -> Vec<Vec<f64>> {
    value.as_array().unwrap().iter().map(numbers).collect()
}

#[track_caller]
fn near(found: f64, expected: &Value, tolerance: f64) {
    let expected = expected.as_f64().unwrap();
    assert!((found - expected).abs() <= tolerance, "{found} is not {expected}");
}

#[test]
fn means_medians_and_interquartile_means_equal_the_reference() {
    for sample in reference()["samples"].as_array().unwrap() {
        let values = numbers(&sample["values"]);
        near(iqm(&values).unwrap(), &sample["iqm"], 1e-12);
        near(iqm(&values).unwrap(), &sample["rliable_iqm"], 1e-12);
        near(mean(&values).unwrap(), &sample["mean"], 1e-12);
        near(median(&values).unwrap(), &sample["median"], 1e-12);
    }
    assert_eq!((mean(&[]), median(&[]), iqm(&[])), (None, None, None));
}

#[test]
fn intervals_of_rates_and_differences_equal_the_reference() {
    let reference = reference();
    for rate in reference["wilson"].as_array().unwrap() {
        let count = |key: &str| rate[key].as_f64().unwrap();
        let interval = wilson(count("successes"), count("trials")).unwrap();
        near(interval.low, &rate["interval"][0], 1e-12);
        near(interval.high, &rate["interval"][1], 1e-12);
    }
    assert_eq!(wilson(0.0, 0.0), None);
    for student in reference["student"].as_array().unwrap() {
        let freedom = student["freedom"].as_u64().unwrap() as usize;
        near(student_quantile(freedom), &student["quantile"], 1e-8);
    }
    for pair in reference["paired"].as_array().unwrap() {
        let differences: Vec<f64> =
            numbers(&pair["x"]).iter().zip(numbers(&pair["y"])).map(|(x, y)| x - y).collect();
        let estimate = paired_difference(&differences).unwrap();
        near(estimate.value, &pair["difference"], 1e-12);
        near(estimate.interval.unwrap().low, &pair["interval"][0], 1e-8);
        near(estimate.interval.unwrap().high, &pair["interval"][1], 1e-8);
    }
    assert_eq!(paired_difference(&[0.5]).unwrap().interval, None);
    assert_eq!(paired_difference(&[]), None);
}

/// rliable averages the probability of improvement over tasks.
fn over_tasks(x: &[Vec<f64>], y: &[Vec<f64>]) -> f64 {
    let each: Vec<f64> = x.iter().zip(y).map(|(x, y)| improvement(x, y).unwrap()).collect();
    mean(&each).unwrap()
}

#[test]
fn probability_of_improvement_equals_the_reference() {
    for case in reference()["improvement"].as_array().unwrap() {
        near(over_tasks(&tasks(&case["x"]), &tasks(&case["y"])), &case["probability"], 1e-12);
    }
    // A failed run loses against every number and ties with another failed one.
    let failed = f64::NEG_INFINITY;
    assert_eq!(improvement(&[failed, 0.5], &[failed, 0.0]), Some((0.5 + 0.0 + 1.0 + 1.0) / 4.0));
}

/// Both libraries draw 100,000 replicates of the same scores: the ends of their intervals agree to
/// the third digit.
#[test]
fn stratified_bootstrap_equals_the_reference() {
    let reference = reference();
    let (x, y) = (tasks(&reference["bootstrap"]["x"]), tasks(&reference["bootstrap"]["y"]));
    let replicates = reference["replicates"].as_u64().unwrap() as usize;
    let mut random = stream(0, Purpose::Bootstrap, 0);
    let mut drawn = |scores: &[Vec<f64>]| -> Vec<Vec<Vec<f64>>> {
        scores
            .iter()
            .map(|task| nested_bootstrap(task, replicates, &mut random, |score, _| *score))
            .collect()
    };
    let (x, y) = (drawn(&x), drawn(&y));
    let joined = |drawn: &[Vec<Vec<f64>>], replicate: usize| -> Vec<Vec<f64>> {
        drawn.iter().map(|task| task[replicate].clone()).collect()
    };
    let check = |name: &str, statistic: &dyn Fn(usize) -> f64| {
        let values: Vec<f64> = (0..replicates).map(statistic).collect();
        let interval = percentile_interval(&values).unwrap();
        let expected = &reference["bootstrap"][name];
        near(interval.low, &expected[0], 1e-3);
        near(interval.high, &expected[1], 1e-3);
    };
    check("mean", &|replicate| mean(&joined(&x, replicate).concat()).unwrap());
    check("iqm", &|replicate| iqm(&joined(&x, replicate).concat()).unwrap());
    check("improvement", &|replicate| over_tasks(&joined(&x, replicate), &joined(&y, replicate)));
}

fn atom(value: f64, mass: f64) -> Atom {
    Atom { value, undiscounted: value, steps: 1, end: End::Goal, mass }
}

#[test]
fn redrawn_episodes_scatter_like_their_standard_error() {
    let values = [-1.0, 0.2, 0.5, 0.5, 0.6, 0.6, 0.7, 0.7];
    let law = ReturnLaw::recorded((0..800).map(|episode| atom(values[episode % 8], 0.0)));
    let mut random = stream(0, Purpose::Bootstrap, 1);
    let redrawn: Vec<ReturnLaw> = (0..4000).map(|_| redraw(&law, &mut random)).collect();
    for law in &redrawn {
        let mass: f64 = law.atoms().iter().map(|atom| atom.mass).sum();
        assert!((mass - 1.0).abs() < 1e-12, "the masses sum to {mass}");
    }
    let scatter = |statistic: &dyn Fn(&ReturnLaw) -> f64| {
        let values: Vec<f64> = redrawn.iter().map(statistic).collect();
        let centre = mean(&values).unwrap();
        let squares: Vec<f64> = values.iter().map(|value| (value - centre).powi(2)).collect();
        (centre, mean(&squares).unwrap().sqrt())
    };
    let (centre, error) = scatter(&ReturnLaw::mean);
    assert!((centre - law.mean()).abs() < 4.0 * error / 4000_f64.sqrt());
    approx::assert_relative_eq!(error, law.mean_standard_error(), max_relative = 0.05);
    let (_, error) = scatter(&|law| law.cvar(0.2));
    approx::assert_relative_eq!(error, law.cvar_standard_error(0.2), max_relative = 0.05);
}

#[test]
fn an_exact_law_has_no_episodes_to_redraw() {
    let law = ReturnLaw::exact(vec![atom(0.0, 0.25), atom(1.0, 0.75)]);
    assert_eq!(redraw(&law, &mut stream(0, Purpose::Bootstrap, 2)), law);
}

#[test]
fn cvar_refuses_a_tail_of_fewer_than_ten_episodes() {
    let recorded = |count: usize| ReturnLaw::recorded((0..count).map(|i| atom(i as f64, 0.0)));
    assert_eq!(cvar(&recorded(999), 0.01), None);
    assert!(cvar(&recorded(1000), 0.01).is_some());
    assert!(cvar(&recorded(10), 1.0).is_some());
    assert_eq!(cvar(&ReturnLaw::exact(vec![atom(2.0, 1.0)]), 0.001), Some(2.0));
}

/// The reason for Student's t in `paired_difference`, and for the warning under tables of few seeds.
#[test]
fn bootstrap_over_three_seeds_is_too_narrow_and_student_is_not() {
    let mut random = stream(0, Purpose::Bootstrap, 3);
    for (seeds, bootstrap_coverage) in [(3, 0.75), (10, 0.90)] {
        let trials = 2000;
        let (mut student, mut bootstrap) = (0, 0);
        for _ in 0..trials {
            let sample: Vec<f64> = (0..seeds).map(|_| StandardNormal.sample(&mut random)).collect();
            let interval = paired_difference(&sample).unwrap().interval.unwrap();
            student += usize::from(interval.low <= 0.0 && 0.0 <= interval.high);
            let means: Vec<f64> = nested_bootstrap(&sample, 400, &mut random, |score, _| *score)
                .iter()
                .map(|replicate| mean(replicate).unwrap())
                .collect();
            let interval = percentile_interval(&means).unwrap();
            bootstrap += usize::from(interval.low <= 0.0 && 0.0 <= interval.high);
        }
        let share = |count: usize| count as f64 / f64::from(trials);
        assert!((share(student) - 0.95).abs() < 0.02, "{seeds} seeds: {}", share(student));
        let found = share(bootstrap);
        assert!((found - bootstrap_coverage).abs() < 0.03, "{seeds} seeds: {found}");
    }
}
