//! The exact solvers against enumeration, on random MDPs of a few states and steps.
//!
//! The enumerations below work on the raw lists of states and share no code with the solvers: they
//! branch over whole histories, so they also show that the accumulated reward is memory enough.

use cvar_game::exact::ExactError;
use cvar_game::exact::antagonist::WorstCase;
use cvar_game::exact::chow::Chow;
use cvar_game::exact::law::{evaluate, evaluate_under};
use cvar_game::exact::mdp::{FiniteMdp, Node, Outcome, State};
use cvar_game::exact::optimum::optimum;
use cvar_game::exact::policy::Policy;
use cvar_game::exact::stationary;
use lava_envs::End;
use lava_envs::random::ChaCha8Rng;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};

/// A random MDP in raw form. Rewards and probabilities come from short lists, so that equal returns,
/// equal actions and atoms at the quantile are frequent.
#[derive(Debug, Clone)]
struct Raw {
    states: Vec<State>,
    horizon: usize,
    gamma: f64,
}

impl Raw {
    fn mdp(&self) -> FiniteMdp {
        FiniteMdp::new(&self.states, 0, self.horizon, self.gamma).expect("a valid MDP")
    }
}

const ENDED: [End; 2] = [End::Goal, End::Lava];

fn outcomes(running: usize, most: usize) -> impl Strategy<Value = Vec<Outcome>> {
    let reward =
        prop_oneof![proptest::sample::select(vec![-1.0, -0.5, 0.0, 0.5, 1.0, -0.035]), -1.0..1.0];
    let outcome = (0..4_u32, reward, 0..running + ENDED.len());
    proptest::collection::vec(outcome, 1..=most).prop_map(|raw| {
        let total: u32 = raw.iter().map(|(weight, ..)| weight).sum();
        let count = raw.len() as f64;
        raw.into_iter()
            .map(|(weight, reward, next)| Outcome {
                // Some outcomes of probability zero are wanted.
                probability: if total == 0 {
                    1.0 / count
                } else {
                    f64::from(weight) / f64::from(total)
                },
                reward,
                next,
            })
            .collect()
    })
}

fn raw(most_outcomes: usize, most_steps: usize) -> impl Strategy<Value = Raw> {
    (1..=3_usize).prop_flat_map(move |running| {
        let actions = proptest::collection::vec(outcomes(running, most_outcomes), 1..=2);
        (
            proptest::collection::vec(actions, running),
            1..=most_steps,
            proptest::sample::select(vec![1.0, 0.9, 0.5]),
        )
            .prop_map(|(running, horizon, gamma)| {
                let mut states: Vec<State> = running.into_iter().map(State::Running).collect();
                states.extend(ENDED.map(State::Ended));
                Raw { states, horizon, gamma }
            })
    })
}

fn alpha() -> impl Strategy<Value = f64> {
    prop_oneof![
        proptest::sample::select(vec![1.0, 0.5, 0.25, 1.0 / 3.0, 2.0 / 3.0, 0.1, 0.01]),
        0.001..1.0
    ]
}

type Law = Vec<(f64, f64)>;

fn sorted_cvar(mut law: Law, alpha: f64) -> f64 {
    law.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut rest, mut tail) = (alpha, 0.0);
    for (value, mass) in law {
        let share = mass.min(rest);
        tail += share * value;
        rest -= share;
    }
    tail / (alpha - rest)
}

/// The laws of J of all deterministic policies that see the whole history.
fn attainable_laws(raw: &Raw, state: usize, time: usize, so_far: f64, discount: f64) -> Vec<Law> {
    let State::Running(actions) = &raw.states[state] else { return vec![vec![(so_far, 1.0)]] };
    if time == raw.horizon {
        return vec![vec![(so_far, 1.0)]];
    }
    let mut all = Vec::new();
    for outcomes in actions {
        let mut partial: Vec<Law> = vec![vec![]];
        for outcome in outcomes.iter().filter(|o| o.probability > 0.0) {
            let value = so_far + discount * outcome.reward;
            let after = attainable_laws(raw, outcome.next, time + 1, value, discount * raw.gamma);
            partial = partial
                .iter()
                .flat_map(|law| {
                    after.iter().map(move |more| {
                        let more = more.iter().map(|(v, mass)| (*v, mass * outcome.probability));
                        law.iter().copied().chain(more).collect()
                    })
                })
                .collect();
        }
        all.extend(partial);
    }
    all
}

