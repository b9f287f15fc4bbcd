//! The yardsticks by their interface, against the functions of the exact solver that they stand for.

use cvar_game::exact::ExactError;
use cvar_game::exact::finite::ExactWorld;
use cvar_game::exact::law::evaluate;
use cvar_game::exact::oracle::{self, Effort};
use cvar_game::exact::policy::Policy;
use cvar_game::exact::response::Response;
use cvar_game::exact::stationary;
use cvar_game::exact::table::TablePolicy;
use cvar_game::exact::yardstick::{
    Evidence, ExactYardstick, Exploitability, Options, Solvable, Source, Yardstick, YardstickError,
};
use lava_envs::random::{Purpose, stream};
use lava_envs::{
    Discrete, End, GridConfig, LavaGrid, LavaPoint, Law, Move, PointConfig, Step, World,
};

const ETA: f64 = 25.0;

fn grid() -> ExactWorld<LavaGrid> {
    ExactWorld::new(&GridConfig::default(), 1.0).unwrap()
}

fn yardstick() -> Box<dyn Yardstick> {
    LavaGrid::yardstick(&GridConfig::default(), 1.0, &Options::default()).unwrap().unwrap()
}

/// The optimal policy at eta = 1, each move replaced by any other with probability 0.02.
fn careless(grid: &ExactWorld<LavaGrid>) -> (TablePolicy, Policy) {
    let best = grid.optimum(1.0).unwrap().policy;
    let row = |time: u32, cell: usize| {
        let mut row = [0.02; 4];
        if grid.mdp().ended(cell).is_none() {
            row[best.action(grid.mdp(), grid.node(time, cell))] = 0.94;
        }
        row
    };
    let table = TablePolicy::from_fn([70, 4], Some(40), |time, cell| row(time, cell).to_vec());
    (table, grid.timed_policy(row).unwrap())
}

fn exact(yardstick: &dyn Yardstick) -> &dyn ExactYardstick {
    yardstick.exact().expect("the grid is finite")
}

#[test]
fn a_table_is_the_policy_it_was_made_of() {
    let grid = grid();
    let (table, policy) = careless(&grid);
    assert_eq!(table.on(&grid).unwrap(), policy);
    assert!(table.sees_time());
    // A policy that looks at worlds: it goes where its observation says.
    let looking = TablePolicy::ask::<LavaGrid>(&GridConfig::default(), true, |world| {
        let right = |slot: usize| world.position(slot)[0] + f64::from(world.time(slot)) < 20.0;
        let row = |slot| if right(slot) { [0.0, 0.0, 1.0, 0.0] } else { [0.5, 0.5, 0.0, 0.0] };
        Some((0..world.episodes()).flat_map(row).collect())
    });
    let looking = looking.unwrap().unwrap();
    assert_eq!(looking.probabilities(10, 9), [0.0, 0.0, 1.0, 0.0]);
    assert_eq!(looking.probabilities(11, 9), [0.5, 0.5, 0.0, 0.0]);
    // Tables of another shape, and rows that are no law.
    let wrong = TablePolicy::stationary(69, 4, vec![0.25; 276]);
    assert!(matches!(wrong.on(&grid), Err(ExactError::Table { .. })));
    let wrong = TablePolicy::timed(70, 4, vec![0.25; 39 * 280]);
    assert!(matches!(wrong.on(&grid), Err(ExactError::Table { .. })));
    let wrong = TablePolicy::stationary(70, 4, vec![0.3; 280]);
    assert!(matches!(wrong.on(&grid), Err(ExactError::Policy { .. })));
    // A world without a finite model has no tables.
    let none = TablePolicy::ask::<LavaPoint>(&PointConfig::default(), false, |_| None);
    assert_eq!(none.unwrap(), None);
}

