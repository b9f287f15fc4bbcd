//! What every world promises, checked on both through the `World` trait alone.

use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use lava_envs::{
    End, FiniteLaw, Force, GaussianLaw, GridConfig, LavaGrid, LavaPoint, Law, Move, PointConfig,
    Step, World,
};
use nalgebra::Vector2;
use rand::RngExt;
use rand_distr::StandardNormal;

/// What the suite has to know about a world beyond the trait.
trait Subject: World + Sized {
    fn create(episodes: usize) -> Self;
    fn random_action(random: &mut ChaCha8Rng) -> Self::Action;
    /// An action and an outcome that lead nowhere.
    fn idling() -> (Self::Action, <Self::Law as Law>::Outcome);
    /// An action and an outcome that change the state.
    fn moving() -> (Self::Action, <Self::Law as Law>::Outcome);
    /// (goal reward, lava reward, step cost)
    fn rewards(&self) -> (f64, f64, f64);
    /// Number of episodes for the comparison of batch and singles.
    const EPISODES: usize;
}

impl Subject for LavaGrid {
    const EPISODES: usize = 10_000;
    fn create(episodes: usize) -> Self {
        LavaGrid::new(&GridConfig::default(), episodes).unwrap()
    }
    fn random_action(random: &mut ChaCha8Rng) -> Move {
        Move::from_index(random.random_range(0..4))
    }
    fn idling() -> (Move, usize) {
        (Move::Left, Move::Left.index())
    }
    fn moving() -> (Move, usize) {
        (Move::Down, Move::Down.index())
    }
    fn rewards(&self) -> (f64, f64, f64) {
        (self.config().goal_reward, self.config().lava_reward, self.config().step_cost)
    }
}

impl Subject for LavaPoint {
    const EPISODES: usize = 10_000;
    fn create(episodes: usize) -> Self {
        LavaPoint::new(&PointConfig::default(), episodes).unwrap()
    }
    fn random_action(random: &mut ChaCha8Rng) -> Force {
        // A weak drift: the sample reaches walls, corners, lava, goal and time limit.
        Force(Vector2::new(
            random.sample::<f64, _>(StandardNormal) + 0.3,
            random.sample::<f64, _>(StandardNormal),
        ))
    }
    fn idling() -> (Force, Vector2<f64>) {
        (Force(Vector2::zeros()), Vector2::zeros())
    }
    fn moving() -> (Force, Vector2<f64>) {
        (Force(Vector2::new(0.0, 1.0)), Vector2::zeros())
    }
    fn rewards(&self) -> (f64, f64, f64) {
        (self.config().goal_reward, self.config().lava_reward, self.config().step_cost)
    }
}

/// Everything that can be seen of a slot, bit for bit.
#[derive(Debug, Clone, PartialEq)]
struct Sight {
    time: u32,
    observation: Vec<u32>,
    position: [u64; 2],
    clearance: u64,
}

fn sight<W: World>(world: &W, slot: usize) -> Sight {
    let mut observation = vec![f32::NAN; W::OBSERVATION];
    world.observe(slot, &mut observation);
    Sight {
        time: world.time(slot),
        observation: observation.iter().map(|entry| entry.to_bits()).collect(),
        position: world.position(slot).map(f64::to_bits),
        clearance: world.clearance(slot).to_bits(),
    }
}

/// One slot's own stream of actions and outcomes.
struct Chance {
    random: ChaCha8Rng,
}

impl Chance {
    fn new(seed: u64, slot: usize) -> Self {
        Chance { random: stream(seed, Purpose::Outcomes, slot as u64) }
    }
    fn draw<W: Subject>(
        &mut self,
        world: &W,
        slot: usize,
    ) -> (W::Action, <W::Law as Law>::Outcome) {
        let action = W::random_action(&mut self.random);
        let mut situation = vec![f32::NAN; W::SITUATION];
        world.situation(slot, action, &mut situation);
        assert!(situation.iter().all(|entry| entry.is_finite()));
        (action, world.law(slot, action).sample(&mut self.random))
    }
}

