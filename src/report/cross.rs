//! The cross matrix: every policy at every risk level.
//!
//! `cross.csv` has one row per world, eta and alpha: `env,eta,alpha,cvar,lo,hi`, where `cvar` is the
//! mean, over the seeds that do not fail (all where every one fails), of the greedy protagonist's CVaR_alpha under
//! nominal chance, and `lo`, `hi` are the ends of its 95 % interval (Student t). Fields are empty where the tail is too thin or, for the
//! ends, where there are fewer than two seeds. A folder with other methods than `game`, or with variants,
//! has the column `method` before them.

use super::group::{ALPHAS, Group};
use super::runs::{csv_text, number};

/// The text of `cross.csv`.
pub fn to_csv(groups: &[&Group]) -> String {
    let method = groups.iter().any(|group| group.method.is_some()).then_some("method");
    let names = ["env", "eta", "alpha", "cvar", "lo", "hi"];
    let header = method.into_iter().chain(names).map(str::to_owned).collect();
    let rows = groups.iter().flat_map(|group| {
        ALPHAS.into_iter().map(|alpha| {
            let level = group.level(alpha);
            let cvar = group.mean(|measures| measures.cvar[level]);
            let interval = cvar.and_then(|cvar| cvar.interval);
            let fields = [
                group.env.to_owned(),
                group.eta.to_string(),
                alpha.to_string(),
                number(cvar.map(|cvar| cvar.value)),
                number(interval.map(|interval| interval.low)),
                number(interval.map(|interval| interval.high)),
            ];
            group.method.clone().into_iter().chain(fields).collect()
        })
    });
    csv_text(std::iter::once(header).chain(rows))
}