#[test]
fn the_grid_is_measured_exactly() {
    let (grid, yardstick) = (grid(), yardstick());
    let (table, policy) = careless(&grid);
    let best = grid.optimum(ETA).unwrap();
    let certificate = grid.certificate(&best, &policy, ETA).unwrap();
    let opposed = best.evaluation.law.clone(); // any law
    let evidence =
        Evidence { policy: Some(&table), opposed: Some(&opposed), ..Evidence::default() };
    let found = yardstick.compare(ETA, &evidence).unwrap().unwrap();
    assert_eq!(found.optimum, best.cvar);
    assert_eq!(found.regret, certificate.regret);
    assert_eq!(found.regret_standard_error, 0.0);
    assert_eq!(found.antagonist_gap, opposed.mean() - certificate.greedy.cvar);
    let alone = Evidence { opposed: None, ..evidence };
    assert_eq!(yardstick.compare(ETA, &alone).unwrap().unwrap().antagonist_gap, 0.0);
    assert_eq!(yardstick.compare(ETA, &Evidence::default()).unwrap(), None);

    let exact = exact(&*yardstick);
    assert_eq!(exact.regret(ETA, &table).unwrap(), certificate.regret);
    let laws = exact.laws(&table).unwrap();
    assert_eq!((laws.greedy, laws.sampled), (certificate.greedy_law, certificate.sampled_law));
    assert!(matches!(exact.regret(0.5, &table), Err(ExactError::Eta(_))));
}

/// A policy that does not see the time is compared with the best one found of its kind, and both halves of
/// exploitability are about the best of all.
#[test]
fn class_regret_and_exploitability_are_about_the_class_and_about_all() {
    let (grid, yardstick) = (grid(), yardstick());
    for eta in [1.0, ETA] {
        let best = grid.optimum(eta).unwrap();
        let found = stationary::search(grid.mdp(), 1.0 / eta, &best.policy).unwrap();
        let row = |cell: usize| {
            let mut row = vec![0.0; 4];
            if grid.mdp().ended(cell).is_none() {
                row[found.policy.action(grid.mdp(), grid.node(0, cell))] = 1.0;
            }
            row
        };
        let table = TablePolicy::from_fn([70, 4], None, |_, cell| row(cell));
        let response = Response { value: best.cvar + 0.003, error: 1e-5 };
        let evidence = Evidence { policy: Some(&table), ..Evidence::default() };
        let compared = yardstick.compare(eta, &evidence).unwrap().unwrap();
        assert_eq!(compared.class_regret, Some(0.0));
        assert_eq!(compared.regret, best.cvar - found.cvar);
        // At eta = 1 the antagonist can do nothing, whatever it is.
        let neutral =
            Exploitability { epsilon: compared.regret, response_gain: 0.0, response_error: 0.0 };
        assert_eq!(compared.exploitability, (eta == 1.0).then_some(neutral));
        let evidence = Evidence { response: Some(response), ..evidence };
        let both = yardstick.compare(eta, &evidence).unwrap().unwrap().exploitability.unwrap();
        assert_eq!(both.response_gain, response.value - best.cvar);
        assert_eq!(both.epsilon, compared.regret.max(both.response_gain));
        assert_eq!(both.response_error, 1e-5);
    }
    // One that sees the time is of no such class.
    let (table, _) = careless(&grid);
    let evidence = Evidence { policy: Some(&table), ..Evidence::default() };
    assert_eq!(yardstick.compare(ETA, &evidence).unwrap().unwrap().class_regret, None);
}

#[test]
fn the_worst_case_is_that_of_the_greedy_policy() {
    let (grid, yardstick) = (grid(), yardstick());
    let (table, policy) = careless(&grid);
    let greedy = policy.greedy(grid.mdp());
    let worst = grid.worst_case(&greedy, ETA).unwrap();
    let ratios = exact(&*yardstick).worst_case(ETA, &table).unwrap();
    for time in 0..40 {
        for cell in (0..70).filter(|&cell| grid.mdp().ended(cell).is_none()) {
            let node = grid.node(time, cell);
            let action = greedy.action(grid.mdp(), node);
            let expected: Vec<f64> = (0..4).map(|of| worst.delta(node, action, of)).collect();
            assert_eq!(ratios.ratios(time, cell, action), expected);
        }
    }
    let exposure = exact(&*yardstick).exposure(ETA, &table).unwrap();
    assert_eq!(exposure, grid.exposure(&greedy, &worst));
}

