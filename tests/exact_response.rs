//! The best response to a fixed antagonist, against enumeration of all policies that see whole histories,
//! and against what is known without it.

use cvar_game::exact::antagonist::WorstCase;
use cvar_game::exact::chow::Chow;
use cvar_game::exact::finite::ExactWorld;
use cvar_game::exact::mdp::{FiniteMdp, Node, Outcome, State};
use cvar_game::exact::optimum::optimum;
use cvar_game::exact::policy::Policy;
use cvar_game::exact::response::{Frozen, HEADROOM, Response, best_response};
use cvar_game::experiment::config::{Config, RunConfig, Setting, Source};
use cvar_game::experiment::frozen::FrozenOpponent;
use cvar_game::experiment::plan;
use cvar_game::experiment::registry::standard;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::learn::method::Players;
use cvar_game::learn::pair::Pair;
use cvar_game::learn::play::{Play, play};
use cvar_game::learn::policy::{Draw, Mode, Response as Answer, Situation, Streams};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{End, GridConfig, LavaGrid, Move, World};
use rand::{RngExt, SeedableRng};

/// An antagonist that is a function of time, state, action and remaining budget.
struct Written<F> {
    sees_time: bool,
    ratios: F,
}

impl<F: Fn(u32, usize, usize, f64) -> Vec<f64>> Frozen for Written<F> {
    fn sees_time(&self) -> bool {
        self.sees_time
    }

    fn ratios(&mut self, t: u32, s: usize, a: usize, budgets: &[f64], all: &mut Vec<f64>) -> bool {
        all.extend(budgets.iter().flat_map(|&budget| (self.ratios)(t, s, a, budget)));
        true
    }
}

/// delta^0 proportional to `weights`, mixed with 1 so that it is at most the budget.
fn admissible(probabilities: &[f64], weights: &[f64], budget: f64) -> Vec<f64> {
    let mean: f64 = probabilities.iter().zip(weights).map(|(p, w)| p * w).sum();
    let possible = probabilities.iter().zip(weights).filter(|(p, _)| **p > 0.0);
    let largest = possible.map(|(_, w)| w / mean).fold(1.0, f64::max);
    let own = if largest > budget { (budget - 1.0) / (largest - 1.0) } else { 1.0 };
    weights.iter().map(|w| 1.0 - own + own * w / mean).collect()
}

/// An MDP with two actions and three outcomes in each state, and an antagonist's tastes.
struct Case {
    states: Vec<State>,
    gamma: f64,
    horizon: usize,
    /// By state, action and outcome.
    tastes: Vec<[f64; 3]>,
}

impl Case {
    fn random(seed: u64) -> Case {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut states: Vec<State> = (0..3)
            .map(|_| {
                let mut action = || -> Vec<Outcome> {
                    let raw: [f64; 3] = std::array::from_fn(|_| random.random_range(0.05..1.0));
                    let sum: f64 = raw.iter().sum();
                    let outcome = |p: f64| Outcome {
                        probability: p / sum,
                        reward: random.random_range(-1.0..1.0),
                        next: random.random_range(0..5),
                    };
                    raw.map(outcome).to_vec()
                };
                State::Running(vec![action(), action()])
            })
            .collect();
        states.extend([State::Ended(End::Goal), State::Ended(End::Lava)]);
        let tastes = (0..6).map(|_| std::array::from_fn(|_| random.random_range(-1.5..1.5)));
        Case { states, gamma: [1.0, 0.9][seed as usize % 2], horizon: 3, tastes: tastes.collect() }
    }

    fn outcomes(&self, state: usize, action: usize) -> Option<&[Outcome]> {
        match &self.states[state] {
            State::Running(actions) => Some(&actions[action]),
            State::Ended(_) => None,
        }
    }

    /// delta_t(o), which depends on the time and the budget.
    fn ratios(&self, time: u32, state: usize, action: usize, budget: f64) -> Vec<f64> {
        let outcomes = self.outcomes(state, action).unwrap();
        let probabilities: Vec<f64> = outcomes.iter().map(|of| of.probability).collect();
        let sharp = (0.5 + f64::from(time)) * (1.0 + 0.3 * budget.ln());
        let weights = self.tastes[2 * state + action].map(|taste| (sharp * taste).exp());
        admissible(&probabilities, &weights, budget)
    }

