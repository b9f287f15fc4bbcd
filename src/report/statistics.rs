//! Statistics over seeds: point estimates and 95 % intervals.
//!
//! The seed is the unit of replication: it decides whether a run learns at all, and episodes of one
//! run say nothing about that. Hence three kinds of interval:
//!
//! - **Nested bootstrap** ([`nested_bootstrap`], percentile): draw n of the n seeds with replacement;
//!   for every seed drawn, redraw its episodes; compute the statistic. Episodes are kept as the atoms
//!   of a [`ReturnLaw`] with their counts, so redrawing all of them is one multinomial draw
//!   ([`redraw`]). An exact law has no episodes to redraw. The spread between seeds contains the
//!   noise of their episodes already, so the second level errs on the wide side, slightly when the
//!   episodes are many.
//! - **Student t** ([`paired_difference`]) for differences to eta = 1 of the same seed. With few seeds
//!   the bootstrap over seeds is too narrow: its variance falls short by (n-1)/n, and it does not
//!   know the heavy tail of a mean of few. Of normal differences a nominal 95 % percentile interval
//!   covers about 75 % at n = 3 and 90 % at n = 10 (a test here measures it). The t interval covers
//!   95 % there, and is merely wide where it should be. Runs of one seed share evaluation streams, so
//!   their common noise cancels in the difference.
//! - **Wilson** ([`wilson`]) for rates: the bootstrap of an event that never happened is [0, 0].
//!
//! So with 3 seeds read the bootstrap intervals of the main table as too narrow.
//!
//! IQM, stratification and probability of improvement follow Agarwal et al., "Deep Reinforcement
//! Learning at the Edge of the Statistical Precipice" (NeurIPS 2021), and are checked against its
//! library rliable and SciPy in `tests/report_statistics.rs`.

use crate::game::returns::{Atom, NORMAL_95, ReturnLaw};
use lava_envs::random::ChaCha8Rng;
use rand::RngExt as _;
use rand_distr::{Binomial, Distribution as _};
use statrs::distribution::{ContinuousCDF as _, StudentsT};

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

/// Mean of paired differences with its Student t interval (the reason is in the module's head).
pub fn paired_difference(differences: &[f64]) -> Option<Estimate> {
    let value = mean(differences)?;
    let count = differences.len();
    let interval = (count > 1).then(|| {
        let squares: f64 = differences.iter().map(|difference| (difference - value).powi(2)).sum();
        let error = (squares / (count - 1) as f64 / count as f64).sqrt();
        let half = student_quantile(count - 1) * error;
        Interval { low: value - half, high: value + half }
    });
    Some(Estimate { value, interval })
}

/// Quantile of Student's t at (1 + LEVEL) / 2 with `freedom` >= 1 degrees of freedom.
///
/// # Panics
/// If `freedom` is 0.
pub fn student_quantile(freedom: usize) -> f64 {
    let law = StudentsT::new(0.0, 1.0, freedom as f64).expect("at least one degree of freedom");
    law.inverse_cdf(0.5 * (1.0 + LEVEL))
}

/// Redraws the episodes of a law with replacement. An exact law stays what it is.
///
/// The answer knows no number of episodes: whether a tail is thick enough is asked of the original.
pub fn redraw(law: &ReturnLaw, random: &mut ChaCha8Rng) -> ReturnLaw {
    let Some(episodes) = law.episodes() else { return law.clone() };
    // A multinomial draw is a chain of binomial ones, each over what the former left.
    let (mut left, mut mass_left) = (episodes, 1.0);
    let mut atoms = Vec::with_capacity(law.atoms().len());
    for (index, atom) in law.atoms().iter().enumerate() {
        let last = index + 1 == law.atoms().len();
        let share = if last { 1.0 } else { (atom.mass / mass_left).clamp(0.0, 1.0) };
        // Binomial::new refuses only probabilities outside [0, 1] and NaN, which 0/0 of a mass that is used up gives.
        let count = Binomial::new(left, share).map_or(0, |binomial| binomial.sample(random));
        left -= count;
        mass_left -= atom.mass;
        if count > 0 {
            atoms.push(Atom { mass: count as f64 / episodes as f64, ..*atom });
        }
    }
    ReturnLaw::exact(atoms)
}

/// Bootstrap replicates of a group of seeds: each is n of the n seeds drawn with replacement, every
/// one passed through `redraw` (which draws the seed's episodes anew, or just copies a number).
///
/// Strata, as rliable has them for tasks, are bootstrapped each on its own and joined replicate by
/// replicate.
pub fn nested_bootstrap<S, R>(
    seeds: &[S],
    replicates: usize,
    random: &mut ChaCha8Rng,
    mut redraw: impl FnMut(&S, &mut ChaCha8Rng) -> R,
) -> Vec<Vec<R>> {
    (0..replicates)
        .map(|_| {
            (0..seeds.len())
                .map(|_| {
                    let seed = &seeds[random.random_range(0..seeds.len())];
                    redraw(seed, random)
                })
                .collect()
        })
        .collect()
}

/// The percentile interval of a statistic from its bootstrap replicates; `None` of nothing.
pub fn percentile_interval(replicates: &[f64]) -> Option<Interval> {
    let sorted = sorted(replicates);
    let tail = 0.5 * (1.0 - LEVEL);
    Some(Interval { low: quantile(&sorted, tail)?, high: quantile(&sorted, 1.0 - tail)? })
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