/// As on the grid without slips.
#[test]
fn occupancy_is_that_of_a_world_without_chance() {
    let grid = grid();
    let (table, policy) = careless(&grid);
    let steady = GridConfig { slip: 0.0, ..GridConfig::default() };
    let steady = ExactWorld::<LavaGrid>::new(&steady, 1.0).unwrap();
    let expected = evaluate(steady.mdp(), &policy.greedy(steady.mdp())).visits;
    let found = exact(&*yardstick()).occupancy(&table).unwrap();
    assert_eq!(found, expected);
}

#[test]
fn the_frontier_is_that_of_the_optima() {
    let (grid, yardstick) = (grid(), yardstick());
    let etas = [1.0, 5.0, 100.0];
    let frontier = exact(&*yardstick).frontier(&etas, 0.04).unwrap();
    for (eta, point) in etas.into_iter().zip(frontier) {
        let law = grid.optimum(eta).unwrap().evaluation.law;
        assert_eq!(point, [law.cvar(0.04), law.mean()]);
        assert_eq!(yardstick.optimal_law(eta).unwrap(), Some(law));
    }
}

#[test]
fn answers_are_pages_and_json() {
    let answer = yardstick().answer(ETA, &()).unwrap().unwrap();
    let summary = grid().solve(ETA).unwrap();
    assert_eq!(answer.to_string(), summary.to_string());
    assert_eq!(answer.json(), serde_json::to_string(&summary).unwrap());
}

#[test]
fn lava_point_is_measured_by_its_oracle() {
    let constants = PointConfig::default();
    let options = Options { source: Source::Shipped, ..Options::default() };
    let yardstick = LavaPoint::yardstick(&constants, 1.0, &options).unwrap().unwrap();
    assert!(yardstick.exact().is_none());
    let certified = oracle::shipped(&constants, 1.0, ETA, &Effort::of(&constants)).unwrap();
    let bound = oracle::shipped_bound(&constants).unwrap();
    let bracket = oracle::Bracket::new(certified.clone(), Some(&bound));
    assert_eq!(yardstick.answer(ETA, &()).unwrap().unwrap().to_string(), bracket.to_string());
    let walks = yardstick.walks(ETA, oracle::WALKS_SEED, 3).unwrap();
    assert_eq!((walks.len(), &walks[..]), (3, &certified.walks[..3]));
    assert!(yardstick.walks(ETA, oracle::WALKS_SEED + 1, 3).unwrap().is_empty(), "other noise");
    let law = yardstick.optimal_law(ETA).unwrap().unwrap();
    assert_eq!(law, certified.law);
    // The oracle's own episodes as those of a policy.
    let evidence = Evidence { nominal: Some(&law), opposed: Some(&law), ..Evidence::default() };
    let found = yardstick.compare(ETA, &evidence).unwrap().unwrap();
    let error = law.cvar_standard_error(1.0 / ETA);
    assert_eq!(found.optimum, certified.certified_cvar);
    assert!(found.regret.abs() < 1e-9);
    assert_eq!(found.regret_standard_error, error.hypot(error));
    assert_eq!(found.antagonist_gap, law.mean() - law.cvar(1.0 / ETA));
    assert_eq!(found.antagonist_gap_standard_error, law.mean_standard_error().hypot(error));
    // No certificate comes with the program for other budgets.
    assert!(yardstick.answer(3.0, &()).unwrap().is_none());
    assert!(yardstick.compare(3.0, &evidence).unwrap().is_none());
}

