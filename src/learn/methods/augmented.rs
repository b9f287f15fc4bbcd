//! The method `augmented`: CVaR by the state that theory asks for. By Baeuerle & Ott (2011)
//!
//! ```text
//! max_pi CVaR_alpha = max_w { w - (1/alpha) min_pi E[(w - J)^+] },
//! ```
//!
//! and the inner problem is an ordinary one on the state augmented by what the return has accumulated. In these worlds
//! all steps of a running episode earn alike, so that the time says it: the protagonist must see the time. For the w of
//! the moment it maximises `E[min(J, w)]`, which is `w - E[(w - J)^+]`, and the best w for the policy of the moment is its
//! VaR: both are followed together, as the cap is in [`super::return_capping`].

use super::return_capping::{Capped, ReturnCapping};
use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::TrainOptions;
use crate::learn::solo::{self, Solo};

/// The method `augmented`.
#[derive(Debug, Clone, Copy)]
pub struct Augmented;

impl Method for Augmented {
    const NAME: &'static str = "augmented";
    const METRICS: &'static [Metric] = solo::METRICS;
    const DEFAULTS: &'static str = ReturnCapping::DEFAULTS;

    fn check<W: Arena>(options: &TrainOptions, _: &toml::Table) -> Result<(), String> {
        if !options.protagonist.time_aware {
            return Err("the method `augmented` needs the time, which says what an episode has earned; use \
                        train.protagonist.time_aware = true"
                .to_owned());
        }
        solo::check::<W>(options)
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(Solo::<W, Capped>::new(world, setting))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(solo::players(world, setting))
    }
}
