//! The yardsticks on `lava-grid`: against the real world, and their values on the paper's map.

use cvar_game::exact::ExactError;
use cvar_game::exact::finite::{ExactWorld, Summary};
use cvar_game::exact::law::evaluate;
use cvar_game::exact::policy::Policy;
use cvar_game::game::returns::{Atom, ReturnLaw};
use lava_envs::law::{FiniteLaw, sample_index};
use lava_envs::random::{Purpose, stream};
use lava_envs::{Discrete, End, FiniteModel, GridConfig, LavaGrid, Law, Move, Step, World};
use proptest::prelude::*;

type ExactGrid = ExactWorld<LavaGrid>;

fn solve(config: &GridConfig, gamma: f64, eta: f64) -> Result<Summary, ExactError> {
    ExactGrid::new(config, gamma)?.solve(eta)
}

/// Plays episodes in the world itself. `perturb(time, cell, action, law)` is the antagonist.
fn simulate(
    exact: &ExactGrid,
    policy: &Policy,
    episodes: usize,
    perturb: impl Fn(u32, usize, Move, FiniteLaw<4>) -> FiniteLaw<4>,
) -> ReturnLaw {
    const SLOTS: usize = 1000;
    let mut world = LavaGrid::new(exact.world().constants(), SLOTS).unwrap();
    let mut random = stream(1, Purpose::EvaluationOutcomes, 0);
    let mut steps = vec![Step::IDLE; SLOTS];
    let mut actions = vec![Move::Up; SLOTS];
    let mut outcomes = vec![0; SLOTS];
    let mut recorded = Vec::with_capacity(episodes);
    while recorded.len() < episodes {
        let mut returns = vec![(0.0, 0.0); SLOTS];
        (0..SLOTS).for_each(|slot| world.reset(slot));
        let mut discount = 1.0;
        for time in 0..world.horizon() {
            for slot in 0..SLOTS {
                let cell = world.state(slot);
                if exact.mdp().ended(cell).is_some() {
                    continue;
                }
                let row = policy.row(exact.mdp(), exact.node(time, cell));
                actions[slot] = Move::from_index(sample_index(row, &mut random));
                let law = perturb(time, cell, actions[slot], world.law(slot, actions[slot]));
                outcomes[slot] = law.sample(&mut random);
            }
            world.apply(&actions, &outcomes, &mut steps);
            for (step, (discounted, undiscounted)) in steps.iter().zip(&mut returns) {
                *discounted += discount * step.reward;
                *undiscounted += step.reward;
                if let Some(end) = step.end {
                    recorded.push(Atom {
                        value: *discounted,
                        undiscounted: *undiscounted,
                        steps: time + 1,
                        end,
                        mass: 0.0,
                    });
                }
            }
            discount *= exact.mdp().gamma();
        }
    }
    ReturnLaw::recorded(recorded)
}

/// The optimal policy at eta = 25, each move replaced by any other with probability 0.02.
fn careless(exact: &ExactGrid) -> Policy {
    let best = exact.optimum(25.0).unwrap().policy;
    exact
        .timed_policy(|time, cell| {
            let mut row = [0.02; 4];
            row[best.action(exact.mdp(), exact.node(time, cell))] = 0.94;
            row
        })
        .unwrap()
}

#[test]
fn the_exact_law_agrees_with_a_million_episodes_of_the_world() {
    let exact = ExactGrid::new(&GridConfig::default(), 0.99).unwrap();
    let policy = careless(&exact);
    let law = evaluate(exact.mdp(), &policy).law;
    let simulated = simulate(&exact, &policy, 1_000_000, |_, _, _, law| law);
    let standard_errors = (law.mean() - simulated.mean()) / simulated.mean_standard_error();
    assert!(standard_errors.abs() < 4.0, "mean off by {standard_errors} standard errors");
    for alpha in [0.5, 0.04, 0.01] {
        let difference = law.cvar(alpha) - simulated.cvar(alpha);
        let standard_errors = difference / simulated.cvar_standard_error(alpha);
        assert!(standard_errors.abs() < 4.0, "CVaR_{alpha} off by {standard_errors}");
    }
    for end in [End::Goal, End::Lava] {
        let p = law.probability(end);
        let standard_errors =
            (p - simulated.probability(end)) / (p * (1.0 - p) / 1_000_000.0).sqrt();
        assert!(standard_errors.abs() < 4.0, "{end:?} off by {standard_errors}");
    }
    approx::assert_relative_eq!(
        law.undiscounted_mean(),
        simulated.undiscounted_mean(),
        epsilon = 0.005
    );
}