/// Runs all slots for `steps` steps, resetting each as soon as it has ended, and shows every sight
/// and step to `see`.
fn run<W: Subject>(
    world: &mut W,
    chances: &mut [Chance],
    steps: usize,
    mut see: impl FnMut(usize, usize, &Sight, Step),
) {
    let slots = world.episodes();
    let mut results = vec![Step::IDLE; slots];
    for step in 0..steps {
        let (actions, outcomes): (Vec<_>, Vec<_>) =
            (0..slots).map(|slot| chances[slot].draw(world, slot)).unzip();
        world.apply(&actions, &outcomes, &mut results);
        for (slot, &result) in results.iter().enumerate() {
            see(step, slot, &sight(world, slot), result);
            if result.end.is_some() {
                world.reset(slot);
            }
        }
    }
}

fn same_seed_gives_the_same_trajectories<W: Subject>() {
    let record = |seed: u64| {
        let mut world = W::create(7);
        let mut chances: Vec<_> = (0..7).map(|slot| Chance::new(seed, slot)).collect();
        let mut seen = Vec::new();
        run(&mut world, &mut chances, 200, |_, _, sight, step| seen.push((sight.clone(), step)));
        seen
    };
    assert_eq!(record(1), record(1));
    assert_ne!(record(1), record(2));
}

fn episodes_end_by_the_rules<W: Subject>() {
    let mut world = W::create(50);
    let (goal, lava, cost) = world.rewards();
    let horizon = world.horizon();
    let mut chances: Vec<_> = (0..50).map(|slot| Chance::new(3, slot)).collect();
    let mut time = [0_u32; 50];
    let mut ends = Vec::new();
    run(&mut world, &mut chances, 2000, |_, slot, sight, step| {
        time[slot] += 1;
        assert_eq!(sight.time, time[slot]);
        let expected = match step.end {
            Some(End::Goal) => goal,
            Some(End::Lava) => lava,
            Some(End::Timeout) | None => -cost,
        };
        assert_eq!(step.reward, expected);
        match step.end {
            Some(End::Timeout) => assert_eq!(time[slot], horizon),
            Some(_) => assert!(time[slot] <= horizon),
            None => assert!(time[slot] < horizon),
        }
        if step.end == Some(End::Lava) {
            assert!(f64::from_bits(sight.clearance) < 1e-6);
        }
        if let Some(end) = step.end {
            ends.push(end);
            time[slot] = 0;
        }
    });
    for end in [End::Goal, End::Lava, End::Timeout] {
        assert!(ends.contains(&end), "the sample has no {end:?}");
    }
}

fn an_ended_episode_waits_for_its_reset<W: Subject>() {
    let mut world = W::create(2);
    let initial = sight(&world, 0);
    assert_eq!(initial.time, 0);
    let mut steps = [Step::IDLE; 2];
    let (action, outcome) = W::idling();
    for time in 1..=world.horizon() {
        world.apply(&[action; 2], &[outcome; 2], &mut steps);
        let end = (time == world.horizon()).then_some(End::Timeout);
        assert_eq!(steps.map(|step| step.end), [end; 2], "at time {time}");
    }
    let ended = sight(&world, 0);
    world.reset(1);
    let (action, outcome) = W::moving();
    world.apply(&[action; 2], &[outcome; 2], &mut steps);
    assert_eq!(steps[0], Step::IDLE);
    assert_eq!(sight(&world, 0), ended);
    assert_eq!(world.time(1), 1);
    assert_ne!(sight(&world, 1).position, initial.position);
    world.reset(0);
    assert_eq!(sight(&world, 0), initial);
}

