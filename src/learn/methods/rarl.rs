//! The method `rarl`: robust adversarial reinforcement learning (Pinto, Davidson, Sukthankar & Gupta, ICML 2017) with
//! the players of Algorithm 1. The adversary is bounded in every step, not over the trajectory:
//!
//! ```text
//! sup_o delta_t(o) <= strength    for every t.
//! ```
//!
//! With `train.family.kind = "shift"` it is the published bounded force, where the noise is Gaussian: it moves the mean, and
//! log strength bounds the relative entropy of each step (`crate::game::shift`).
//!
//! It is the rival that the paper argues against: a bound for each step has no risk level, and its strength must be
//! found by trial. Players are updated in turn, and `train.budget_wait` and `train.budget_rise` are a schedule of the
//! strength. What the adversary could do within the game's budget is unknown; only its protagonist is judged.

use super::game::{Game, GameTraining};
use crate::game::budget::Eta;
use crate::learn::family;
use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::{Acts, Adversary, FamilyOptions, TrainOptions};
use crate::learn::pair::Pair;
use crate::learn::vector_game::Spending;

/// The method `rarl`.
#[derive(Debug, Clone, Copy)]
pub struct Rarl;

impl Rarl {
    /// The setting of the game that it plays: its budget is that of every step.
    fn game<'a>(setting: &Setting<'a>) -> Setting<'a> {
        let strength = setting.own.get("strength").and_then(toml::Value::as_float);
        let eta = strength.and_then(|strength| Eta::new(strength).ok());
        Setting { eta: eta.expect("the configuration was checked"), ..setting.clone() }
    }
}

impl Method for Rarl {
    const NAME: &'static str = "rarl";
    const METRICS: &'static [Metric] = Game::METRICS;
    const DEFAULTS: &'static str = "\
# The most by which the adversary may multiply the probability of an outcome in each step; with train.family.kind =
# \"shift\", a force, it is the exponential of the most relative entropy in nats.
# Range: [1, 1000000]
strength = 1.5
";

    fn check<W: Arena>(options: &TrainOptions, own: &toml::Table) -> Result<(), String> {
        if options.antagonist_acts != Acts::Outcome || options.adversary != Adversary::Learned {
            return Err(
                "the method `rarl` has an adversary that learns and reweights outcomes; use \
                        train.antagonist_acts = \"outcome\" and train.adversary = \"learned\""
                    .to_owned(),
            );
        }
        // Its adversary has no budget to keep.
        family::family::<W::Law>(&options.family)?;
        let default = FamilyOptions { kind: "auto".to_owned(), ..options.family.clone() };
        let options = TrainOptions { family: default, ..options.clone() };
        Game::check::<W>(&options, own)
    }

    fn check_schedule(options: &TrainOptions, eta: Eta) -> Result<(), String> {
        Game::check_schedule(options, eta)
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(GameTraining::new(world, &Rarl::game(setting)).spending(Spending::Step))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(Pair::new(world, &Rarl::game(setting)).spending(Spending::Step))
    }
}
