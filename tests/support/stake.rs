//! A world of one step whose optima are known at every risk level: how much to stake on a Gaussian gain.

use lava_envs::law::GaussianLaw;
use lava_envs::{ConfigError, End, Field, Force, NoSuchState, Scene, Step, World};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

/// The first component of the push, cut off at 0, is the stake s. It pays `s (mean + deviation xi) - s^2 / 2`, xi the
/// first component of the noise, so that `CVaR_alpha = s (mean - k deviation) - s^2 / 2` with k the mean of the worst
/// alpha of a standard normal, and the best stake is `mean - k deviation`.
#[derive(Debug, Clone)]
pub struct Stake {
    constants: Constants,
    ended: Vec<bool>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Constants {
    pub mean: f64,
    pub deviation: f64,
}

impl World for Stake {
    type Constants = Constants;
    type Action = Force;
    type Law = GaussianLaw;
    type Snapshot = bool;
    const NAME: &'static str = "stake";
    const DEFAULTS: &'static str = "# Mean gain.\nmean = 0.8\n# Its deviation.\ndeviation = 0.25\n";
    const OBSERVATION: usize = 1;
    const SITUATION: usize = 3;

    fn new(constants: &Constants, episodes: usize) -> Result<Self, ConfigError> {
        Ok(Stake { constants: constants.clone(), ended: vec![false; episodes] })
    }
    fn constants(&self) -> &Constants {
        &self.constants
    }
    fn validate(_: &Constants) -> Result<(), ConfigError> {
        Ok(())
    }
    fn episodes(&self) -> usize {
        self.ended.len()
    }
    fn horizon(&self) -> u32 {
        1
    }
    fn reset(&mut self, slot: usize) {
        self.ended[slot] = false;
    }
    fn snapshot(&self, slot: usize) -> bool {
        self.ended[slot]
    }
    fn restore(&mut self, slot: usize, ended: bool) -> Result<(), NoSuchState> {
        self.ended[slot] = ended;
        Ok(())
    }
    fn time(&self, slot: usize) -> u32 {
        self.ended[slot].into()
    }
    fn observe(&self, _: usize, observation: &mut [f32]) {
        observation.fill(0.0);
    }
    fn law(&self, _: usize, _: Force) -> GaussianLaw {
        GaussianLaw
    }
    fn situation(&self, _: usize, action: Force, situation: &mut [f32]) {
        situation.copy_from_slice(&[0.0, action.on_disc().x as f32, action.on_disc().y as f32]);
    }
    fn clearance(&self, _: usize) -> f64 {
        f64::INFINITY
    }
    fn position(&self, _: usize) -> [f64; 2] {
        [0.0, 0.0]
    }
    fn scene(&self) -> Scene {
        let (size, start, areas) = ([1.0, 1.0], [0.0, 0.0], Vec::new());
        Scene { size, cells: false, start, areas, rules: String::new() }
    }
    fn state_columns(&self, _: usize) -> Vec<(&'static str, Field)> {
        Vec::new()
    }
    fn action_columns(action: Force) -> Vec<(&'static str, Field)> {
        vec![("stake", Field::Number(action.on_disc().x))]
    }
    fn outcome_columns(outcome: Vector2<f64>) -> Vec<(&'static str, Field)> {
        vec![("gain", Field::Number(outcome.x))]
    }
    fn action_arrow(action: Force) -> [f64; 2] {
        action.on_disc().into()
    }
    fn outcome_arrow(outcome: Vector2<f64>) -> [f64; 2] {
        outcome.into()
    }
    fn apply(&mut self, actions: &[Force], outcomes: &[Vector2<f64>], steps: &mut [Step]) {
        let Constants { mean, deviation } = self.constants;
        for (slot, ended) in self.ended.iter_mut().enumerate() {
            let stake = actions[slot].on_disc().x.max(0.0);
            let reward = stake * (mean + deviation * outcomes[slot].x) - 0.5 * stake * stake;
            steps[slot] = if *ended { Step::IDLE } else { Step { reward, end: Some(End::Goal) } };
            *ended = true;
        }
    }
}
