//! The public suite on both worlds, and what is beyond it: many episodes with an action that reaches
//! walls, corners, lava and goal, snapshots as text, and the samplers of the laws.

use lava_envs::conformance::check;
use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use lava_envs::{
    Discrete, End, FiniteLaw, Force, GaussianLaw, GridConfig, LavaGrid, LavaPoint, Law, Move,
    PointConfig, Step, World,
};
use nalgebra::Vector2;
use rand::RngExt;
use rand_distr::StandardNormal;

/// What the suite has to know about a world beyond the trait.
trait Subject: World + Sized {
    fn create(episodes: usize) -> Self;
    fn random_action(random: &mut ChaCha8Rng) -> Self::Action;
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
    fn rewards(&self) -> (f64, f64, f64) {
        (self.constants().goal_reward, self.constants().lava_reward, self.constants().step_cost)
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
    fn rewards(&self) -> (f64, f64, f64) {
        (self.constants().goal_reward, self.constants().lava_reward, self.constants().step_cost)
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

/// Episodes cut anywhere continue in another batch, in other slots, and through a file's text.
fn a_restored_episode_continues_bit_for_bit<W: Subject>() {
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

macro_rules! conformance {
    ($name:ident, $world:ty) => {
        mod $name {
            use super::*;
            #[test]
            fn episodes_end_by_the_rules() {
                super::episodes_end_by_the_rules::<$world>();
            }
            #[test]
            fn a_slot_is_what_it_would_be_alone() {
                super::a_slot_is_what_it_would_be_alone::<$world>();
            }
            #[test]
            fn a_restored_episode_continues_bit_for_bit() {
                super::a_restored_episode_continues_bit_for_bit::<$world>();
            }
        }
    };
}

conformance!(lava_grid, LavaGrid);
conformance!(lava_point, LavaPoint);

#[test]
fn the_grid_conforms() {
    check::<LavaGrid>(&GridConfig::default());
    let map = "S#.G\n.L..\n...#\n".to_owned();
    check::<LavaGrid>(&GridConfig { map, slip: 0.5, ..GridConfig::default() });
    check::<LavaGrid>(&GridConfig {
        map: "SG.".into(),
        slip: 0.0,
        horizon: 1,
        ..GridConfig::default()
    });
}

#[test]
fn the_point_mass_conforms() {
    check::<LavaPoint>(&PointConfig::default());
    check::<LavaPoint>(&PointConfig { noise: 0.0, horizon: 3, ..PointConfig::default() });
    // Speeds about those that observations are scaled by.
    check::<LavaPoint>(&PointConfig { noise: 4.0, substeps: 2, ..PointConfig::default() });
}

#[test]
fn states_that_a_world_does_not_have_are_refused() {
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
            let law: FiniteLaw<4> = world.law(0, chosen);
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