    /// The mean return of a policy that chooses by the outcomes so far: bit n of `policy` is the action after
    /// the n-th history.
    fn mean(&self, policy: u32, eta: f64) -> f64 {
        self.mean_from(policy, (0, 0), 0, eta)
    }

    fn mean_from(&self, policy: u32, place: (u32, u32), state: usize, budget: f64) -> f64 {
        let (time, history) = place;
        if time as usize == self.horizon {
            return 0.0;
        }
        // Histories of length t are numbered after all shorter ones.
        let number = (3_u32.pow(time) - 1) / 2 + history;
        let action = (policy >> number & 1) as usize;
        let Some(outcomes) = self.outcomes(state, action) else { return 0.0 };
        let ratios = self.ratios(time, state, action, budget);
        let gain = |(index, of): (usize, &Outcome)| {
            let place = (time + 1, 3 * history + index as u32);
            let after = self.mean_from(policy, place, of.next, budget / ratios[index]);
            of.probability * ratios[index] * (of.reward + self.gamma * after)
        };
        outcomes.iter().enumerate().map(gain).sum()
    }
}

fn respond(mdp: &FiniteMdp, eta: f64, antagonist: &mut dyn Frozen) -> Response {
    best_response(mdp, eta, antagonist).unwrap().unwrap()
}

/// All 2^13 policies that choose by the whole history.
#[test]
fn the_best_response_is_the_best_of_all_policies() {
    for seed in 0..6 {
        let case = Case::random(seed);
        let mdp = FiniteMdp::new(&case.states, 0, case.horizon, case.gamma).unwrap();
        assert!(!mdp.one_level(), "the accumulated reward varies");
        for eta in [1.0, 1.5, 20.0] {
            let means = (0..1 << 13).map(|policy| case.mean(policy, eta));
            let best = means.fold(f64::NEG_INFINITY, f64::max);
            let ratios = |t, s, a, budget| case.ratios(t, s, a, budget);
            let found = respond(&mdp, eta, &mut Written { sees_time: true, ratios });
            let off = (found.value - best).abs();
            assert!(off < 1e-4, "seed {seed}, eta {eta}: {} and not {best}", found.value);
            let claimed = found.error + 6.0 / HEADROOM + 1e-12;
            assert!(off <= claimed, "seed {seed}, eta {eta}: off by {off}, claimed {claimed}");
            let least = Chow::solve(&mdp).value(1.0 / eta).unwrap();
            assert!(best >= least - 1e-9, "seed {seed}, eta {eta}: {best} is below {least}");
        }
    }
}

/// The second step has a budget far beyond the grid, in an episode of probability 1e-9 and a world in which
/// everything pays 1.
#[test]
fn a_budget_beyond_the_grid_is_an_upper_bound() {
    let step = |next| {
        let outcome = |reward| Outcome { probability: 0.5, reward, next };
        State::Running(vec![vec![outcome(1.0), outcome(0.0)]])
    };
    let states = [step(1), step(2), State::Ended(End::Goal)];
    let mdp = FiniteMdp::new(&states, 0, 2, 1.0).unwrap();
    let ratios = |_, _, _, budget: f64| {
        // 1e-9 and 2 - 1e-9 within a budget of 2, and as extreme at any larger one.
        admissible(&[0.5; 2], &[1e-9, 2.0 - 1e-9], budget)
    };
    let found = respond(&mdp, 4.0, &mut Written { sees_time: false, ratios });
    // Once 2 - 1e-9 is spent, 2 + 1e-9 are left. Whatever is on the grid pays 5e-10 in each step.
    assert!(found.value >= 1e-9 && found.value <= 1e-9 + 2.0 / HEADROOM, "{}", found.value);
}

#[test]
fn the_best_response_to_nominal_chance_is_risk_neutral() {
    let grid = ExactWorld::<LavaGrid>::new(&GridConfig::default(), 1.0).unwrap();
    let best = optimum(grid.mdp(), 1.0).unwrap().evaluation.law.mean();
    let ratios = |_, _, _, _| vec![1.0; 4];
    for eta in [1.0, 25.0] {
        let found = respond(grid.mdp(), eta, &mut Written { sees_time: false, ratios });
        assert!((found.value - best).abs() < 1e-12 && found.error < 1e-12, "{found:?}");
    }
}

