//! The methods that the game is compared with: each on worlds whose optimum is known, in a finite one and in a Gaussian
//! one, and what is published of it.

use cvar_game::experiment::config::{Config, Source};
use cvar_game::experiment::registry::standard;
use cvar_game::game::budget::Eta;
use cvar_game::game::returns::ReturnLaw;
use cvar_game::learn::device::Device;
use cvar_game::learn::method::{Arena, Method, Setting};
use cvar_game::learn::methods::{Augmented, CvarPg, Neutral, Rarl, ReturnCapping};
use cvar_game::learn::options::{PlaneLaw, TrainOptions};
use cvar_game::learn::play::{Play, play};
use cvar_game::learn::policy::{Draw, Mode, Nominal};
use fork::fork;
use lava_envs::{FiniteModel, World, conformance};
use stake::{Constants, Stake};
use statrs::distribution::{Continuous, ContinuousCDF, Normal};

#[path = "support/fork.rs"]
mod fork;
#[path = "support/stake.rs"]
mod stake;

fn options() -> TrainOptions {
    let config = Config::resolve(standard().catalogue(), Source::Default, &[]).unwrap();
    let mut options = config.world("lava-grid").train.clone();
    (options.parallel_episodes, options.rollout_steps, options.steps) = (250, 4, 150_000);
    (options.budget_wait, options.budget_rise) = (0.1, 0.3);
    (options.policy, options.initial_std) = (PlaneLaw::Gaussian, 0.5);
    for player in [&mut options.protagonist, &mut options.antagonist] {
        (player.hidden, player.minibatch, player.time_aware) = (16, 250, true);
        player.entropy_final = 0.0;
    }
    options
}

/// Trains and plays the greedy protagonist under nominal chance.
fn trained<M: Method, W: Arena>(
    world: impl Fn(usize) -> W,
    options: &TrainOptions,
    (eta, seed): (f64, u64),
    own: &str,
) -> ReturnLaw {
    let own: toml::Table = if own.is_empty() { M::DEFAULTS } else { own }.parse().unwrap();
    let eta = Eta::new(eta).unwrap();
    M::check::<W>(options, &own).unwrap();
    let setting = Setting { eta, gamma: 1.0, seed, device: Device::Cpu, options, own: &own };
    let mut training = M::begin(world(options.parallel_episodes), &setting);
    while training.update().unwrap().is_some() {}
    // What is read from a file plays as well.
    let mut players = M::players(&world(1), &setting);
    players.load(&training.players().weights(String::new()).unwrap()).unwrap();
    assert!(players.opponent().is_none());
    let (mode, draw, episodes) = (Mode::Greedy, Draw::Nominal, 200_000);
    let of = Play { mode, draw, eta, gamma: 1.0, episodes, seed: 1 };
    play(world(1_000), players.protagonist().as_mut(), &mut Nominal, &of, &mut ()).law()
}

/// Passing has mean 0.25 and CVaR_0.5 0, gambling 0.375 and -0.25.
const PASSES: f64 = 0.0;
const GAMBLES: f64 = -0.25;

#[track_caller]
fn check_fork<M: Method>(own: &str, expected: f64) {
    for seed in 1..=3 {
        let cvar =
            trained::<M, _>(|slots| fork(0.5, slots), &options(), (2.0, seed), own).cvar(0.5);
        assert!((cvar - expected).abs() < 0.01, "{}, seed {seed}: {cvar}, not {expected}", M::NAME);
    }
}

#[test]
fn every_method_finds_its_optimum_of_the_fork() {
    check_fork::<Neutral>("", GAMBLES);
    check_fork::<CvarPg>("", PASSES);
    check_fork::<ReturnCapping>("", PASSES);
    check_fork::<Augmented>("", PASSES);
    // Bounded in every step by 1.1, chance leaves the gamble 1.5 * 0.45 - 0.55 > 0; by 2, nothing but -1.
    check_fork::<Rarl>("strength = 1.1", GAMBLES);
    check_fork::<Rarl>("strength = 2.0", PASSES);
}

/// Mean of the worst alpha of a standard normal, negated: `pdf(quantile) / alpha`.
fn expected_shortfall(alpha: f64) -> f64 {
    let normal = Normal::standard();
    normal.pdf(normal.inverse_cdf(alpha)) / alpha
}

const GAIN: Constants = Constants { mean: 0.8, deviation: 0.25 };

/// Checks what a method that is asked for this budget attains at the level that it aims at.
#[track_caller]
fn check_stake<M: Method>(eta: f64, own: &str, level: f64) {
    let shortfall = if level == 1.0 { 0.0 } else { expected_shortfall(level) };
    let best_stake = GAIN.mean - GAIN.deviation * shortfall;
    let best = 0.5 * best_stake * best_stake;
    let world = |slots| Stake::new(&GAIN, slots).unwrap();
    let cvar = trained::<M, _>(world, &options(), (eta, 1), own).cvar(level);
    assert!((cvar - best).abs() < 0.003, "{} at {eta}: {cvar}, not {best}", M::NAME);
}

#[test]
fn every_method_finds_its_optimum_of_the_gaussian_stake() {
    for eta in [5.0, 25.0] {
        let alpha = 1.0 / eta;
        check_stake::<Neutral>(eta, "", 1.0);
        check_stake::<CvarPg>(eta, "", alpha);
        check_stake::<ReturnCapping>(eta, "", alpha);
        check_stake::<Augmented>(eta, "", alpha);
        // In one step a bound of the step is a budget.
        check_stake::<Rarl>(eta, &format!("strength = {eta:.1}"), alpha);
        check_stake::<Rarl>(eta, "strength = 1.0", 1.0);
    }
}

#[test]
fn the_worlds_of_these_tests_are_worlds() {
    conformance::check::<Stake>(&GAIN);
    let mut world = fork(0.5, 1);
    world.place(0, 1, 1);
    assert_eq!(world.time(0), 1);
}
