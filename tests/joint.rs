//! The game `joint`, in which the antagonist reweights the protagonist's draw as well, against `outcome`: on a
//! world whose equilibria are known, and its budget on many trajectories.

use cvar_game::experiment::config::{Config, Source};
use cvar_game::experiment::registry::standard;
use cvar_game::game::budget::Eta;
use cvar_game::learn::device::Device;
use cvar_game::learn::method::{Arena, Players, Setting, Training};
use cvar_game::learn::methods::game::GameTraining;
use cvar_game::learn::options::{Acts, PlaneLaw, TrainOptions};
use cvar_game::learn::pair::Pair;
use cvar_game::learn::play::{Play, Played, play};
use cvar_game::learn::policy::{Draw, Mode};
use lava_envs::{FiniteModel, GridConfig, LavaGrid, LavaPoint, PointConfig, World, conformance};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::sync::LazyLock;
use support::{Constants, Fork, fork};

#[path = "support/fork.rs"]
mod support;

#[test]
fn the_fork_is_a_world() {
    conformance::check::<Fork>(&Constants { safe: 0.9 });
}

fn options(acts: Acts) -> TrainOptions {
    let config = Config::resolve(standard().catalogue(), Source::Default, &[]).unwrap();
    let mut options =
        TrainOptions { antagonist_acts: acts, ..config.world("lava-grid").train.clone() };
    options.budget_sensitivity = true;
    options.parallel_episodes = 200;
    options.rollout_steps = 4;
    options.steps = 160_000;
    for player in [&mut options.protagonist, &mut options.antagonist] {
        player.hidden = 16;
        player.minibatch = 400;
        player.entropy_final = 0.0;
    }
    if acts == Acts::Joint {
        (options.steps, options.follower_updates) = (240_000, 4);
        (options.protagonist.entropy, options.antagonist.entropy) = (0.05, 0.0);
        options.antagonist.gae_lambda = 1.0;
    }
    options
}

static NO_OPTIONS: LazyLock<toml::Table> = LazyLock::new(toml::Table::new);

fn setting(options: &TrainOptions, eta: f64, seed: u64) -> Setting<'_> {
    let (eta, device) = (Eta::new(eta).unwrap(), Device::Cpu);
    Setting { eta, gamma: 1.0, seed, device, options, own: &NO_OPTIONS }
}

/// P(a2 | s1) of the protagonist.
fn gambles(pair: &Pair<Fork>) -> f64 {
    let mut world = fork(0.9, 1);
    world.place(0, 1, 1);
    Players::protagonist(pair).probabilities(&world).unwrap()[1]
}

fn against<W: Arena>(
    world: W,
    pair: &Pair<W>,
    (mode, draw): (Mode, Draw),
    (eta, episodes): (f64, u64),
) -> Played {
    let setting = Play { mode, draw, eta: Eta::new(eta).unwrap(), gamma: 1.0, episodes, seed: 1 };
    let (mut protagonist, mut opponent) =
        (Players::protagonist(pair), Players::opponent(pair).unwrap());
    play(world, protagonist.as_mut(), opponent.as_mut(), &setting, &mut ())
}

/// Large random weights for both halves of the antagonist.
fn shaken<W: Arena>(world: &W, options: &TrainOptions, eta: f64, strength: f32) -> Pair<W> {
    let mut pair = Pair::new(world, &setting(options, eta, 3));
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let networks = [
        pair.antagonist.as_mut().unwrap().network_mut(),
        pair.action_antagonist.as_mut().unwrap().network_mut(),
    ];
    for network in networks {
        network.change(|weights| {
            for weight in weights {
                *weight = strength * (*weight + random.random_range(-0.1f32..0.1));
            }
        });
    }
    pair
}

