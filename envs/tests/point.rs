//! `lava-point` against closed forms and brute force.

use lava_envs::point::{Rectangle, physics};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{End, Force, GaussianLaw, LavaPoint, Law, PointConfig, Step, World};
use nalgebra::Vector2;
use rand::RngExt;
use rand_distr::StandardNormal;

const REST: Force = Force(Vector2::new(0.0, 0.0));
const CALM: Vector2<f64> = Vector2::new(0.0, 0.0);

/// One control step of a single disc from a given state.
fn step_from(
    config: &PointConfig,
    position: [f64; 2],
    velocity: [f64; 2],
    action: Force,
    xi: Vector2<f64>,
) -> (LavaPoint, Step) {
    let mut world = LavaPoint::new(config, 1).unwrap();
    world.place(0, position, velocity);
    let mut steps = [Step::IDLE];
    world.apply(&[action], &[xi], &mut steps);
    (world, steps[0])
}

fn close(a: [f64; 2], b: [f64; 2], tolerance: f64) -> bool {
    (a[0] - b[0]).abs() <= tolerance && (a[1] - b[1]).abs() <= tolerance
}

/// x moves by (tau / n) v (1 + q + ... + q^(n-1)) with q = rho^(1/n), and v is multiplied by rho.
#[test]
fn free_flight_has_its_closed_form() {
    for (substeps, retention) in [(1, 0.5), (4, 0.5), (7, 0.9), (4, 1.0)] {
        let config =
            PointConfig { substeps, velocity_retention: retention, ..PointConfig::default() };
        let (start, velocity) = ([4.0, 4.5], [2.0, -1.5]);
        let (world, step) = step_from(&config, start, velocity, REST, CALM);
        let q = retention.powf(1.0 / f64::from(substeps));
        let sum: f64 = (0..substeps as i32).map(|k| q.powi(k)).sum();
        let way = 0.2 / f64::from(substeps) * sum;
        let expected = [start[0] + way * velocity[0], start[1] + way * velocity[1]];
        assert!(close(world.position(0), expected, 1e-5), "{:?}", world.position(0));
        let expected = velocity.map(|v| v * retention);
        assert!(close(world.velocity(0), expected, 1e-5), "{:?}", world.velocity(0));
        assert_eq!(step, Step { reward: -0.035, end: None });
    }
}

/// The push changes the velocity by A u + sigma xi whatever the mass is: impulses m A u and m sigma
/// xi on a body of mass m.
#[test]
fn a_push_is_an_impulse() {
    let pushes = [
        (Vector2::new(0.6, -0.3), Vector2::new(0.0, 0.0)),
        (Vector2::new(0.0, 0.0), Vector2::new(-1.2, 0.4)),
        (Vector2::new(-0.8, 0.1), Vector2::new(0.5, 2.0)),
    ];
    for mass in [0.25, 1.0, 40.0] {
        let config = PointConfig { mass, ..PointConfig::default() };
        for (u, xi) in pushes {
            let (world, _) = step_from(&config, [5.0, 4.5], [0.3, 0.7], Force(u), xi);
            let expected = (Vector2::new(0.3, 0.7) + 2.5 * u + 1.5 * xi) / 2.0;
            assert!(close(world.velocity(0), expected.into(), 1e-5));
        }
    }
}

#[test]
fn long_pushes_are_scaled_onto_the_unit_disc() {
    let config = PointConfig::default();
    let long = Force(Vector2::new(3.0, 4.0));
    let (world, _) = step_from(&config, [4.0, 4.0], [0.0, 0.0], long, CALM);
    let unit = Force(Vector2::new(0.6, 0.8));
    let (same, _) = step_from(&config, [4.0, 4.0], [0.0, 0.0], unit, CALM);
    assert!(close(world.velocity(0), same.velocity(0), 1e-6));
    let mut situation = [0.0; 4];
    world.situation(0, long, &mut situation);
    let mean = world.mean_velocity(0, long);
    assert!((mean - Vector2::from(world.velocity(0)) - 2.5 * unit.0).norm() < 1e-12);
    assert_eq!(situation[2..], [(mean.x / 4.0) as f32, (mean.y / 4.0) as f32]);
}

