//! Statistics over seeds: point estimates and 95 % intervals.
//!
//! The seed is the unit of replication: it decides whether a run learns at all, and episodes of one
//! run say nothing about that. Runs that learn are alike, and a run that fails is far away from all of them, so that
//! the mean of a few seeds with failures has no interval of the usual kinds: ten seeds without a failure are what one
//! sees six times in ten where one run in twenty fails. Hence two questions are kept apart.
//!
//! - How often does a run fail? [`clopper_pearson`], the exact interval of a share. (Wilson's covers 86 % at three
//!   seeds and 91 % at ten where one run in twenty fails.)
//! - How good is a run that does not? [`mean_estimate`], Student's t over the seeds that succeed with room for their
//!   skew; for differences paired by seed, over the pairs in which both succeed, [`student_estimate`]; [`iqm_estimate`],
//!   the t interval of a trimmed mean.
//!
//! [`overall`] puts the two together and covers the mean over all runs, failures included. It assumes nothing of failed
//! runs but the range of returns, and is as wide as that makes it.
//!
//! Evaluations of all runs share their random streams, and a regret to a sampled optimum shares that optimum: this part
//! of their error does not show in the spread between seeds. Intervals of means add the whole sampling error of a run, as
//! if all of it were shared; where laws are exact there is none. In paired differences it cancels.
//!
//! What each interval covers, with and without failures, was simulated: `results/coverage.md`, made by
//! `tests/coverage.rs`. IQM and probability of improvement follow Agarwal et al., "Deep Reinforcement Learning at the
//! Edge of the Statistical Precipice" (NeurIPS 2021); values are checked against its library rliable and SciPy in
//! `tests/report_statistics.rs`.

use crate::game::returns::{NORMAL_95, ReturnLaw};
use statrs::distribution::{Beta, ContinuousCDF as _, StudentsT};

/// Coverage of every interval.
pub const LEVEL: f64 = 0.95;

/// Recorded episodes that the alpha-tail must hold before its mean is reported.
pub const TAIL_EPISODES: f64 = 10.0;

/// A 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// A statistic with its interval, where one can be given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The statistic of the data.
    pub value: f64,
    /// Its 95 % interval; `None` with fewer than two seeds.
    pub interval: Option<Interval>,
}

/// The arithmetic mean; `None` of nothing.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The median; `None` of nothing.
pub fn median(values: &[f64]) -> Option<f64> {
    quantile(&sorted(values), 0.5)
}

/// The interquartile mean: the mean of what is left after floor(n/4) values are cut at either end
/// (`scipy.stats.trim_mean(values, 0.25)`; of fewer than four values the plain mean).
pub fn iqm(values: &[f64]) -> Option<f64> {
    let sorted = sorted(values);
    let cut = sorted.len() / 4;
    mean(&sorted[cut..sorted.len() - cut])
}

/// The least value; `None` of nothing.
pub fn worst(values: &[f64]) -> Option<f64> {
    values.iter().copied().min_by(f64::total_cmp)
}

/// CVaR_alpha of a law, unless its alpha-tail holds fewer than [`TAIL_EPISODES`] recorded episodes.
/// An exact law always answers.
///
/// # Panics
/// If `alpha` is outside (0, 1].
pub fn cvar(law: &ReturnLaw, alpha: f64) -> Option<f64> {
    // The slack lets 1000 episodes at alpha = 0.01 through whatever their product rounds to.
    let enough =
        law.episodes().is_none_or(|count| count as f64 * alpha >= TAIL_EPISODES * (1.0 - 1e-9));
    enough.then(|| law.cvar(alpha))
}

/// Wilson's interval of a rate from `successes` in `trials` (fractions of them are welcome).
pub fn wilson(successes: f64, trials: f64) -> Option<Interval> {
    if trials <= 0.0 {
        return None;
    }
    let rate = successes / trials;
    let weight = NORMAL_95 * NORMAL_95 / trials;
    let centre = (rate + weight / 2.0) / (1.0 + weight);
    let half = (rate * (1.0 - rate) * weight + weight * weight / 4.0).sqrt() / (1.0 + weight);
    Some(Interval { low: (centre - half).max(0.0), high: (centre + half).min(1.0) })
}

/// Probability that a run of `x` beats one of `y`: the mean over all pairs of P(X > Y) + P(X = Y)/2
/// (the Mann-Whitney statistic scaled to [0, 1]). Minus infinity stands for a run that failed.
pub fn improvement(x: &[f64], y: &[f64]) -> Option<f64> {
    let points = |a: f64, b: f64| match a.total_cmp(&b) {
        _ if a == b => 0.5,
        std::cmp::Ordering::Greater => 1.0,
        _ => 0.0,
    };
    let pairs = (x.len() * y.len()) as f64;
    let won: f64 = x.iter().flat_map(|&a| y.iter().map(move |&b| points(a, b))).sum();
    (pairs > 0.0).then(|| won / pairs)
}