/// On every trajectory prod delta <= eta, E[delta] = 1 in every half step, and nominal episodes weighted by
/// prod delta have the mean of the antagonist's own episodes.
fn check_budget<W: Arena>(world: impl Fn() -> W, change: impl Fn(&mut TrainOptions)) {
    let mut options = options(Acts::Joint);
    change(&mut options);
    for (eta, strength) in [(1.5, 1.0), (3.0, 6.0), (25.0, 1.0), (100.0, 40.0)] {
        let pair = shaken(&world(), &options, eta, strength);
        let of = |draw| {
            let played = against(world(), &pair, (Mode::Sampled, draw), (eta, 2_000));
            assert!(played.normalisation_error <= 1e-6, "{}", played.normalisation_error);
            for episode in &played.episodes {
                let used = episode.likelihood_ratio / eta;
                assert!(used <= 1.0 + 1e-6, "prod delta / eta = {used} at strength {strength}");
            }
            let weight = |ratio: f64| if draw == Draw::Nominal { ratio } else { 1.0 };
            let values: Vec<f64> = (played.episodes.iter())
                .map(|episode| weight(episode.likelihood_ratio) * episode.atom.value)
                .collect();
            let count = values.len() as f64;
            let mean = values.iter().sum::<f64>() / count;
            (mean, values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count / count)
        };
        let [(weighted, weighted_variance), (direct, direct_variance)] =
            [Draw::Nominal, Draw::Perturbed].map(of);
        let error = (weighted_variance + direct_variance).sqrt();
        // Of few nominal episodes that weigh as much as eta the variance is not known.
        if eta < 10.0 {
            let off = (weighted - direct).abs();
            assert!(off < 4.0 * error, "{weighted} against {direct}, error {error}");
        }
        // A greedy protagonist draws nothing.
        let greedy = against(world(), &pair, (Mode::Greedy, Draw::Perturbed), (eta, 200));
        assert!(greedy.episodes.iter().all(|e| e.likelihood_ratio <= eta * (1.0 + 1e-6)));
    }
}

#[test]
fn no_antagonist_breaks_the_budget_with_its_two_halves() {
    check_budget(|| LavaGrid::new(&GridConfig::default(), 250).unwrap(), |_| {});
    for policy in [PlaneLaw::Gaussian, PlaneLaw::Disc] {
        let world = || LavaPoint::new(&PointConfig::default(), 250).unwrap();
        check_budget(world, |options| options.policy = policy);
    }
}

/// Under nominal chance the draws are those of the policy itself, bit for bit.
#[test]
fn an_antagonist_that_only_reports_changes_no_episode() {
    let world = || LavaGrid::new(&GridConfig::default(), 50).unwrap();
    let of = |acts| {
        let pair = Pair::new(&world(), &setting(&options(acts), 25.0, 3));
        let played = against(world(), &pair, (Mode::Sampled, Draw::Nominal), (25.0, 200));
        played.episodes.iter().map(|e| (e.atom.value, e.atom.steps)).collect::<Vec<_>>()
    };
    assert_eq!(of(Acts::Outcome), of(Acts::Joint));
}

/// Training with a break after every update ends with the same bits as without, and weights survive
/// their file.
#[test]
fn breaks_change_nothing() {
    let mut options = options(Acts::Joint);
    options.steps = 8 * options.rollout();
    (options.budget_wait, options.budget_rise, options.response) = (0.1, 0.3, 0.2);
    let setting = setting(&options, 4.0, 1);
    let mut whole = GameTraining::new(fork(0.9, options.parallel_episodes), &setting);
    let mut state = Training::state(&whole);
    loop {
        let mut broken = GameTraining::new(fork(0.9, options.parallel_episodes), &setting);
        Training::restore(&mut broken, &state).unwrap();
        let (expected, found) = (whole.update().unwrap(), broken.update().unwrap());
        assert_eq!(format!("{expected:?}"), format!("{found:?}"));
        state = Training::state(&broken);
        assert!(state == Training::state(&whole));
        if found.is_none() {
            break;
        }
    }
    let bytes = whole.pair.weights(String::new()).unwrap();
    let mut other = Pair::new(&fork(0.9, 1), &Setting { seed: 9, ..setting.clone() });
    other.load(&bytes).unwrap();
    let parameters = |pair: &Pair<Fork>| -> Vec<f32> {
        pair.action_antagonist.as_ref().unwrap().network().parameters().to_vec()
    };
    assert_eq!(parameters(&whole.pair), parameters(&other));
    // A pair of the game `outcome` has no such half, and its file no such tensors.
    let outcome = TrainOptions { antagonist_acts: Acts::Outcome, ..options.clone() };
    let alone = Pair::new(&fork(0.9, 1), &Setting { options: &outcome, ..setting.clone() });
    let error = other.load(&alone.weights(String::new()).unwrap()).unwrap_err().to_string();
    assert!(error.contains("action-antagonist.actor.hidden.weight"), "{error}");
}