#[test]
fn the_exact_antagonist_played_in_the_world_brings_the_mean_down_to_the_cvar() {
    let exact = ExactGrid::new(&GridConfig::default(), 1.0).unwrap();
    let eta = 25.0;
    let best = exact.optimum(eta).unwrap();
    let antagonist = exact.worst_case(&best.policy, eta).unwrap();
    let simulated = simulate(&exact, &best.policy, 100_000, |time, cell, action, law| {
        let node = exact.node(time, cell);
        let mut probabilities = law.probabilities;
        for (outcome, probability) in probabilities.iter_mut().enumerate() {
            *probability *= antagonist.delta(node, action.index(), outcome);
        }
        FiniteLaw { probabilities }
    });
    let standard_errors = (simulated.mean() - best.cvar) / simulated.mean_standard_error();
    assert!(standard_errors.abs() < 4.0, "off by {standard_errors} standard errors");
}

/// Values of the default grid. A plain programme in Python over all thresholds, written separately,
/// gives the same digits.
#[test]
fn the_best_values_on_the_papers_map() {
    let exact = ExactGrid::new(&GridConfig::default(), 1.0).unwrap();
    for (eta, value) in [(1.0, 0.461_149_467_4), (25.0, 0.208_336_729_5), (100.0, 0.029_937_638_5)]
    {
        let cvar = exact.optimum(eta).unwrap().cvar;
        approx::assert_abs_diff_eq!(cvar, value, epsilon = 1e-9);
    }
}

#[test]
fn risk_aversion_keeps_away_from_the_lava() {
    let summary = |eta| solve(&GridConfig::default(), 1.0, eta).unwrap();
    let crossing = |eta| {
        let summary = summary(eta);
        summary.path.iter().filter(|step| step.x == 5).map(|step| step.y).collect::<Vec<_>>()
    };
    assert_eq!(crossing(1.0), [3]);
    assert_eq!(crossing(100.0), [4]);
    let (neutral, averse) = (summary(1.0), summary(100.0));
    assert!(averse.lava_probability < neutral.lava_probability / 3.0);
    assert!(averse.optimal_cvar > averse.risk_neutral_cvar + 0.3);
    assert!(averse.goal_probability > 0.998, "it still walks to the goal");
}

#[test]
fn the_certificate_of_the_optimal_policy_has_no_regret() {
    let exact = ExactGrid::new(&GridConfig::default(), 1.0).unwrap();
    for eta in [1.0, 25.0] {
        let best = exact.optimum(eta).unwrap();
        let own = exact.certificate(&best, &best.policy, eta).unwrap();
        assert_eq!(own.regret, 0.0);
        assert_eq!(own.greedy, own.sampled);
        assert_eq!(own.antagonist_gap(own.greedy.cvar), 0.0);

        let sampled = careless(&exact);
        let other = exact.certificate(&best, &sampled, eta).unwrap();
        assert!(other.regret >= 0.0);
        assert!(other.sampled.cvar < other.greedy.cvar, "careless moves cost");
        assert_eq!(other.sampled_law.cvar(1.0 / eta), other.sampled.cvar);
        assert!(exact.certificate(&best, &sampled, eta + 1.0).is_err());
    }
}

#[test]
fn a_summary_is_json_with_the_promised_fields_and_a_page_with_the_map() {
    let summary = solve(&GridConfig::default(), 1.0, 25.0).unwrap();
    let json = serde_json::to_value(&summary).unwrap();
    for field in [
        "env",
        "eta",
        "alpha",
        "optimal_cvar",
        "var",
        "risk_neutral_mean",
        "optimal_policy_mean",
        "lava_probability",
        "goal_probability",
        "timeout_probability",
        "chow_value",
        "best_stationary_cvar",
    ] {
        assert!(!json[field].is_null(), "{field} is missing");
    }
    assert_eq!(json["env"], "lava-grid");
    assert_eq!(json["visits"].as_array().map(Vec::len), Some(7));
    let page = summary.to_string();
    for part in ["0.2083", "found by local search, not proven", "overestimate", "|S↓"] {
        assert!(page.contains(part), "{part} is missing in\n{page}");
    }
}

