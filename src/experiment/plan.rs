//! The plan: which runs a configuration means, and in which order.

use super::config::Config;
use super::names::RunId;

/// The runs of a sweep: by world, then by eta, then by seed, each in the order of the configuration.
pub fn runs(config: &Config) -> Vec<RunId> {
    let experiment = &config.experiment;
    let mut runs = Vec::new();
    for &env in &experiment.envs {
        for &eta in &experiment.etas {
            runs.extend(experiment.seeds.iter().map(|&seed| RunId { env, eta, seed }));
        }
    }
    runs
}