/// Against the motion of a point that is clamped to the inner rectangle of the arena in each substep
/// and loses the velocity into the wall, but none along it.
#[test]
fn walls_stop_without_rebound_and_without_friction() {
    let config = PointConfig::default();
    let mut random = stream(1, Purpose::Outcomes, 0);
    let mut touched = 0;
    for _ in 0..20_000 {
        let position = [random.random_range(0.1..9.9), random.random_range(2.2..6.9)];
        let velocity = [random.random_range(-8.0..8.0), random.random_range(-8.0..8.0)];
        let (world, step) = step_from(&config, position, velocity, REST, CALM);
        if step.end.is_some() {
            continue;
        }
        let (mut x, mut v) = (position, velocity);
        for _ in 0..4 {
            for axis in 0..2 {
                let end = x[axis] + 0.05 * v[axis];
                let inside = end.clamp(0.1, [9.9, 6.9][axis]);
                if inside != end {
                    v[axis] = 0.0;
                    touched += 1;
                }
                x[axis] = inside;
                v[axis] *= 0.5_f64.powf(0.25);
            }
        }
        assert!(
            close(world.position(0), x, 2e-5) && close(world.velocity(0), v, 2e-5),
            "from {position:?}, {velocity:?}: {:?}, {:?} instead of {x:?}, {v:?}",
            world.position(0),
            world.velocity(0),
        );
    }
    assert!(touched > 1000, "only {touched} contacts");
}

/// The disc stays in the arena whatever the noise: twelve standard deviations in all directions,
/// from the middle, from walls and from corners, and at a noise far beyond any speed limit.
#[test]
fn walls_hold_at_any_noise() {
    let lava = Rectangle { min: [4.9, 3.0], max: [5.1, 3.2] };
    let goal = Rectangle { min: [4.9, 3.5], max: [5.1, 3.7] };
    let config = PointConfig { lava, goal, ..PointConfig::default() };
    let starts = [[5.0, 5.0], [0.1, 0.1], [9.9, 6.9], [0.1, 3.0], [5.0, 6.9], [9.85, 0.15]];
    let mut world = LavaPoint::new(&config, 360 * starts.len()).unwrap();
    let slots = world.episodes();
    for length in [12.0, 1000.0] {
        for slot in 0..slots {
            world.place(slot, starts[slot % starts.len()], [0.0, 0.0]);
        }
        let mut steps = vec![Step::IDLE; slots];
        for time in 0..10 {
            let (pushes, noise): (Vec<_>, Vec<_>) = (0..slots)
                .map(|slot| {
                    // Along the same direction each time, then back and forth across the arena.
                    let sign = if time < 4 || time % 2 == 0 { 1.0 } else { -1.0 };
                    let angle = ((slot / starts.len()) as f64).to_radians();
                    let direction = sign * Vector2::new(angle.cos(), angle.sin());
                    (Force(direction), length * direction)
                })
                .unzip();
            world.apply(&pushes, &noise, &mut steps);
            for slot in 0..slots {
                let [x, y] = world.position(slot);
                let inside = (0.1 - 1e-4..=9.9 + 1e-4).contains(&x)
                    && (0.1 - 1e-4..=6.9 + 1e-4).contains(&y);
                assert!(inside, "slot {slot} is at ({x}, {y}) at noise {length}");
                let [vx, vy] = world.velocity(slot);
                assert!(vx.hypot(vy) <= physics::speed_limit(&config));
            }
        }
    }
}

/// The discs that pass over the corner of the lava between two substeps are caught.
#[test]
fn the_corner_of_the_lava_is_not_jumped() {
    let config = PointConfig::default();
    // From the left of the lava to below it, across the corner (2, 2), in one substep.
    let (world, step) = step_from(&config, [1.6, 1.5], [20.0, 20.0 * 0.62 / 0.7], REST, CALM);
    assert_eq!(step, Step { reward: -1.0, end: Some(End::Lava) });
    assert!(world.clearance(0) < 1e-5);
    // A little further out the disc passes.
    let (world, step) = step_from(&config, [1.6, 1.95], [20.0, 20.0 * 0.62 / 0.7], REST, CALM);
    assert_eq!(step.end, None);
    assert!(world.clearance(0) > 0.0);
}

