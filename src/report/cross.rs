//! The cross matrix: every policy at every risk level.
//!
//! `cross.csv` has one row per world, eta and alpha: `env,eta,alpha,cvar,lo,hi`, where `cvar` is the
//! mean over seeds of the greedy protagonist's CVaR_alpha under nominal chance, and `lo`, `hi` are the
//! ends of its 95 % interval (nested bootstrap). Empty where the tail is too thin or, for the ends,
//! with fewer than two seeds.

use super::group::{ALPHAS, Group};
use super::runs::{csv_text, number};

/// The text of `cross.csv`.
pub fn to_csv(groups: &[Group]) -> String {
    let header = ["env", "eta", "alpha", "cvar", "lo", "hi"].map(str::to_owned).to_vec();
    let rows = groups.iter().flat_map(|group| {
        ALPHAS.into_iter().map(|alpha| {
            let level = group.level(alpha);
            let cvar = group.mean(|measures| measures.cvar[level]);
            let interval = cvar.and_then(|cvar| cvar.interval);
            vec![
                group.env.to_owned(),
                group.eta.to_string(),
                alpha.to_string(),
                number(cvar.map(|cvar| cvar.value)),
                number(interval.map(|interval| interval.low)),
                number(interval.map(|interval| interval.high)),
            ]
        })
    });
    csv_text(std::iter::once(header).chain(rows))
}