/// y V(y) of Chow's programme by its definition: minimum over the split of the risk level by ternary
/// search (the objective is convex), maximum over actions. Two outcomes per action at most.
fn chow_by_definition(
    raw: &Raw,
    state: usize,
    time: usize,
    so_far: f64,
    discount: f64,
    y: f64,
) -> f64 {
    let State::Running(actions) = &raw.states[state] else { return y * so_far };
    if time == raw.horizon {
        return y * so_far;
    }
    let after = |outcome: &Outcome, z: f64| {
        let value = so_far + discount * outcome.reward;
        chow_by_definition(raw, outcome.next, time + 1, value, discount * raw.gamma, z)
    };
    actions
        .iter()
        .map(|outcomes| {
            let possible: Vec<&Outcome> = outcomes.iter().filter(|o| o.probability > 0.0).collect();
            match possible[..] {
                [only] => after(only, y),
                [first, second] => {
                    let (p, q) = (first.probability, second.probability);
                    let objective = |z: f64| {
                        let other = ((y - p * z) / q).clamp(0.0, 1.0);
                        p * after(first, z) + q * after(second, other)
                    };
                    let (mut low, mut high) = (((y - q) / p).max(0.0), (y / p).min(1.0));
                    for _ in 0..60 {
                        let third = (high - low) / 3.0;
                        if objective(low + third) <= objective(high - third) {
                            high -= third;
                        } else {
                            low += third;
                        }
                    }
                    objective(0.5 * (low + high))
                }
                _ => unreachable!("two outcomes at most"),
            }
        })
        .fold(f64::NEG_INFINITY, f64::max)
}

fn random_choice(mdp: &FiniteMdp, seed: u64) -> Policy {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    Policy::augmented_choice(mdp, |node| random.random_range(0..mdp.actions(node.state)))
}

/// One whole trajectory under a policy: its return, nominal probability and product of delta.
struct Trajectory {
    value: f64,
    probability: f64,
    ratio: f64,
}