/// A disc that does not move at all has no direction to cast a ray along.
#[test]
fn a_resting_disc_beside_a_corner_touches_nothing() {
    let config = PointConfig::default();
    let (world, step) = step_from(&config, [1.92, 2.08], [0.0, 0.0], REST, CALM);
    assert_eq!(step.end, None);
    assert!(close(world.position(0), [1.92, 2.08], 1e-6));
    let (_, step) = step_from(&config, [1.95, 2.05], [0.0, 0.0], REST, CALM);
    assert_eq!(step.end, Some(End::Lava));
    let (_, step) = step_from(&config, [9.0, 0.9], [0.0, 0.0], REST, CALM);
    assert_eq!(step.end, Some(End::Goal));
}

/// Random fast motions against the distances along a finely sampled path.
#[test]
fn impacts_agree_with_a_finely_sampled_path() {
    let config = PointConfig { substeps: 1, velocity_retention: 1.0, ..PointConfig::default() };
    let distance = |rectangle: Rectangle, p: [f64; 2]| {
        let outside = |axis: usize| {
            (rectangle.min[axis] - p[axis]).max(p[axis] - rectangle.max[axis]).max(0.0)
        };
        outside(0).hypot(outside(1))
    };
    let mut random = stream(4, Purpose::Outcomes, 0);
    let mut counts = [0; 3];
    for _ in 0..20_000 {
        // Half of the paths lie about the goal.
        let left = if random.random() { 0.2 } else { 8.3 };
        let start = [random.random_range(left..9.8), random.random_range(0.2..4.0)];
        let stop = [random.random_range(left..9.8), random.random_range(0.2..4.0)];
        if distance(config.lava, start) <= 0.11 || distance(config.goal, start) <= 0.01 {
            continue;
        }
        let way = [stop[0] - start[0], stop[1] - start[1]];
        let velocity = way.map(|length| length / 0.2);
        if velocity[0].hypot(velocity[1]) > 40.0 {
            continue;
        }
        let (world, step) = step_from(&config, start, velocity, REST, CALM);

        // Two answers, for a disc and a goal that are a little larger or smaller: where both agree
        // the case is clear.
        let sampled = |slack: f64| {
            (0..=2000).find_map(|index| {
                let s = f64::from(index) / 2000.0;
                let p = [start[0] + s * way[0], start[1] + s * way[1]];
                if distance(config.lava, p) <= config.radius + slack {
                    Some((End::Lava, p))
                } else if distance(config.goal, p) <= slack.max(0.0) {
                    Some((End::Goal, p))
                } else {
                    None
                }
            })
        };
        let (wide, narrow) = (sampled(0.006), sampled(-0.006));
        if wide.map(|(end, _)| end) != narrow.map(|(end, _)| end) {
            continue;
        }
        assert_eq!(step.end, wide.map(|(end, _)| end), "{start:?} to {stop:?}");
        counts[match step.end {
            Some(End::Lava) => 0,
            Some(End::Goal) => 1,
            _ => 2,
        }] += 1;
        match wide {
            Some((End::Lava, _)) => assert!(world.clearance(0) < 1e-5),
            Some((End::Goal, _)) => assert!(distance(config.goal, world.position(0)) < 1e-5),
            _ => assert!(close(world.position(0), stop, 1e-4)),
        }
    }
    assert!(counts.iter().all(|&count| count > 300), "{counts:?}");
}

