//! Adam (Kingma & Ba 2015) over one flat vector, with all of its state accessible.

use crate::game::columns::{self, Loops};
use serde::{Deserialize, Serialize};

/// Decay rates and the guard of the division, as everywhere in PPO (epsilon is CleanRL's).
const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-5;

/// The optimiser of one player.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Adam {
    first_moment: Vec<f32>,
    second_moment: Vec<f32>,
    steps: u64,
}

impl Adam {
    /// A fresh optimiser of `parameters` numbers.
    pub fn new(parameters: usize) -> Self {
        Adam { first_moment: vec![0.0; parameters], second_moment: vec![0.0; parameters], steps: 0 }
    }

    /// Whether this is the state of an optimiser of `parameters` numbers.
    pub fn fits(&self, parameters: usize) -> bool {
        // The second moment is a mean of squares; its root is taken.
        let moments = self.first_moment.iter().chain(&self.second_moment);
        [self.first_moment.len(), self.second_moment.len()] == [parameters; 2]
            && moments.into_iter().all(|moment| moment.is_finite())
            && self.second_moment.iter().all(|&moment| moment >= 0.0)
    }

    /// One step of descent along `gradient`.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32], learning_rate: f64) {
        self.steps += 1;
        let correction = BETA.map(|beta| 1.0 - beta.powf(self.steps as f64));
        let step = (learning_rate / correction[0]) as f32;
        let root = 1.0 / correction[1].sqrt() as f32;
        let moments = [&mut self.first_moment[..], &mut self.second_moment];
        columns::widest(Step { parameters, gradient, moments, step, root });
    }
}

/// The arithmetic of a step, with the processor's widest vectors.
struct Step<'a> {
    parameters: &'a mut [f32],
    gradient: &'a [f32],
    moments: [&'a mut [f32]; 2],
    step: f32,
    root: f32,
}

impl Loops for Step<'_> {
    #[inline(always)]
    fn run(self) {
        let Step { parameters, gradient, moments: [first, second], step, root } = self;
        let [beta_1, beta_2] = BETA.map(|beta| beta as f32);
        let moments = first.iter_mut().zip(second);
        for ((parameter, &g), (m, v)) in parameters.iter_mut().zip(gradient).zip(moments) {
            *m = beta_1 * *m + (1.0 - beta_1) * g;
            *v = beta_2 * *v + (1.0 - beta_2) * g * g;
            *parameter -= step * *m / (v.sqrt() * root + EPSILON as f32);
        }
    }
}