/// The exact interval of a rate from `successes` in `trials` (Clopper and Pearson 1934): it covers at least
/// [`LEVEL`] whatever the rate is. `None` without trials.
pub fn clopper_pearson(successes: usize, trials: usize) -> Option<Interval> {
    let tail = 0.5 * (1.0 - LEVEL);
    let quantile = |a: usize, b: usize, probability| {
        Beta::new(a as f64, b as f64).expect("positive shapes").inverse_cdf(probability)
    };
    let failures = trials.checked_sub(successes).filter(|_| trials > 0)?;
    let low = if successes == 0 { 0.0 } else { quantile(successes, failures + 1, tail) };
    let high = if failures == 0 { 1.0 } else { quantile(successes + 1, failures, 1.0 - tail) };
    Some(Interval { low, high })
}

/// Mean with Student's t interval, widened on the side to which the values are skewed: seeds mostly are, many near the
/// optimum and some far below, and t alone covers 90 % at ten of those. The end there is that of Hall's transformation of
/// t (1992; Zhou and Gao 2000), if it is further away. `common_error` is the standard error of what all values have in
/// common.
pub fn mean_estimate(values: &[f64], common_error: f64) -> Option<Estimate> {
    let Estimate { value, interval } = student_estimate(values)?;
    let interval = interval.map(|student| {
        let [below, above] = skewed_deviations(values).unwrap_or_default();
        let common = NORMAL_95 * common_error;
        Interval {
            low: value - below.max(value - student.low).hypot(common),
            high: value + above.max(student.high - value).hypot(common),
        }
    });
    Some(Estimate { value, interval })
}

/// Mean with Student's t interval: for paired differences, whose skew cancels.
pub fn student_estimate(values: &[f64]) -> Option<Estimate> {
    let value = mean(values)?;
    let half = |error: f64| student_quantile(values.len() - 1) * error;
    let interval = standard_error(values).map(half);
    let interval = interval.map(|half| Interval { low: value - half, high: value + half });
    Some(Estimate { value, interval })
}

/// Skewness below which values count as symmetric: there the transformation is the identity, up to its rounding.
const SYMMETRIC: f64 = 1e-6;

/// How far the ends of Hall's interval are below and above the mean; `None` where values do not differ or are symmetric.
fn skewed_deviations(values: &[f64]) -> Option<[f64; 2]> {
    let (centre, count) = (mean(values)?, values.len() as f64);
    let moment = |power| values.iter().map(|of| (of - centre).powi(power)).sum::<f64>() / count;
    let deviation = moment(2).sqrt();
    let skewness = moment(3) / deviation.powi(3);
    let quantile = student_quantile(values.len() - 1) / count.sqrt();
    // The inverse of T + g T^2 / 3 + g^2 T^3 / 27 + g / 6n with T the studentised mean over sqrt(n), and the skewness g.
    let inverse = |of: f64| {
        let root = (1.0 + skewness * (of - skewness / (6.0 * count))).cbrt();
        3.0 / skewness * (root - 1.0)
    };
    // Values that do not differ have a skewness that is no number.
    (skewness.abs() > SYMMETRIC)
        .then(|| [deviation * inverse(quantile), -deviation * inverse(-quantile)])
}

/// Interquartile mean ([`iqm`]) with the t interval of a trimmed mean (Yuen 1974), whose error is that of the winsorised
/// values. None where a quarter of the values is no number.
pub fn iqm_estimate(values: &[f64], common_error: f64) -> Option<Estimate> {
    let value = iqm(values)?;
    let sorted = sorted(values);
    let (count, cut) = (sorted.len(), sorted.len() / 4);
    let (least, most) = (sorted[cut], sorted[count - 1 - cut]);
    let winsorised: Vec<f64> = sorted.iter().map(|value| value.clamp(least, most)).collect();
    let left = count - 2 * cut;
    let interval = standard_error(&winsorised).filter(|error| error.is_finite() && left > 1);
    let interval = interval.map(|error| {
        let scale = (count * (count - 1)) as f64 / (left * (left - 1)) as f64;
        let half = student_quantile(left - 1) * error * scale.sqrt();
        let half = half.hypot(NORMAL_95 * common_error);
        Interval { low: value - half, high: value + half }
    });
    Some(Estimate { value, interval })
}