#[test]
fn lava_comes_first_when_both_are_met_at_once() {
    // The goal region begins where the disc touches the lava.
    let lava = Rectangle { min: [4.0, 3.0], max: [5.0, 4.0] };
    let goal = Rectangle { min: [3.5, 3.0], max: [3.9, 4.0] };
    let config = PointConfig { lava, goal, radius: 0.5, ..PointConfig::default() };
    let start = PointConfig { start: [1.0, 1.0], ..config };
    let (_, step) = step_from(&start, [3.0, 3.5], [5.0, 0.0], REST, CALM);
    assert_eq!(step, Step { reward: -1.0, end: Some(End::Lava) });
    // A disc that is a little smaller reaches the goal first, in the same substep.
    let smaller = PointConfig { radius: 0.49, ..start };
    let (_, step) = step_from(&smaller, [3.0, 3.5], [15.0, 0.0], REST, CALM);
    assert_eq!(step, Step { reward: 1.0, end: Some(End::Goal) });
}

#[test]
fn clearance_is_the_distance_from_surface_to_lava() {
    let mut world = LavaPoint::new(&PointConfig::default(), 1).unwrap();
    for (position, expected) in [
        ([5.0, 4.0], 1.9),
        ([1.0, 1.0], 0.9),
        ([1.7, 2.4], 0.4), // a corner: 0.3, 0.4, 0.5
        ([2.0, 2.1], 0.0),
    ] {
        world.place(0, position, [0.0, 0.0]);
        assert!((world.clearance(0) - expected).abs() < 1e-6, "{position:?}");
    }
}

/// A controller with a fixed plan: down to the middle row, to the right, and up to the goal.
fn planned(world: &LavaPoint, slot: usize) -> Force {
    let [x, y] = world.position(slot);
    let target =
        if x < 8.6 { if x < 1.5 && y < 3.0 { [0.7, 4.3] } else { [9.4, 4.0] } } else { [9.5, 0.5] };
    let velocity = Vector2::from(world.velocity(slot));
    let error = Vector2::from(target) - Vector2::from(world.position(slot));
    Force((error * 3.0 - velocity) / 2.5)
}

/// Returns of the planned controller; the noise of an episode depends only on its number.
fn returns(config: &PointConfig, episodes: usize) -> Vec<f64> {
    let mut world = LavaPoint::new(config, episodes).unwrap();
    let mut random: Vec<ChaCha8Rng> =
        (0..episodes).map(|slot| stream(9, Purpose::Outcomes, slot as u64)).collect();
    let mut returns = vec![0.0; episodes];
    let mut steps = vec![Step::IDLE; episodes];
    for _ in 0..config.horizon {
        let actions: Vec<_> = (0..episodes).map(|slot| planned(&world, slot)).collect();
        let outcomes: Vec<_> = random.iter_mut().map(|random| GaussianLaw.sample(random)).collect();
        world.apply(&actions, &outcomes, &mut steps);
        for (sum, step) in returns.iter_mut().zip(&steps) {
            *sum += step.reward;
        }
    }
    returns
}

fn mean(sample: &[f64]) -> f64 {
    sample.iter().sum::<f64>() / sample.len() as f64
}

/// The way of a control step is v tau (1 - rho) / (n (1 - rho^(1/n))), because damping acts after each
/// substep: n belongs to the definition of the world (n = 8 makes all ways 4 % shorter). With the
/// length of the control step corrected for it, halving the substep changes the mean return of a
/// fixed controller by less than its standard error, walls included.
#[test]
fn the_substep_does_not_decide_the_return() {
    let way = |n: f64| 0.5 / (n * (1.0 - 0.5_f64.powf(1.0 / n)));
    let config = PointConfig::default();
    let finer = PointConfig {
        substeps: 8,
        control_step: config.control_step * way(4.0) / way(8.0),
        ..config.clone()
    };
    let (coarse, fine) = (returns(&config, 4000), returns(&finer, 4000));
    let average = mean(&coarse);
    let variance = mean(&coarse.iter().map(|j| (j - average).powi(2)).collect::<Vec<_>>());
    let error = (variance / 4000.0).sqrt();
    assert!(average > 0.0, "the controller should reach the goal, mean return {average}");
    let change = mean(&fine) - average;
    assert!(change.abs() < error, "{change} with a standard error of {error}");
}

