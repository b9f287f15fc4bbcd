//! The statistics against rliable and SciPy (`tests/data/statistics_reference.py`), and what is
//! claimed of the intervals.

use cvar_game::game::returns::{Atom, ReturnLaw};
use cvar_game::report::statistics::{
    Estimate, Interval, clopper_pearson, cvar, difference, holm, improvement, improvement_interval,
    iqm, iqm_estimate, mean, mean_estimate, median, overall, student_estimate, student_p,
    student_quantile, wilson,
};
use lava_envs::End;
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
        let interval = iqm_estimate(&values, 0.0).unwrap().interval;
        assert_eq!(interval.is_some(), !sample["iqm_interval"].is_null());
        if let Some(interval) = interval {
            near(interval.low, &sample["iqm_interval"][0], 1e-8);
            near(interval.high, &sample["iqm_interval"][1], 1e-8);
        }
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
    for rate in reference["clopper_pearson"].as_array().unwrap() {
        let count = |key: &str| rate[key].as_u64().unwrap() as usize;
        let interval = clopper_pearson(count("successes"), count("trials")).unwrap();
        near(interval.low, &rate["interval"][0], 1e-7);
        near(interval.high, &rate["interval"][1], 1e-7);
    }
    assert_eq!(clopper_pearson(0, 0), None);
    for family in reference["holm"].as_array().unwrap() {
        let corrected = holm(&numbers(&family["p"]));
        for (found, expected) in corrected.iter().zip(family["corrected"].as_array().unwrap()) {
            near(*found, expected, 1e-12);
        }
    }
    for student in reference["student"].as_array().unwrap() {
        let freedom = student["freedom"].as_u64().unwrap() as usize;
        near(student_quantile(freedom), &student["quantile"], 1e-8);
    }
    for pair in reference["paired"].as_array().unwrap() {
        let differences: Vec<f64> =
            numbers(&pair["x"]).iter().zip(numbers(&pair["y"])).map(|(x, y)| x - y).collect();
        near(student_p(&differences).unwrap(), &pair["p"], 1e-9);
        let estimate = student_estimate(&differences).unwrap();
        near(estimate.value, &pair["difference"], 1e-12);
        near(estimate.interval.unwrap().low, &pair["interval"][0], 1e-8);
        near(estimate.interval.unwrap().high, &pair["interval"][1], 1e-8);
    }
    assert_eq!(mean_estimate(&[0.5], 0.0).unwrap().interval, None);
    assert_eq!(mean_estimate(&[], 0.0), None);
    assert_eq!(student_p(&[0.25, 0.25]), Some(0.0));
    assert_eq!(student_p(&[0.0, 0.0]), Some(1.0));
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

/// The ends of the interval are where the variance of Hanley and McNeil, with both numbers of runs replaced by their mean,
/// puts the observed probability 1.96 standard errors away; with independent words for that variance here.
#[test]
fn the_interval_of_a_probability_of_improvement_solves_its_equation() {
    for (probability, m, n) in [(0.5, 10, 10), (0.93, 5, 20), (1.0, 3, 3), (0.0, 20, 10)] {
        let interval = improvement_interval(probability, m, n).unwrap();
        let (m, n) = (f64::from(u32::try_from(m).unwrap()), f64::from(u32::try_from(n).unwrap()));
        for end in [interval.low, interval.high] {
            let others = (m + n) / 2.0 - 1.0;
            let (q1, q2) = (end / (2.0 - end), 2.0 * end * end / (1.0 + end));
            let square = end * end;
            let variance = end - square + others * (q1 - square) + others * (q2 - square);
            let error = (variance / (m * n)).sqrt();
            let is_end = end == probability && (end == 0.0 || end == 1.0);
            let away = (end - probability).abs();
            assert!(is_end || (away - 1.959_964 * error).abs() < 1e-6, "{interval:?}");
        }
        assert!(interval.high - interval.low > 0.05, "{interval:?} is degenerate");
    }
    assert_eq!(improvement_interval(0.5, 1, 9), None);
}