fn a_slot_is_what_it_would_be_alone<W: Subject>() {
    const SLOTS: usize = 100;
    let mut batch = W::create(SLOTS);
    let mut chances: Vec<_> = (0..SLOTS).map(|slot| Chance::new(5, slot)).collect();
    let mut recordings = vec![Vec::new(); SLOTS];
    let mut episodes = 0;
    let mut steps = 0;
    while episodes < W::EPISODES {
        run(&mut batch, &mut chances, 20, |_, slot, sight, step| {
            episodes += usize::from(step.end.is_some());
            recordings[slot].push((sight.clone(), step));
        });
        steps += 20;
    }
    for (slot, recording) in recordings.iter().enumerate() {
        let mut single = W::create(1);
        run(&mut single, &mut [Chance::new(5, slot)], steps, |step, _, sight, result| {
            assert_eq!((sight, result), (&recording[step].0, recording[step].1), "slot {slot}");
        });
    }
}

/// Episodes cut anywhere go on in another batch, in other slots, and through a file's text.
fn a_restored_episode_goes_on_bit_for_bit<W: Subject>() {
    const SLOTS: usize = 10;
    let mut world = W::create(SLOTS);
    let mut chances: Vec<_> = (0..SLOTS).map(|slot| Chance::new(6, slot)).collect();
    for cut in 0..50 {
        run(&mut world, &mut chances, 7, |_, _, _, _| {});
        let mut other = W::create(SLOTS);
        let there = |slot: usize| SLOTS - 1 - slot;
        for slot in 0..SLOTS {
            let text = serde_json::to_string(&world.snapshot(slot)).unwrap();
            other.restore(there(slot), serde_json::from_str(&text).unwrap()).unwrap();
        }
        let again = |(slot, chance): (usize, &Chance)| {
            let position = position(&chance.random);
            Chance { random: stream_from(6, Purpose::Outcomes, slot as u64, position) }
        };
        let mut others: Vec<_> = chances.iter().enumerate().map(again).rev().collect();
        let mut expected = vec![Vec::new(); SLOTS];
        run(&mut world, &mut chances, 60, |_, slot, sight, step| {
            expected[slot].push((sight.clone(), step));
        });
        run(&mut other, &mut others, 60, |at, slot, sight, step| {
            let (seen, happened) = &expected[there(slot)][at];
            assert_eq!((sight, step), (seen, *happened), "cut {cut}, slot {slot}");
        });
    }
}

fn observations_are_finite_and_bounded<W: Subject>() {
    let mut world = W::create(20);
    let mut chances: Vec<_> = (0..20).map(|slot| Chance::new(8, slot)).collect();
    run(&mut world, &mut chances, 1000, |_, _, sight, _| {
        for &bits in &sight.observation {
            let entry = f32::from_bits(bits);
            assert!(entry.is_finite() && entry.abs() < 3.0, "{entry}");
        }
        for &bits in &sight.observation[..2] {
            assert!(f32::from_bits(bits).abs() <= 1.0);
        }
    });
}

macro_rules! conformance {
    ($name:ident, $world:ty) => {
        mod $name {
            use super::*;
            #[test]
            fn same_seed_gives_the_same_trajectories() {
                super::same_seed_gives_the_same_trajectories::<$world>();
            }
            #[test]
            fn episodes_end_by_the_rules() {
                super::episodes_end_by_the_rules::<$world>();
            }
            #[test]
            fn an_ended_episode_waits_for_its_reset() {
                super::an_ended_episode_waits_for_its_reset::<$world>();
            }
            #[test]
            fn a_slot_is_what_it_would_be_alone() {
                super::a_slot_is_what_it_would_be_alone::<$world>();
            }
            #[test]
            fn a_restored_episode_goes_on_bit_for_bit() {
                super::a_restored_episode_goes_on_bit_for_bit::<$world>();
            }
            #[test]
            fn observations_are_finite_and_bounded() {
                super::observations_are_finite_and_bounded::<$world>();
            }
        }
    };
}

conformance!(lava_grid, LavaGrid);
conformance!(lava_point, LavaPoint);