/// Free flight and walls outside Rapier are Rapier's, bit for bit, along whole episodes.
#[test]
fn motion_is_rapiers_bit_for_bit() {
    check_motion(&PointConfig::default(), 400);
    check_motion(&PointConfig { noise: 4.0, ..PointConfig::default() }, 100);
    let other = PointConfig {
        arena: [11.3, 6.7],
        mass: 2.7,
        radius: 0.23,
        substeps: 3,
        control_step: 0.13,
        ..PointConfig::default()
    };
    check_motion(&other, 200);
}

fn check_motion(config: &PointConfig, times: u32) {
    let mut fast = LavaPoint::new(config, 200).unwrap();
    let mut rapier = LavaPoint::by_rapier_alone(config, 200).unwrap();
    let mut random = stream(6, Purpose::Outcomes, 0);
    let (mut steps, mut same) = (vec![Step::IDLE; 200], vec![Step::IDLE; 200]);
    for time in 0..times {
        let (actions, outcomes): (Vec<_>, Vec<_>) = (0..200)
            .map(|slot| {
                let planned = planned(&fast, slot);
                let random_push = Force(Vector2::new(
                    random.sample(StandardNormal),
                    random.sample(StandardNormal),
                ));
                let push = if slot % 2 == 0 { planned } else { random_push };
                (push, GaussianLaw.sample(&mut random))
            })
            .unzip();
        fast.apply(&actions, &outcomes, &mut steps);
        rapier.apply(&actions, &outcomes, &mut same);
        assert_eq!(steps, same, "time {time}");
        for (slot, step) in steps.iter().enumerate() {
            let bits = |world: &LavaPoint| {
                (world.position(slot).map(f64::to_bits), world.velocity(slot).map(f64::to_bits))
            };
            assert_eq!(bits(&fast), bits(&rapier), "slot {slot} at time {time}");
            if step.end.is_some() {
                fast.reset(slot);
                rapier.reset(slot);
            }
        }
    }
}

#[test]
#[should_panic(expected = "is not finite")]
fn an_action_that_is_no_number_is_refused() {
    let config = PointConfig::default();
    step_from(&config, [1.0, 4.0], [0.0, 0.0], Force(Vector2::new(f64::NAN, 0.0)), CALM);
}

fn refusal(config: &PointConfig) -> String {
    LavaPoint::new(config, 1).err().expect("the configuration should be refused").to_string()
}

#[test]
fn refusals_name_field_value_and_range() {
    let base = PointConfig::default;
    let cases = [
        (PointConfig { arena: [0.0, 7.0], ..base() }, "arena = [0.0, 7.0] is not allowed"),
        (
            PointConfig { lava: Rectangle { min: [2.0, 0.0], max: [12.0, 2.0] }, ..base() },
            "inside the arena [0, 10] x [0, 7]",
        ),
        (
            PointConfig { goal: Rectangle { min: [9.0, 1.0], max: [9.0, 2.0] }, ..base() },
            "goal = Rectangle",
        ),
        (PointConfig { start: [0.05, 0.5], ..base() }, "start = [0.05, 0.5] is not allowed"),
        (PointConfig { start: [1.95, 1.0], ..base() }, "touch neither lava"),
        (PointConfig { start: [9.5, 0.5], ..base() }, "a goal region"),
        (
            PointConfig { radius: 3.5, ..base() },
            "radius = 3.5 is not allowed: above 0 and below 3.5",
        ),
        (PointConfig { radius: f64::NAN, ..base() }, "radius = NaN"),
        (PointConfig { mass: 0.0, ..base() }, "mass = 0.0 is not allowed: in [0.001, 1000] kg"),
        (PointConfig { acceleration: -1.0, ..base() }, "acceleration = -1.0"),
        (PointConfig { noise: f64::INFINITY, ..base() }, "noise = inf"),
        (PointConfig { control_step: 0.0, ..base() }, "control_step = 0.0"),
        (PointConfig { substeps: 0, ..base() }, "substeps = 0 is not allowed: from 1 to 1000"),
        (PointConfig { velocity_retention: 0.0, ..base() }, "velocity_retention = 0.0"),
        (PointConfig { velocity_retention: 1.1, ..base() }, "velocity_retention = 1.1"),
        (PointConfig { step_cost: -0.1, ..base() }, "step_cost = -0.1"),
        (PointConfig { goal_reward: f64::NAN, ..base() }, "goal_reward = NaN"),
        (PointConfig { horizon: 0, ..base() }, "horizon = 0 is not allowed: from 1 to 1000000"),
    ];
    for (config, expected) in cases {
        let message = refusal(&config);
        assert!(message.contains(expected), "{message:?} lacks {expected:?}");
    }
}

