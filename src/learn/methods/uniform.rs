//! The method `uniform`: the protagonist's actions are uniformly random, and nothing is learned. A baseline
//! for every table, and the shortest example of a method.

use crate::learn::method::{
    Arena, Method, Metric, Players, Progress, Setting, TrainError, Training,
};
use crate::learn::policy::{Mode, Opponent, Policy, Streams};
use crate::learn::state::Unfit;
use crate::learn::weights::{self, WeightsError};
use lava_envs::Action;

/// The method `uniform`.
#[derive(Debug, Clone, Copy)]
pub struct Uniform;

impl Method for Uniform {
    const NAME: &'static str = "uniform";
    const METRICS: &'static [Metric] = &[];

    fn begin<'a, W: Arena>(_: W, _: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(Uniform)
    }

    fn players<W: Arena>(_: &W, _: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(Uniform)
    }
}

impl<W: Arena> Training<W> for Uniform {
    fn update(&mut self) -> Result<Option<Progress>, TrainError> {
        Ok(None)
    }

    fn updates(&self) -> u64 {
        0
    }

    fn steps(&self) -> u64 {
        0
    }

    fn state(&self) -> Vec<u8> {
        Vec::new()
    }

    fn restore(&mut self, state: &[u8]) -> Result<(), Unfit> {
        if state.is_empty() { Ok(()) } else { Err(Unfit("the method's")) }
    }

    fn players(&self) -> &dyn Players<W> {
        self
    }
}

impl<W: Arena> Players<W> for Uniform {
    fn protagonist(&self) -> Box<dyn Policy<W> + '_> {
        Box::new(Uniform)
    }

    fn opponent(&self) -> Option<Box<dyn Opponent<W> + '_>> {
        None
    }

    fn weights(&self, about: String) -> Result<Vec<u8>, WeightsError> {
        weights::to_bytes(&[], about)
    }

    fn load(&mut self, bytes: &[u8]) -> Result<(), WeightsError> {
        weights::Weights::read(bytes).map(|_| ())
    }
}

impl<W: Arena> Policy<W> for Uniform {
    /// Every action is a mode of the uniform law: greedy and sampled are the same.
    fn choose(&mut self, _: &W, _: Mode, streams: &mut [Streams], actions: &mut Vec<W::Action>) {
        actions.extend(streams.iter_mut().map(|of| W::Action::uniform(&mut of.actions)));
    }

    /// None: a yardstick would take the first of the equally likely actions for the greedy one. The
    /// policy is measured by its episodes.
    fn probabilities(&mut self, _: &W) -> Option<Vec<f64>> {
        None
    }

    fn sees_time(&self) -> bool {
        false
    }
}