/// All trajectories of positive probability; `delta` also sees every node before it acts there.
fn trajectories(
    mdp: &FiniteMdp,
    policy: &Policy,
    delta: &mut impl FnMut(Node, usize, usize) -> f64,
) -> Vec<Trajectory> {
    fn walk(
        mdp: &FiniteMdp,
        policy: &Policy,
        delta: &mut impl FnMut(Node, usize, usize) -> f64,
        node: Node,
        (probability, ratio): (f64, f64),
        all: &mut Vec<Trajectory>,
    ) {
        for action in 0..mdp.actions(node.state) {
            let chosen = policy.row(mdp, node)[action];
            for outcome in 0..mdp.outcome_count(node.state, action) {
                let probability =
                    probability * chosen * mdp.outcome(node.state, action, outcome).probability;
                if probability == 0.0 {
                    continue;
                }
                let ratio = ratio * delta(node, action, outcome);
                match mdp.successor(node, action, outcome) {
                    Some(next) => walk(mdp, policy, delta, next, (probability, ratio), all),
                    None => {
                        let (_, value) = mdp.ending(node, action, outcome).expect("an end");
                        all.push(Trajectory { value, probability, ratio });
                    }
                }
            }
        }
    }
    let mut all = Vec::new();
    walk(mdp, policy, delta, mdp.start_node(), (1.0, 1.0), &mut all);
    all
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn the_optimum_equals_the_enumeration_of_all_policies(raw in raw(3, 3), alpha in alpha()) {
        let best = attainable_laws(&raw, 0, 0, 0.0, 1.0)
            .into_iter()
            .map(|law| sorted_cvar(law, alpha))
            .fold(f64::NEG_INFINITY, f64::max);
        let mdp = raw.mdp();
        let solved = optimum(&mdp, alpha).unwrap();
        prop_assert!((solved.cvar - best).abs() <= 1e-12, "{} != {best}", solved.cvar);
        let found = stationary::search(&mdp, alpha, &solved.policy).unwrap();
        prop_assert!(found.cvar <= best + 1e-12);
        prop_assert!(found.local_optimum);
    }

    #[test]
    fn chows_programme_is_never_below_the_optimum(
        raw in raw(4, 4),
        alpha in alpha(),
    ) {
        let mdp = raw.mdp();
        let chow = Chow::solve(&mdp);
        let best = optimum(&mdp, alpha).unwrap().cvar;
        prop_assert!(chow.value(alpha).unwrap() >= best - 1e-12);
        // With no risk aversion there is no budget to see.
        let mean = optimum(&mdp, 1.0).unwrap().cvar;
        prop_assert!((chow.value(1.0).unwrap() - mean).abs() <= 1e-12);
    }

    #[test]
    fn the_law_equals_the_enumeration_of_trajectories(raw in raw(3, 4), seed: u64) {
        let mdp = raw.mdp();
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut fill = |row: &mut [f64]| {
            row.iter_mut().for_each(|p| *p = f64::from(random.random_range(1..4)));
            let total: f64 = row.iter().sum();
            row.iter_mut().for_each(|p| *p /= total);
        };
        let policies = [
            Policy::stationary(&mdp, |_, row| fill(row)).unwrap(),
            Policy::timed(&mdp, |_, _, row| fill(row)).unwrap(),
            Policy::augmented(&mdp, |_, row| fill(row)).unwrap(),
        ];
        for policy in policies {
            let all = trajectories(&mdp, &policy, &mut |_, _, _| 1.0);
            let law = evaluate(&mdp, &policy).law;
            let mean: f64 = all.iter().map(|t| t.probability * t.value).sum();
            prop_assert!((law.mean() - mean).abs() <= 1e-12);
            for alpha in [1.0, 0.5, 0.1] {
                let pairs = all.iter().map(|t| (t.value, t.probability)).collect();
                prop_assert!((law.cvar(alpha) - sorted_cvar(pairs, alpha)).abs() <= 1e-12);
            }
            let mass: f64 = law.atoms().iter().map(|atom| atom.mass).sum();
            prop_assert!((mass - 1.0).abs() <= 1e-12);
        }
    }

    #[test]
    fn the_worst_case_antagonist_attains_the_cvar_within_its_budget(
        raw in raw(3, 4),
        seed: u64,
        eta in prop_oneof![
            proptest::sample::select(vec![1.0, 1.5, 2.0, 3.0, 4.0, 9.0, 25.0, 100.0]),
            1.0..50.0
        ],
    ) {
        let mdp = raw.mdp();
        let policy = random_choice(&mdp, seed);
        let cvar = evaluate(&mdp, &policy).law.cvar(1.0 / eta);
        let antagonist = WorstCase::new(&mdp, &policy, eta).unwrap();
        prop_assert!((antagonist.value() - cvar).abs() <= 1e-12);
        prop_assert!((evaluate_under(&mdp, &policy, &antagonist).law.mean() - cvar).abs() <= 1e-10);

        let mut worst = Ok(());
        let all = trajectories(&mdp, &policy, &mut |node, action, outcome| {
            let mean: f64 = (0..mdp.outcome_count(node.state, action))
                .map(|o| {
                    let probability = mdp.outcome(node.state, action, o).probability;
                    probability * antagonist.delta(node, action, o)
                })
                .sum();
            let delta = antagonist.delta(node, action, outcome);
            if (mean - 1.0).abs() > 1e-12 {
                worst = Err(format!("E[delta] = {mean} at {node:?}"));
            }
            // Where h = 0 the antagonist never comes.
            if antagonist.tail_probability(node) > 0.0
                && delta > antagonist.remaining_budget(node) * (1.0 + 1e-12)
            {
                worst = Err(format!("delta = {delta} at {node:?}"));
            }
            delta
        });
        prop_assert_eq!(worst, Ok(()));
        for trajectory in &all {
            prop_assert!(trajectory.ratio <= eta * (1.0 + 1e-12), "ratio {}", trajectory.ratio);
        }
        let value: f64 = all.iter().map(|t| t.probability * t.ratio * t.value).sum();
        prop_assert!((value - cvar).abs() <= 1e-10);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn chows_programme_equals_its_definition(raw in raw(2, 2), alpha in alpha()) {
        let defined = chow_by_definition(&raw, 0, 0, 0.0, 1.0, alpha) / alpha;
        let solved = Chow::solve(&raw.mdp()).value(alpha).unwrap();
        prop_assert!((solved - defined).abs() <= 1e-8, "{solved} != {defined}");
    }
}

/// The counterexample of Hau, Delage, Ghavamzadeh & Petrik (NeurIPS 2023) in the form of this
/// benchmark, at alpha = 1/2.
fn counterexample() -> FiniteMdp {
    let go = |probability, reward, next| Outcome { probability, reward, next };
    let states = [
        State::Running(vec![vec![go(0.5, 0.0, 1), go(0.5, 0.0, 2)]]),
        State::Running(vec![vec![go(1.0, 0.0, 3)], vec![go(0.5, -1.0, 3), go(0.5, 1.5, 3)]]),
        State::Running(vec![vec![go(1.0, 0.5, 3)]]),
        State::Ended(End::Goal),
    ];
    FiniteMdp::new(&states, 0, 2, 1.0).expect("a valid MDP")
}

#[test]
fn on_the_counterexample_the_optimum_is_0_and_chow_reports_one_twelfth() {
    let mdp = counterexample();
    assert_eq!(optimum(&mdp, 0.5).unwrap().cvar, 0.0);
    let chow = Chow::solve(&mdp).value(0.5).unwrap();
    approx::assert_abs_diff_eq!(chow, 1.0 / 12.0, epsilon = 1e-15);
    let risky = Policy::stationary_choice(&mdp, |state| usize::from(state == 1));
    approx::assert_abs_diff_eq!(evaluate(&mdp, &risky).law.cvar(0.5), -0.25, epsilon = 1e-15);
}

#[test]
fn an_antagonist_of_a_stochastic_policy_is_refused() {
    let mdp = counterexample();
    let policy = Policy::stationary(&mdp, |_, row| {
        let actions = row.len() as f64;
        row.fill(1.0 / actions);
    });
    let refused = WorstCase::new(&mdp, &policy.unwrap(), 2.0);
    assert_eq!(refused.err(), Some(ExactError::Stochastic));
}

#[test]
fn where_the_return_exceeds_the_threshold_anyway_the_optimal_policy_still_earns_more() {
    // With probability 1/2 the episode pays -1, whatever is done; else it may pay 0 or 1. CVaR at
    // 1/2 is -1 in any case, and the shortfall alone would be indifferent.
    let go = |probability, reward, next| Outcome { probability, reward, next };
    let states = [
        State::Running(vec![vec![go(0.5, -1.0, 2), go(0.5, 0.0, 1)]]),
        State::Running(vec![vec![go(1.0, 0.0, 2)], vec![go(1.0, 1.0, 2)]]),
        State::Ended(End::Goal),
    ];
    let mdp = FiniteMdp::new(&states, 0, 3, 1.0).unwrap();
    let best = optimum(&mdp, 0.5).unwrap();
    assert_eq!(best.cvar, -1.0);
    assert_eq!(best.evaluation.law.mean(), 0.0);
}

#[test]
fn senseless_mdps_and_risk_levels_are_refused() {
    let go = |probability, next| Outcome { probability, reward: 0.0, next };
    let ended = State::Ended(End::Goal);
    let state = |outcomes| State::Running(vec![outcomes]);
    let refused = |states: &[State], start, horizon, gamma| {
        matches!(FiniteMdp::new(states, start, horizon, gamma), Err(ExactError::Mdp(_)))
    };
    let sound = [state(vec![go(1.0, 1)]), ended.clone()];
    assert!(!refused(&sound, 0, 1, 1.0));
    assert!(refused(&sound, 1, 1, 1.0), "the start has ended");
    assert!(refused(&sound, 2, 1, 1.0), "no such start");
    assert!(refused(&sound, 0, 0, 1.0), "no step");
    assert!(refused(&sound, 0, 1, 0.0), "gamma 0");
    assert!(refused(&sound, 0, 1, f64::NAN), "gamma NaN");
    assert!(refused(&[state(vec![go(0.9, 1)]), ended.clone()], 0, 1, 1.0), "sum 0.9");
    assert!(refused(&[state(vec![go(1.5, 1), go(-0.5, 1)]), ended.clone()], 0, 1, 1.0));
    assert!(refused(&[state(vec![go(1.0, 7)]), ended.clone()], 0, 1, 1.0), "no such state");
    assert!(refused(&[state(vec![]), ended.clone()], 0, 1, 1.0), "no outcome");
    assert!(refused(&[State::Running(vec![]), ended], 0, 1, 1.0), "no action");

    let mdp = FiniteMdp::new(&sound, 0, 1, 1.0).unwrap();
    for alpha in [0.0, -0.1, 1.1, f64::NAN] {
        assert!(matches!(optimum(&mdp, alpha), Err(ExactError::Alpha(_))), "{alpha}");
    }
    let policy = Policy::stationary_choice(&mdp, |_| 0);
    for eta in [0.5, f64::NAN, f64::INFINITY] {
        assert!(matches!(WorstCase::new(&mdp, &policy, eta), Err(ExactError::Eta(_))), "{eta}");
    }
    let too_many = FiniteMdp::new(&sound, 0, usize::MAX, 1.0);
    assert_eq!(too_many.err(), Some(ExactError::TooLarge));
}
