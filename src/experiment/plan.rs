//! The plan: which runs a configuration means, and in which order.

use super::config::{Config, Variant};
use super::names::{MethodName, RunId, WorldName};
use crate::game::budget::Eta;

/// The runs of a sweep: by variant, world, method, eta and seed, each in the order of the
/// configuration. There is at least one.
pub fn runs(config: &Config) -> Vec<RunId> {
    let experiment = &config.experiment;
    if config.variants.is_empty() {
        let part = (&experiment.envs[..], &experiment.methods[..], &experiment.etas[..]);
        return of_part(None, part, &experiment.seeds);
    }
    let of_variant = |variant: &Variant| {
        let part = (&variant.envs[..], &variant.methods[..], &variant.etas[..]);
        of_part(Some(variant), part, &experiment.seeds)
    };
    config.variants.iter().flat_map(of_variant).collect()
}

/// Every combination of world, method and eta, with every seed.
fn of_part(
    variant: Option<&Variant>,
    (envs, methods, etas): (&[WorldName], &[MethodName], &[Eta]),
    seeds: &[u64],
) -> Vec<RunId> {
    let mut runs = Vec::new();
    for world in envs {
        for method in methods {
            for &eta in etas {
                runs.extend(seeds.iter().map(|&seed| RunId {
                    world: world.clone(),
                    method: method.clone(),
                    variant: variant.map(|variant| variant.name.clone()),
                    eta,
                    seed,
                }));
            }
        }
    }
    runs
}