fn config() -> impl Strategy<Value = GridConfig> {
    let map = proptest::collection::vec(
        proptest::collection::vec(proptest::sample::select(b"....L#".to_vec()), 5),
        4,
    )
    .prop_map(|mut rows| {
        rows[0][0] = b'S';
        rows[1][4] = b'G';
        let rows: Vec<String> =
            rows.into_iter().map(|row| row.into_iter().map(char::from).collect()).collect();
        rows.join("\n")
    });
    let slip = prop_oneof![proptest::sample::select(vec![0.0, 0.05, 0.75, 1.0]), 0.0..1.0];
    let cost = proptest::sample::select(vec![0.0, 0.035, 0.1, 2.0]);
    (map, slip, cost, 1..12_u32, -2.0..2.0).prop_map(
        |(map, slip, step_cost, horizon, goal_reward)| GridConfig {
            map,
            slip,
            step_cost,
            horizon,
            goal_reward,
            ..GridConfig::default()
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn on_any_map_the_yardsticks_are_in_order(
        config in config(),
        gamma in proptest::sample::select(vec![1.0, 0.97, 0.5]),
        eta in proptest::sample::select(vec![1.0, 1.5, 4.0, 25.0, 100.0, 1e6, 1e300]),
    ) {
        let summary = solve(&config, gamma, eta).unwrap();
        let best = summary.optimal_cvar;
        prop_assert!(summary.best_stationary_cvar <= best + 1e-9);
        prop_assert!(summary.risk_neutral_cvar <= best + 1e-9);
        prop_assert!(summary.chow_value >= best - 1e-9);
        prop_assert!(summary.optimal_policy_mean <= summary.risk_neutral_mean + 1e-9);
        let ends =
            summary.lava_probability + summary.goal_probability + summary.timeout_probability;
        prop_assert!((ends - 1.0).abs() < 1e-9);
        prop_assert!(!summary.to_string().contains("NaN"));

        let exact = ExactGrid::new(&config, gamma).unwrap();
        let antagonist = exact.worst_case(&exact.optimum(eta).unwrap().policy, eta).unwrap();
        prop_assert!((antagonist.value() - best).abs() < 1e-9);
    }
}

/// Where the worst case makes moves slip, against episodes played in the world.
#[test]
fn exposure_to_the_worst_case_is_what_played_episodes_meet() {
    let exact = ExactGrid::new(&GridConfig::default(), 1.0).unwrap();
    let policy = exact.optimum(1.0).unwrap().policy;
    let eta: f64 = 25.0;
    let worst = exact.worst_case(&policy, eta).unwrap();
    let exposure = exact.exposure(&policy, &worst);
    let cells = exact.world().cells();
    let counted =
        std::cell::RefCell::new((vec![0.0; cells], vec![0.0; cells], vec![(0.0, 0.0); 40]));
    let episodes = 50_000;
    let law = simulate(&exact, &policy, episodes, |time, cell, action, law| {
        let node = exact.node(time, cell);
        let mut perturbed = law;
        for (outcome, p) in perturbed.probabilities.iter_mut().enumerate() {
            *p *= worst.delta(node, action.index(), outcome);
        }
        let (visits, deviations, budget) = &mut *counted.borrow_mut();
        visits[cell] += 1.0;
        deviations[cell] += 1.0 - perturbed.probabilities[action.index()];
        budget[time as usize].0 += worst.remaining_budget(node).ln() / eta.ln();
        budget[time as usize].1 += 1.0;
        perturbed
    });
    let played = law.episodes().unwrap() as f64;
    let (visits, deviations, budget) = counted.into_inner();
    for cell in 0..cells {
        // Visits of one episode scatter like their number at most, and a little for those of none.
        let error = 5.0 * (2.0 * exposure.visits[cell].max(1e-3) / played).sqrt();
        for (name, found, expected) in [
            ("visits", visits[cell], exposure.visits[cell]),
            ("deviations", deviations[cell], exposure.deviations[cell]),
        ] {
            let found = found / played;
            assert!((found - expected).abs() < error, "{name} of {cell}: {found}, not {expected}");
        }
    }
    for (time, expected) in exposure.budget.iter().take(15).enumerate() {
        let found = budget[time].0 / budget[time].1;
        assert!((found - expected).abs() < 0.02, "budget at {time}: {found}, not {expected}");
    }
    let share = |cells: &[f64]| cells.iter().sum::<f64>();
    assert!(share(&exposure.deviations) > 1.5 * 0.05 * share(&exposure.visits));
}