#[test]
fn what_is_out_of_range_is_refused() {
    let refused = |constants: &GridConfig, gamma| {
        LavaGrid::yardstick(constants, gamma, &Options::default()).err()
    };
    let slippery = GridConfig { slip: 2.0, ..GridConfig::default() };
    assert!(matches!(refused(&slippery, 1.0), Some(YardstickError::Exact(ExactError::Config(_)))));
    assert!(refused(&GridConfig::default(), 1.5).is_some());
}

/// Every gain is the difference of two exact values, of the policy and of the table with that one change.
#[test]
fn a_single_change_is_worth_what_the_changed_policy_attains() {
    let (yardstick, grid) = (yardstick(), grid());
    let exact = exact(&*yardstick);
    let (timed, _) = careless(&grid);
    let stationary =
        TablePolicy::from_fn([70, 4], None, |_, cell| timed.probabilities(0, cell).to_vec());
    for policy in [&timed, &stationary] {
        let found = exact.changes(ETA, policy).unwrap();
        let cvar = exact.laws(policy).unwrap().greedy.cvar(1.0 / ETA);
        assert!((found.cvar - cvar).abs() < 1e-12);
        assert!(found.changes.windows(2).all(|pair| pair[0].gain >= pair[1].gain));
        let first = &found.changes[0];
        assert!(first.gain > 0.001, "{found}");
        for change in found.changes.iter().step_by(17) {
            let cell = change.y * 10 + change.x;
            let action = ["up", "down", "right", "left"];
            let action = action.iter().position(|name| *name == change.action).unwrap();
            let changed = |time: u32, of: usize| {
                let mut row = [0.0; 4];
                row[if of == cell { action } else { policy.greedy_action(time, of) }] = 1.0;
                row.to_vec()
            };
            let times = policy.sees_time().then_some(40);
            let changed = TablePolicy::from_fn([70, 4], times, changed);
            let truth = exact.laws(&changed).unwrap().greedy.cvar(1.0 / ETA) - cvar;
            assert!((change.gain - truth).abs() < 1e-12, "{change:?}: {truth}");
        }
    }
    // Nothing is better than what is optimal.
    assert!(exact.changes(1.0, &timed).unwrap().changes.iter().all(|of| of.gain < 1e-12));
}

/// A walk of the optimum meets the noise of the evaluation, and what it says of itself is right.
#[test]
fn walks_of_the_optimum_are_episodes_of_the_world() {
    let constants = GridConfig { slip: 0.3, ..GridConfig::default() };
    let yardstick = LavaGrid::yardstick(&constants, 1.0, &Options::default()).unwrap().unwrap();
    let walks = yardstick.walks(1.0, 7, 300).unwrap();
    let mut ends = Vec::new();
    for (index, walk) in walks.iter().enumerate() {
        let mut world = LavaGrid::new(&constants, 1).unwrap();
        let mut chance = stream(7, Purpose::EvaluationOutcomes, index as u64);
        let (mut value, mut end) = (0.0, None);
        for (step, &arrow) in walk.actions.iter().enumerate() {
            assert_eq!(world.position(0), walk.path[step]);
            let moves = (0..4).map(Move::from_index);
            let action = moves.clone().find(|&of| LavaGrid::action_arrow(of) == arrow).unwrap();
            let outcome = world.law(0, action).sample(&mut chance);
            assert_eq!(LavaGrid::outcome_arrow(outcome), walk.outcomes[step]);
            let mut steps = [Step::IDLE];
            world.apply(&[action], &[outcome], &mut steps);
            value += steps[0].reward;
            end = steps[0].end;
        }
        assert_eq!((end, world.position(0)), (Some(walk.end), *walk.path.last().unwrap()));
        assert!((value - walk.value).abs() < 1e-9);
        ends.push(walk.end);
    }
    assert!(ends.contains(&End::Goal) && ends.contains(&End::Lava));
    assert_eq!(yardstick.walks(1.0, 7, 3).unwrap(), walks[..3]);
}
