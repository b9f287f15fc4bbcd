//! The method `neutral`: the protagonist of Algorithm 1 without an antagonist. It maximises the mean return, whatever
//! the budget at which it is judged.

use crate::learn::method::{Arena, Method, Metric, Players, Setting, Training};
use crate::learn::options::TrainOptions;
use crate::learn::solo::{self, Objective, Returns, Solo};
use serde::{Deserialize, Serialize};

/// The method `neutral`.
#[derive(Debug, Clone, Copy)]
pub struct Neutral;

impl Method for Neutral {
    const NAME: &'static str = "neutral";
    const METRICS: &'static [Metric] = solo::METRICS;

    fn check<W: Arena>(options: &TrainOptions, _: &toml::Table) -> Result<(), String> {
        solo::check::<W>(options)
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(Solo::<W, MeanReturn>::new(world, setting))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(solo::players(world, setting))
    }
}

/// The mean return.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct MeanReturn;

impl Objective for MeanReturn {
    fn new(_: &toml::Table) -> Self {
        MeanReturn
    }

    fn judge(&mut self, _: &Returns<'_>, _: &mut [f32]) -> Option<Vec<f32>> {
        None
    }
}