/// The worst case of a policy, made admissible where the protagonist does not follow that policy.
fn worst_case<'a>(
    mdp: &'a FiniteMdp,
    worst: &'a WorstCase<'a>,
) -> Written<impl Fn(u32, usize, usize, f64) -> Vec<f64> + 'a> {
    let ratios = move |time: u32, state: usize, action: usize, budget: f64| {
        let node = Node { time: time as usize, level: 0, state };
        let outcomes = || 0..mdp.outcome_count(state, action);
        let weights: Vec<f64> = outcomes().map(|of| worst.delta(node, action, of)).collect();
        let probabilities: Vec<f64> =
            outcomes().map(|of| mdp.outcome(state, action, of).probability).collect();
        let mean: f64 = probabilities.iter().zip(&weights).map(|(p, w)| p * w).sum();
        if mean > 0.0 { admissible(&probabilities, &weights, budget) } else { vec![1.0; 4] }
    };
    Written { sees_time: true, ratios }
}

/// The mean return and its standard error of a policy over played episodes against a fixed antagonist.
fn played(
    mdp: &FiniteMdp,
    policy: &Policy,
    antagonist: &mut dyn Frozen,
    eta: f64,
    episodes: usize,
) -> (f64, f64) {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut returns = Vec::new();
    for _ in 0..episodes {
        let (mut node, mut budget, mut value) = (Some(mdp.start_node()), eta, 0.0);
        while let Some(Node { time, state, .. }) = node {
            let here = Node { time, level: 0, state };
            let action = policy.action(mdp, here);
            let mut ratios = Vec::new();
            antagonist.ratios(time as u32, state, action, &[budget], &mut ratios);
            let law: Vec<f64> =
                (0..4).map(|of| mdp.outcome(state, action, of).probability * ratios[of]).collect();
            let outcome = lava_envs::law::sample_index(&law, &mut random);
            value += mdp.outcome(state, action, outcome).reward;
            budget = (budget / ratios[outcome]).max(1.0);
            node = mdp.successor(here, action, outcome);
        }
        returns.push(value);
    }
    let mean = returns.iter().sum::<f64>() / episodes as f64;
    let variance = returns.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
    (mean, variance.sqrt() / episodes as f64)
}

/// Against the exact worst case of the optimal policy no response gets less than V*, nor less than any
/// policy that is played against it.
#[test]
fn the_best_response_to_the_worst_case_is_worth_the_optimum_and_more() {
    let eta = 25.0;
    let grid = ExactWorld::<LavaGrid>::new(&GridConfig::default(), 1.0).unwrap();
    let mdp = grid.mdp();
    let best = grid.optimum(eta).unwrap();
    let worst = WorstCase::new(mdp, &best.policy, eta).unwrap();
    let mut antagonist = worst_case(mdp, &worst);
    let found = respond(mdp, eta, &mut antagonist);
    println!("best response {found:?}, V* {}", best.cvar);
    assert!(found.value >= best.cvar - found.error, "{found:?} and V* = {}", best.cvar);
    let least = Chow::solve(mdp).value(1.0 / eta).unwrap();
    assert!(found.value >= least - found.error, "{found:?} and Chow's programme: {least}");
    let neutral = optimum(mdp, 1.0).unwrap().policy;
    for (name, policy) in [("optimal", &best.policy), ("risk-neutral", &neutral)] {
        let (mean, error) = played(mdp, policy, &mut antagonist, eta, 4000);
        println!("{name}: {mean} +- {error}");
        assert!(found.value + found.error >= mean - 4.0 * error, "{name}: {mean} +- {error}");
    }
}

/// The configuration of a run on lava-grid at eta = 25.
fn run(options: &[&str]) -> RunConfig {
    let mut settings: Vec<Setting> =
        options.iter().map(|text| Setting::parse(text).unwrap()).collect();
    settings.push(Setting::option("--eta", "experiment.etas", vec![25.0]));
    settings.push(Setting::option("--env", "experiment.envs", vec!["lava-grid"]));
    let config = Config::resolve(standard().catalogue(), Source::Default, &settings).unwrap();
    config.run(&plan::runs(&config)[0])
}