/// The mean over all runs: those that succeed, and those that fail, whose return is only known to be in a range. A failed
/// run without a return counts as the least one.
///
/// The mean is (1 - p) s + p f, with the share p that fails and the means s and f of either kind. The deviations that the
/// intervals of p, s and f allow are added as squares (the method of variance estimates recovery, Zou and Donner 2008).
/// Where no run has failed, f may be as low as the least return.
pub fn overall(
    succeeded: &[f64],
    failed: &[Option<f64>],
    [least, greatest]: [f64; 2],
    common_error: f64,
) -> Option<Estimate> {
    let failed: Vec<f64> = failed.iter().map(|value| value.unwrap_or(least)).collect();
    let count = succeeded.len() + failed.len();
    let rate = clopper_pearson(failed.len(), count)?;
    let p = failed.len() as f64 / count as f64;
    let range = Interval { low: least, high: greatest };
    let part = |values: &[f64]| {
        let interval = mean_estimate(values, common_error).and_then(|of| of.interval);
        interval.map_or(range, |of| Interval {
            low: of.low.clamp(least, greatest),
            high: of.high.clamp(least, greatest),
        })
    };
    let (s, f) = (part(succeeded), part(&failed));
    let (s_mean, f_mean) = (mean(succeeded), mean(&failed));
    let value = (1.0 - p) * s_mean.unwrap_or(0.0) + p * f_mean.unwrap_or(0.0);
    let distance = (s_mean.unwrap_or(greatest) - f_mean.unwrap_or(least)).max(0.0);
    let norm = |parts: [f64; 3]| parts.iter().map(|of| of * of).sum::<f64>().sqrt();
    let below = norm([
        (1.0 - p) * (s_mean.unwrap_or(s.low) - s.low),
        p * (f_mean.unwrap_or(f.low) - f.low),
        (rate.high - p) * distance,
    ]);
    let above = norm([
        (1.0 - p) * (s.high - s_mean.unwrap_or(s.high)),
        p * (f.high - f_mean.unwrap_or(f.high)),
        (p - rate.low) * distance,
    ]);
    let interval = (count > 1).then(|| Interval {
        low: (value - below).clamp(least, greatest),
        high: (value + above).clamp(least, greatest),
    });
    Some(Estimate { value, interval })
}

/// The difference of two independent estimates, by the same method.
pub fn difference(x: Estimate, y: Estimate) -> Estimate {
    let interval = x.interval.zip(y.interval).map(|(a, b)| {
        let value = x.value - y.value;
        let below = (x.value - a.low).hypot(b.high - y.value);
        let above = (a.high - x.value).hypot(y.value - b.low);
        Interval { low: value - below, high: value + above }
    });
    Estimate { value: x.value - y.value, interval }
}

/// The interval of a probability of improvement that `m` runs have shown against `n` others: Newcombe's method 5 (2006),
/// which inverts the variance of Hanley and McNeil as Wilson's inverts that of a share. It has a width at 0 and 1, too.
pub fn improvement_interval(probability: f64, m: usize, n: usize) -> Option<Interval> {
    if m < 2 || n < 2 {
        return None;
    }
    let (m, n) = (m as f64, n as f64);
    let others = (m + n) / 2.0 - 1.0;
    let beyond = |of: f64| {
        let spread = 1.0 + others * ((1.0 - of) / (2.0 - of) + of / (1.0 + of));
        (of - probability).powi(2) - NORMAL_95.powi(2) * of * (1.0 - of) * spread / (m * n)
    };
    // Between the probability, where it is not positive, and the end, where it is not negative.
    let root = |mut inside: f64, mut outside: f64| {
        for _ in 0..60 {
            let middle = 0.5 * (inside + outside);
            if beyond(middle) > 0.0 { outside = middle } else { inside = middle }
        }
        outside
    };
    Some(Interval { low: root(probability, 0.0), high: root(probability, 1.0) })
}

/// The p value of Student's t test that the mean is 0, of both sides. `None` with fewer than two values.
pub fn student_p(values: &[f64]) -> Option<f64> {
    let (value, error) = (mean(values)?, standard_error(values)?);
    if error == 0.0 {
        return Some(if value == 0.0 { 1.0 } else { 0.0 });
    }
    Some(2.0 * student(values.len() - 1).cdf(-(value / error).abs()))
}

/// Holm's correction of p values for their number (1979): the chance that any true hypothesis among those whose corrected
/// value is below 0.05 is rejected is at most 5 %.
pub fn holm(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|&a, &b| p_values[a].total_cmp(&p_values[b]));
    let mut corrected = vec![0.0; p_values.len()];
    let mut reached: f64 = 0.0;
    for (rank, &place) in order.iter().enumerate() {
        reached = reached.max((p_values.len() - rank) as f64 * p_values[place]).min(1.0);
        corrected[place] = reached;
    }
    corrected
}

/// The standard error of a mean; `None` with fewer than two values.
fn standard_error(values: &[f64]) -> Option<f64> {
    let (value, count) = (mean(values)?, values.len());
    let squares: f64 = values.iter().map(|of| (of - value).powi(2)).sum();
    (count > 1).then(|| (squares / (count - 1) as f64 / count as f64).sqrt())
}

/// Quantile of Student's t at (1 + LEVEL) / 2 with `freedom` >= 1 degrees of freedom.
///
/// # Panics
/// If `freedom` is 0.
pub fn student_quantile(freedom: usize) -> f64 {
    student(freedom).inverse_cdf(0.5 * (1.0 + LEVEL))
}

fn student(freedom: usize) -> StudentsT {
    StudentsT::new(0.0, 1.0, freedom as f64).expect("at least one degree of freedom")
}

/// Quantile of ascending values, interpolated linearly (NumPy's default).
fn quantile(sorted: &[f64], probability: f64) -> Option<f64> {
    let position = probability * sorted.len().checked_sub(1)? as f64;
    let (low, high) = (sorted[position.floor() as usize], sorted[position.ceil() as usize]);
    // Between failed runs (minus infinity) there is nothing to interpolate.
    let between = low.is_finite() && high.is_finite();
    Some(if between { low + (high - low) * position.fract() } else { low })
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}