#[test]
fn an_error_that_all_have_in_common_widens_the_interval_as_squares() {
    let alone = mean_estimate(&[0.1, 0.2, 0.6], 0.0).unwrap();
    let common = mean_estimate(&[0.1, 0.2, 0.6], 0.05).unwrap().interval.unwrap();
    let (value, alone) = (alone.value, alone.interval.unwrap());
    let widened = |half: f64| half.hypot(1.959_964 * 0.05);
    approx::assert_relative_eq!(
        value - common.low,
        widened(value - alone.low),
        max_relative = 1e-6
    );
    approx::assert_relative_eq!(
        common.high - value,
        widened(alone.high - value),
        max_relative = 1e-6
    );
    // Two values are symmetric, whatever rounding says of their skew.
    for pair in [[0.1, 0.3], [0.205_3, 0.203_1], [1e-3, 1e-3 + 1e-12]] {
        assert_eq!(mean_estimate(&pair, 0.0), student_estimate(&pair));
    }
    // Skewed upwards: wider there than Student's t, and the same below.
    let student = student_estimate(&[0.1, 0.2, 0.6]).unwrap().interval.unwrap();
    assert!(alone.high > student.high && alone.low == student.low, "{alone:?} {student:?}");
}

#[test]
fn what_failures_may_do_is_in_the_interval_of_all_runs() {
    let range = [-2.0, 1.0];
    // Three alike, none failed: up to 70.8 % may fail (1 - 0.025^(1/3)) and return -2.
    let of = overall(&[0.5; 3], &[], range, 0.0).unwrap();
    let interval = of.interval.unwrap();
    approx::assert_relative_eq!(
        interval.low,
        0.5 - (1.0 - 0.025_f64.cbrt()) * 2.5,
        max_relative = 1e-9
    );
    assert_eq!((of.value, interval.high), (0.5, 0.5));
    // A stopped run counts as the least return.
    let of = overall(&[0.5; 3], &[None], range, 0.0).unwrap();
    assert_eq!(of.value, (3.0 * 0.5 - 2.0) / 4.0);
    // Nobody has succeeded: of success nothing is known but the range.
    let of = overall(&[], &[Some(-1.0); 4], range, 0.0).unwrap();
    assert_eq!((of.value, of.interval.unwrap().low), (-1.0, -1.0));
    assert!(of.interval.unwrap().high > 0.1);
    assert_eq!(overall(&[0.1], &[], range, 0.0).unwrap().interval, None);
    assert_eq!(overall(&[], &[], range, 0.0), None);
}

#[test]
fn deviations_of_a_difference_add_as_squares() {
    let of = |value: f64, low: f64, high: f64| Estimate {
        value,
        interval: Some(Interval { low, high }),
    };
    let found = difference(of(1.0, 0.7, 1.1), of(0.2, 0.1, 0.6)).interval.unwrap();
    approx::assert_relative_eq!(found.low, 0.8 - 0.5, max_relative = 1e-12);
    approx::assert_relative_eq!(found.high, 0.8 + 0.1_f64.hypot(0.1), max_relative = 1e-12);
}

fn atom(value: f64, mass: f64) -> Atom {
    Atom { value, undiscounted: value, steps: 1, end: End::Goal, mass }
}

#[test]
fn cvar_refuses_a_tail_of_fewer_than_ten_episodes() {
    let recorded = |count: usize| ReturnLaw::recorded((0..count).map(|i| atom(i as f64, 0.0)));
    assert_eq!(cvar(&recorded(999), 0.01), None);
    assert!(cvar(&recorded(1000), 0.01).is_some());
    assert!(cvar(&recorded(10), 1.0).is_some());
    assert_eq!(cvar(&ReturnLaw::exact(vec![atom(2.0, 1.0)]), 0.001), Some(2.0));
}