#[test]
fn configurations_are_read_from_toml() {
    let changed = |from: &str, to: &str| {
        assert!(LavaPoint::DEFAULTS.contains(from), "{from}");
        toml::from_str::<PointConfig>(&LavaPoint::DEFAULTS.replace(from, to))
    };
    let config = changed("noise = 1.5", "noise = 1").unwrap();
    assert_eq!((config.noise, config.lava.min, config.horizon), (1.0, [2.0, 0.0], 40));
    assert_eq!(changed("min = [2.0, 0.0]", "min = [3, 0]").unwrap().lava.min, [3.0, 0.0]);
    assert!(changed("horizon = 40", "").is_err());
    assert!(changed("horizon = 40", "horizon = 40\ngravity = 9.81").is_err());
    assert!(changed("min = [2.0, 0.0]", "min = [2.0, 0.0]\nx = 1").is_err());
    let text = toml::to_string(&PointConfig::default()).unwrap();
    assert_eq!(toml::from_str::<PointConfig>(&text).unwrap(), PointConfig::default());
}

/// A room of walls inside a larger arena.
fn room() -> PointConfig {
    PointConfig {
        arena: [14.0, 11.0],
        lava: Rectangle { min: [4.0, 2.0], max: [10.0, 4.0] },
        goal: Rectangle { min: [11.0, 2.0], max: [12.0, 3.0] },
        start: [2.5, 2.5],
        walls: vec![
            [0.0, 0.0, 2.0, 11.0],
            [12.0, 0.0, 14.0, 11.0],
            [2.0, 0.0, 12.0, 2.0],
            [2.0, 9.0, 12.0, 11.0],
        ],
        ..PointConfig::default()
    }
}

/// A wall inside the arena stops a disc as the arena's sides do, which Rapier decides.
#[test]
fn walls_inside_stop_as_the_sides_of_the_arena_do() {
    let (inner, outer) = (room(), PointConfig::default());
    inner.validate().unwrap();
    let mut random = stream(2, Purpose::Outcomes, 0);
    let mut touched = 0;
    for _ in 0..20_000 {
        let position = [random.random_range(0.11..9.89), random.random_range(2.2..6.89)];
        let velocity = [random.random_range(-8.0..8.0), random.random_range(-8.0..8.0)];
        let (expected, step) = step_from(&outer, position, velocity, REST, CALM);
        let (found, same) = step_from(&inner, position.map(|c| c + 2.0), velocity, REST, CALM);
        assert_eq!(found.time(0), expected.time(0));
        assert_eq!(same, step, "from {position:?}, {velocity:?}");
        let here = found.position(0).map(|c| c - 2.0);
        assert!(
            close(here, expected.position(0), 3e-5)
                && close(found.velocity(0), expected.velocity(0), 3e-5),
            "from {position:?}, {velocity:?}: {here:?}, {:?} instead of {:?}, {:?}",
            found.velocity(0),
            expected.position(0),
            expected.velocity(0),
        );
        touched += usize::from((0..2).any(|axis| expected.velocity(0)[axis] == 0.0));
    }
    assert!(touched > 1000, "only {touched} contacts");
}