#[test]
fn states_that_a_world_has_not_are_refused() {
    fn refused<W: World>(mut world: W, changes: &[(&str, &str)]) {
        let good = serde_json::to_string(&world.snapshot(0)).unwrap();
        for (from, to) in changes {
            assert!(good.contains(from), "{good}");
            let bad = serde_json::from_str(&good.replace(from, to)).unwrap();
            assert!(world.restore(0, bad).is_err(), "{to}");
            assert_eq!(serde_json::to_string(&world.snapshot(0)).unwrap(), good);
        }
    }
    let time = ("\"time\":0", "\"time\":40");
    let map = "S#G".to_owned();
    let grid = LavaGrid::new(&GridConfig { map, ..GridConfig::default() }, 1).unwrap();
    refused(grid, &[time, ("\"cell\":0", "\"cell\":1"), ("\"cell\":0", "\"cell\":3")]);
    let point = LavaPoint::new(&PointConfig::default(), 1).unwrap();
    let (position, velocity) = ("\"position\":[0.5,", "\"velocity\":[0.0,");
    refused(
        point,
        &[
            time,
            (position, "\"position\":[10.5,"),
            (position, "\"position\":[-1,"),
            (position, "\"position\":[1e39,"),
            (velocity, "\"velocity\":[1e4,"),
            (velocity, "\"velocity\":[1e39,"),
        ],
    );
}

/// Worlds can be moved to another thread.
#[test]
fn worlds_are_send() {
    fn is_send<T: Send>() {}
    is_send::<LavaGrid>();
    is_send::<LavaPoint>();
}

#[test]
fn finite_law_sums_to_one_and_is_sampled() {
    for slip in [0.0, 0.05, 0.75, 1.0] {
        let config = GridConfig { slip, ..GridConfig::default() };
        let world = LavaGrid::new(&config, 1).unwrap();
        for chosen in Move::ALL {
            let law: FiniteLaw = world.law(0, chosen);
            let total: f64 = (0..4).map(|outcome| law.log_density(outcome).exp()).sum();
            assert!((total - 1.0).abs() < 1e-12);
            let mut random = stream(1, Purpose::Outcomes, chosen.index() as u64);
            let samples = 40_000;
            let mut counts = [0.0; 4];
            for _ in 0..samples {
                counts[law.sample(&mut random)] += 1.0;
            }
            for (outcome, count) in counts.iter().enumerate() {
                let p = law.probabilities[outcome];
                let expected = if outcome == chosen.index() { 1.0 - slip } else { slip / 3.0 };
                assert_eq!(p, expected);
                let error = (p * (1.0 - p) / f64::from(samples)).sqrt();
                let frequency = count / f64::from(samples);
                assert!((frequency - p).abs() <= 4.5 * error, "{frequency} instead of {p}");
            }
        }
    }
}

#[test]
fn gaussian_law_integrates_to_one_and_is_sampled() {
    // The trapezoidal rule is exact to rounding for a Gaussian at this spacing.
    let spacing = 0.25;
    let mut total = 0.0;
    for i in -40..=40 {
        for j in -40..=40 {
            let xi = Vector2::new(f64::from(i), f64::from(j)) * spacing;
            total += GaussianLaw.log_density(xi).exp() * spacing * spacing;
        }
    }
    assert!((total - 1.0).abs() < 1e-12, "{total}");

    let mut random = stream(2, Purpose::Outcomes, 0);
    let samples = 100_000;
    let count = f64::from(samples);
    let (mut mean, mut second) = (Vector2::zeros(), nalgebra::Matrix2::zeros());
    let mut within_one = 0.0;
    for _ in 0..samples {
        let xi = GaussianLaw.sample(&mut random);
        mean += xi / count;
        second += xi * xi.transpose() / count;
        within_one += f64::from(u8::from(xi.norm() < 1.0)) / count;
    }
    let error = 4.5 / count.sqrt();
    assert!(mean.amax() < error, "{mean}");
    assert!((second - nalgebra::Matrix2::identity()).amax() < error * 2.0_f64.sqrt(), "{second}");
    // |xi|^2 / 2 is exponential with mean 1.
    let probability = 1.0 - (-0.5_f64).exp();
    assert!((within_one - probability).abs() < error * 0.5, "{within_one}");
}
