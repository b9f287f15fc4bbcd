//! The method `return-capping` (Mead, Costen, Lacerda & Hawes, ICML 2025) on the protagonist of Algorithm 1: it
//! maximises
//!
//! ```text
//! E[ min(J, C) ],    C -> VaR_alpha(J),
//! ```
//!
//! which has the gradient of CVaR_alpha at C = VaR_alpha, but learns from all episodes. The reward of a step is what it
//! adds to the capped return, so that they sum to it.
//!
//! After each rollout the cap moves by a share of its distance to the rollout's VaR, and it has a floor. Without one a
//! protagonist whose tail is bad is content with it: in lava-grid the cap followed VaR down to the return of the time
//! limit, which every episode attains. While the risk level is 1 (`train.budget_wait`) there is no cap.

use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::TrainOptions;
use crate::learn::solo::{self, Objective, Returns, Solo};
use serde::{Deserialize, Serialize};

/// The method `return-capping`.
#[derive(Debug, Clone, Copy)]
pub struct ReturnCapping;

impl Method for ReturnCapping {
    const NAME: &'static str = "return-capping";
    const METRICS: &'static [Metric] = solo::METRICS;
    const DEFAULTS: &'static str = "\
# Share of the distance to the rollout's VaR by which the cap moves.
# Range: (0, 1]
cap_rate = 0.1
# Floor of the cap.
# Range: [-1000000, 1000000]
minimum_cap = 0.0
";

    fn check<W: Arena>(options: &TrainOptions, _: &toml::Table) -> Result<(), String> {
        solo::check::<W>(options)
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(Solo::<W, Capped>::new(world, setting))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(solo::players(world, setting))
    }
}

/// The mean of the capped return.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Capped {
    /// C; `None` while there is none.
    cap: Option<f64>,
    rate: f64,
    minimum: f64,
}

impl Objective for Capped {
    fn new(own: &toml::Table) -> Self {
        let option = |name| {
            own.get(name).and_then(toml::Value::as_float).expect("the configuration was checked")
        };
        Capped { cap: None, rate: option("cap_rate"), minimum: option("minimum_cap") }
    }

    fn judge(&mut self, returns: &Returns<'_>, rewards: &mut [f32]) -> Option<Vec<f32>> {
        if let (true, Some(new)) = (returns.alpha < 1.0, returns.value_at_risk()) {
            let cap = self.cap.map_or(new, |cap| cap + self.rate * (new - cap));
            self.cap = Some(cap.max(self.minimum));
        }
        if let Some(cap) = self.cap {
            for (reward, before) in rewards.iter_mut().zip(returns.before) {
                // The return of an episode that started anywhere is not that of a whole one.
                if let Some(before) = before {
                    let after = returns.after(before, *reward).value;
                    let gain =
                        before.missing(after.min(cap)) - before.missing(before.value.min(cap));
                    *reward = gain as f32;
                }
            }
        }
        None
    }

    fn threshold(&self) -> f64 {
        self.cap.unwrap_or(f64::NAN)
    }
}