/// At a corner the component along the radius to the corner is lost, and no other.
#[test]
fn a_disc_slides_off_a_corner() {
    let config =
        PointConfig { walls: vec![[4.0, 4.0, 5.0, 5.0]], substeps: 1, ..PointConfig::default() };
    // It comes from above and touches the corner (4, 4) where the radius has the slope 3 : 4.
    let contact = [4.0 - 0.06, 4.0 - 0.08];
    let (world, _) = step_from(&config, [contact[0], contact[1] - 0.5], [0.0, 5.0], REST, CALM);
    // Of the way of 1 m half is left. Along the tangent (-4, 3) / 5 it is 0.3 m, and the speed 3 m/s, then damped.
    let expected = [contact[0] - 0.3 * 0.8, contact[1] + 0.3 * 0.6];
    assert!(close(world.position(0), expected, 1e-5), "{:?}", world.position(0));
    let expected = [-3.0 * 0.8 * 0.5, 3.0 * 0.6 * 0.5];
    assert!(close(world.velocity(0), expected, 1e-5), "{:?}", world.velocity(0));
}

/// However fast, a disc never enters a wall, nor leaves a room whose walls are thin and whose corners are narrow.
#[test]
fn walls_inside_hold_at_any_speed() {
    let mut walls = vec![
        [2.0, 3.0, 2.05, 6.0],
        [8.0, 3.0, 8.05, 6.0],
        [2.0, 3.0, 8.05, 3.05],
        [2.0, 5.95, 8.05, 6.0],
    ];
    // Pillars, and a wedge of two walls.
    for pillar in 0..6 {
        let x = 2.7 + 0.9 * f64::from(pillar);
        walls.push([x, 4.3, x + 0.2, 4.5]);
    }
    walls.push([3.0, 5.0, 3.5, 5.1]);
    walls.push([3.4, 5.0, 3.5, 5.6]);
    let config = PointConfig { walls: walls.clone(), ..PointConfig::default() };
    let slots = 2000;
    let mut world = LavaPoint::new(&config, slots).unwrap();
    let mut random = stream(3, Purpose::Outcomes, 0);
    for slot in 0..slots {
        world.place(slot, [2.4 + 0.002 * slot as f64, 3.6], [0.0, 0.0]);
    }
    let mut steps = vec![Step::IDLE; slots];
    for time in 0..30 {
        let scale = [1.0, 10.0, 1000.0][time % 3];
        let noise: Vec<_> = (0..slots)
            .map(|_| {
                scale
                    * Vector2::new(
                        random.sample::<f64, _>(StandardNormal),
                        random.sample::<f64, _>(StandardNormal),
                    )
            })
            .collect();
        world.apply(&vec![REST; slots], &noise, &mut steps);
        for slot in 0..slots {
            let [x, y] = world.position(slot);
            assert!(
                (2.139..=7.911).contains(&x) && (3.139..=5.861).contains(&y),
                "{x}, {y} is outside"
            );
            for &[left, top, right, bottom] in &walls {
                let gap = [(left - x).max(x - right).max(0.0), (top - y).max(y - bottom).max(0.0)];
                assert!(gap[0].hypot(gap[1]) >= 0.1 - 1e-4, "({x}, {y}) is in a wall");
            }
        }
    }
}

/// A world with one rectangle of lava and one in four parts are the same.
#[test]
fn lava_in_parts_is_lava() {
    let whole = PointConfig::default();
    let parts = PointConfig {
        lava: Rectangle { min: [2.0, 0.0], max: [5.0, 1.0] },
        more_lava: vec![[5.0, 0.0, 8.0, 1.0], [2.0, 1.0, 5.0, 2.0], [5.0, 1.0, 8.0, 2.0]],
        ..PointConfig::default()
    };
    let mut random = stream(4, Purpose::Outcomes, 0);
    let mut ends = 0;
    for _ in 0..20_000 {
        let position = [random.random_range(0.1..9.9), random.random_range(2.11..3.0)];
        let velocity = [random.random_range(-8.0..8.0), random.random_range(-8.0..8.0)];
        let (a, one) = step_from(&whole, position, velocity, REST, CALM);
        let (b, other) = step_from(&parts, position, velocity, REST, CALM);
        assert_eq!(one, other);
        assert!(close(a.position(0), b.position(0), 1e-5));
        assert!((a.clearance(0) - b.clearance(0)).abs() < 1e-6);
        ends += usize::from(one.end == Some(End::Lava));
    }
    assert!(ends > 1000, "only {ends} ends");
}