/// Enough training to settle. The protagonist's updates are small, so that the antagonist keeps up with it, and
/// its bonus is large enough that it does not settle on an action for good before that.
fn patient() -> TrainOptions {
    let mut options = options(Acts::Joint);
    (options.steps, options.parallel_episodes) = (2_000_000, 100);
    (options.protagonist.entropy, options.protagonist.learning_rate) = (0.05, 0.002);
    options
}

/// Trains a pair on the fork at eta = 2; P(a2) after 40 % of the run and at its end, and the value of the
/// game for the sampled protagonist.
fn trained(options: &TrainOptions, seed: u64) -> [f64; 3] {
    let setting = setting(options, 2.0, seed);
    let mut training = GameTraining::new(fork(0.9, options.parallel_episodes), &setting);
    let mut early = f64::NAN;
    while training.update().unwrap().is_some() {
        if training.updates() == options.updates() * 2 / 5 {
            early = gambles(&training.pair);
        }
    }
    let pair = &training.pair;
    let played = against(fork(0.9, 500), pair, (Mode::Sampled, Draw::Perturbed), (2.0, 20_000));
    [early, gambles(pair), played.law().mean()]
}

fn mean_of_seeds(acts: Acts, seeds: u64) -> [f64; 3] {
    let mut mean = [0.0; 3];
    for seed in 1..=seeds {
        for (mean, of) in mean.iter_mut().zip(trained(&options(acts), seed)) {
            *mean += of / seeds as f64;
        }
    }
    mean
}

/// With P(a2) = 0.6 and delta(s1) = 5/3 neither player gains by deviating, and the value is 0.15, though the
/// CVaR_0.5 of the sampled policy is -0.03.
#[test]
fn the_game_outcome_settles_where_no_policy_is_optimal() {
    let [_, gamble, value] = mean_of_seeds(Acts::Outcome, 6);
    assert!((gamble - 0.6).abs() < 0.15, "P(a2) = {gamble}");
    assert!((value - 0.15).abs() < 0.06, "value {value}");
}

/// The value of the game is the CVaR_0.5 of the sampled policy, -0.05 P(a2), and the protagonist moves
/// towards the optimal policy, P(a2) = 0.
#[test]
fn the_value_of_the_game_joint_is_the_cvar_of_the_sampled_policy() {
    let [early, gamble, value] = mean_of_seeds(Acts::Joint, 6);
    let gap = value + 0.05 * gamble;
    assert!((-0.005..0.04).contains(&gap), "value {value}, P(a2) = {gamble}");
    assert!(gamble < early - 0.03, "P(a2) goes from {early} to {gamble}");
}

/// With patience both the greedy and the sampled protagonist come within 0.02 of the optimal CVaR, 0. The
/// settings were chosen on seeds 1 to 20, and on 101 to 104, of which one failed with a bonus of 0.01.
#[test]
#[ignore = "a minute with --release, three without: ten runs of two million steps"]
fn the_game_joint_ends_at_the_optimal_policy() {
    for seed in 201..=210 {
        let [_, gamble, value] = trained(&patient(), seed);
        println!("seed {seed}: P(a2) {gamble:.3}, CVaR {:.3}, value {value:.3}", -0.05 * gamble);
        assert!(gamble < 0.5, "seed {seed}: greedily it gambles, P(a2) = {gamble}");
        assert!(0.05 * gamble < 0.02, "seed {seed}: P(a2) = {gamble}");
    }
}