/// A network that nobody trained: its ratios are those that it plays with, and no policy that is played
/// against it gets more than the best response.
#[test]
fn the_antagonist_of_a_network_answers_with_the_ratios_it_plays_with() {
    let constants = GridConfig { horizon: 30, ..GridConfig::default() };
    let grid = ExactWorld::<LavaGrid>::new(&constants, 1.0).unwrap();
    let optimal = grid.optimum(25.0).unwrap();
    for aware in ["train.antagonist.time_aware=false", "train.antagonist.time_aware=true"] {
        let run = run(&[aware]);
        let mut world = LavaGrid::new(&constants, 30).unwrap();
        let mut pair = Pair::<LavaGrid>::new(&world, &run.setting());
        // Fresh networks hardly do anything.
        let network = pair.antagonist.as_mut().unwrap().network_mut();
        let shape = network.shape();
        network.change(|parameters| {
            for unit in 0..shape.hidden {
                (0..4).for_each(|row| parameters[shape.second_at(row, unit)] *= 200.0);
            }
        });
        let mut opponent = Players::opponent(&pair).unwrap();
        assert_eq!(opponent.sees_time(), aware.ends_with("true"));
        // Thirty cells of the lower rows, at several times and budgets.
        let model = world.finite_mut().unwrap();
        (0..30).for_each(|slot| model.place(slot, 40 + slot, slot as u32));
        let budget = |slot: usize| Budget::remaining(1.0 + slot as f64 * slot as f64).unwrap();
        let budgets: Vec<Budget> = (0..30).map(budget).collect();
        let situation = Situation {
            world: &world,
            actions: &[Move::Right; 30],
            laws: &vec![world.law(0, Move::Right); 30],
            budgets: &budgets,
        };
        let all = opponent.all_ratios(&situation).unwrap();
        let mut streams: Vec<Streams> = (0..30)
            .map(|slot| Streams {
                actions: stream(1, Purpose::EvaluationActions, slot),
                outcomes: stream(1, Purpose::EvaluationOutcomes, slot),
            })
            .collect();
        let (mut outcomes, mut ratios) = (Vec::new(), vec![0.0; 30]);
        let answer = Answer { outcomes: &mut outcomes, ratios: &mut ratios };
        opponent.respond(&situation, Draw::Nominal, &mut streams, answer);
        for slot in 0..30 {
            let asked = all[4 * slot + outcomes[slot]];
            assert!((asked / ratios[slot] - 1.0).abs() < 1e-12, "{asked}, {}", ratios[slot]);
        }
        assert_eq!(all[..4], [1.0; 4], "nothing can be done at budget 1");
        // As the best response asks.
        let mut frozen = FrozenOpponent::new(&constants, opponent.as_mut()).unwrap();
        let mut asked = Vec::new();
        let right = lava_envs::action::Discrete::index(Move::Right);
        for (slot, budget) in budgets.iter().enumerate() {
            let budget = [budget.get()];
            assert!(frozen.ratios(slot as u32, 40 + slot, right, &budget, &mut asked));
        }
        assert_eq!(asked, all);

        let found = respond(grid.mdp(), 25.0, &mut frozen);
        let mut antagonist = frozen;
        let (mean, error) = played(grid.mdp(), &optimal.policy, &mut antagonist, 25.0, 60);
        assert!(found.value + found.error >= mean - 4.0 * error, "{found:?}: {mean} +- {error}");
        assert!(found.value + found.error >= optimal.cvar);
        // Untrained players of the game.
        let playing = Play {
            mode: Mode::Greedy,
            draw: Draw::Perturbed,
            eta: Eta::new(25.0).unwrap(),
            gamma: 1.0,
            episodes: 500,
            seed: 5,
        };
        let mut protagonist = Players::protagonist(&pair);
        let mut opponent = Players::opponent(&pair).unwrap();
        let world = LavaGrid::new(&constants, 100).unwrap();
        let law = play(world, protagonist.as_mut(), opponent.as_mut(), &playing, &mut ()).law();
        assert!(found.value + found.error >= law.mean() - 4.0 * law.mean_standard_error());
        println!("{aware}: {found:?}, optimum played {mean}");
    }
}

/// One that draws its perturbations at random is no fixed antagonist.
#[test]
fn a_random_adversary_has_no_best_response() {
    let constants = GridConfig::default();
    let run = run(&["train.adversary=random"]);
    let world = LavaGrid::new(&constants, 1).unwrap();
    let pair = Pair::<LavaGrid>::new(&world, &run.setting());
    let mut opponent = Players::opponent(&pair).unwrap();
    let mut frozen = FrozenOpponent::new(&constants, opponent.as_mut()).unwrap();
    let grid = ExactWorld::<LavaGrid>::new(&constants, 1.0).unwrap();
    assert_eq!(best_response(grid.mdp(), 25.0, &mut frozen).unwrap(), None);
}
