//! The oracle of `lava-point` against independent truth: quadrature, the physical world, scripts.

use approx::assert_abs_diff_eq;
use cvar_game::exact::oracle::controller::{Controller, Protagonist, Scripted};
use cvar_game::exact::oracle::lattice::{Scene, Space, cubic};
use cvar_game::exact::oracle::play::play;
use cvar_game::exact::oracle::sweep::{Rewards, SWEPT, Utility, smoothed, sweep};
use cvar_game::exact::oracle::upper_bound::upper_bound;
use cvar_game::exact::oracle::{
    Certified, Effort, Lattice, certify, certify_cached, shipped, shipped_bound,
};
use cvar_game::exact::watch::Watch;
use lava_envs::law::{GaussianLaw, Law};
use lava_envs::point::Force;
use lava_envs::random::{Purpose, stream};
use lava_envs::{End, LavaPoint, PointConfig, Step, World};
use nalgebra::Vector2;
use rand::RngExt;

const COARSE: Lattice = Lattice { cell: 0.3, velocity: 0.75 };

fn small_effort() -> Effort {
    Effort {
        lattice: COARSE,
        episodes: 4_000,
        selection_episodes: 1_000,
        candidates: 2,
        baseline_episodes: 500,
        threads: 2,
    }
}

/// A world so short that sweeps of it take no time.
fn short() -> PointConfig {
    PointConfig { horizon: 6, start: [8.4, 2.6], ..PointConfig::default() }
}

#[test]
fn smoothing_is_the_gaussian_expectation() {
    let config = PointConfig::default();
    let space = Space::new(&config, &Lattice { cell: 1.5, velocity: 0.5 }, 1);
    let (plus, mean) = (2 * space.halves.plus + 1, 2 * space.halves.mean + 1);
    let f = |vx: f64, vy: f64| (0.4 * vx + 0.1).sin() * (0.3 * vy).cos() + 0.05 * vx * vy;
    let outcomes: Vec<f32> = (0..plus * plus)
        .map(|index| f(space.plus(index / plus), space.plus(index % plus)) as f32)
        .collect();
    let means = smoothed(&space, &outcomes);
    // E sin(a (m + s z) + b) = sin(a m + b) exp(-a^2 s^2 / 2), and so for the cosine.
    let damped = |a: f64| (-0.5 * a * a * config.noise * config.noise).exp();
    for (index, &found) in means.iter().enumerate() {
        let at = |index: usize| space.plus(index + space.halves.plus - space.halves.mean);
        let (vx, vy) = (at(index / mean), at(index % mean));
        let truth =
            (0.4 * vx + 0.1).sin() * damped(0.4) * (0.3 * vy).cos() * damped(0.3) + 0.05 * vx * vy;
        assert_abs_diff_eq!(f64::from(found), truth, epsilon = 1e-3);
    }
}

#[test]
fn smoothing_of_a_step_is_the_normal_distribution_function_up_to_its_cell() {
    // By quadrature of the density, with the step where a cell of v+ ends.
    let config = PointConfig::default();
    let space = Space::new(&config, &Lattice { cell: 1.5, velocity: 0.25 }, 1);
    let (plus, mean) = (2 * space.halves.plus + 1, 2 * space.halves.mean + 1);
    let step_at = 1.125;
    let outcomes: Vec<f32> = (0..plus * plus)
        .map(|index| if space.plus(index / plus) > step_at { 1.0 } else { 0.0 })
        .collect();
    let means = smoothed(&space, &outcomes);
    for k in 0..mean {
        let vbar = space.plus(k + space.halves.plus - space.halves.mean);
        let (count, reach) = (20_000, 8.0);
        let width = reach / f64::from(count);
        let density = |z: f64| (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
        let least = (step_at - vbar) / config.noise;
        let truth: f64 =
            (0..count).map(|i| density(least + (f64::from(i) + 0.5) * width) * width).sum();
        let truth = if least < -reach { 1.0 } else { truth };
        assert_abs_diff_eq!(f64::from(means[k * mean + mean / 2]), truth, epsilon = 2e-3);
    }
}

#[test]
fn cubic_weights_reproduce_cubics() {
    let f = |x: f64| 0.3 * x.powi(3) - x * x + 2.0 * x - 0.7;
    for share in [0.0, 0.2, 0.5, 0.9, 1.0] {
        let found: f64 =
            cubic(share).iter().zip(-1..).map(|(&w, x)| f64::from(w) * f(f64::from(x))).sum();
        assert_abs_diff_eq!(found, f(share), epsilon = 1e-6);
    }
}

/// One step of the real world from a place, with v+ fixed.
fn real_step(world: &mut LavaPoint, position: [f64; 2], plus: [f64; 2]) -> Step {
    world.place(0, position, [0.0, 0.0]);
    let noise = world.constants().noise;
    let mut steps = [Step::IDLE];
    let outcome = Vector2::from(plus) / noise;
    world.apply(&[Force(Vector2::zeros())], &[outcome], &mut steps);
    steps[0]
}

#[test]
fn the_move_is_that_of_the_physical_world() {
    for config in [PointConfig::default(), PointConfig { substeps: 7, ..PointConfig::default() }] {
        let scene = Scene::new(&config);
        let mut world = LavaPoint::new(&config, 1).expect("the constants are valid");
        let mut random = stream(1, Purpose::Outcomes, 0);
        let (mut ended, mut stopped) = (0, 0);
        for _ in 0..20_000 {
            let between = |low: f64, high: f64, share: f64| low + (high - low) * share;
            let position = [0, 1].map(|axis| {
                between(config.radius, config.arena[axis] - config.radius, random.random())
            });
            if scene.end_at(position).is_some() {
                continue;
            }
            let xi = GaussianLaw.sample(&mut random) * 5.0;
            let found = scene.step(position, [xi.x, xi.y]);
            let step = real_step(&mut world, position, [xi.x, xi.y]);
            let truth = step.end.filter(|&end| end != End::Timeout);
            if found.end.map(End::from) != truth {
                // The DP's lava is a tenth of a millimetre smaller, and so is its goal.
                let grazing = [1e-3, -1e-3].iter().any(|&shift| {
                    [[shift, 0.0], [0.0, shift]].iter().any(|[dx, dy]| {
                        let near = [position[0] + dx, position[1] + dy];
                        scene.step(near, [xi.x, xi.y]).end != found.end
                    })
                });
                assert!(grazing, "{position:?}, {xi:?}: {found:?}, but {truth:?}");
                continue;
            }
            let slack = if found.end.is_some() { 2e-2 } else { 1e-4 };
            let there = world.position(0);
            for (axis, place) in there.into_iter().enumerate() {
                assert_abs_diff_eq!(found.position[axis], place, epsilon = slack);
                if found.end.is_none() {
                    let speed = world.velocity(0)[axis];
                    assert_abs_diff_eq!(found.velocity[axis], speed, epsilon = 1e-3);
                    stopped += usize::from(speed.abs() < 1e-6);
                }
            }
            ended += usize::from(found.end.is_some());
        }
        assert!(ended > 1000 && stopped > 1000, "{ended} ends and {stopped} walls are too few");
    }
}

#[test]
fn landings_are_the_move_of_each_axis() {
    let config = PointConfig::default();
    let space = Space::new(&config, &COARSE, 1);
    let scene = Scene::new(&config);
    let count = 2 * space.halves.plus + 1;
    let ny = space.axes[1].nodes;
    for node in (0..space.nodes()).filter(|&node| space.stopped[node].is_none()) {
        for index in 0..count {
            let velocity = [space.plus(index), space.plus(count - 1 - index)];
            let moved = scene.step(space.position(node), velocity);
            if moved.end.is_some() {
                continue;
            }
            let places = [(0, node / ny, index), (1, node % ny, count - 1 - index)];
            for (axis, along, index) in places {
                let landing = space.landings[axis][along * count + index];
                let line = space.axes[axis];
                let place = line.at(landing.node) + line.step * f64::from(landing.share);
                assert_abs_diff_eq!(place, moved.position[axis], epsilon = 1e-5);
                let speed = space.plus(landing.velocity) * config.velocity_retention;
                assert_abs_diff_eq!(speed, moved.velocity[axis], epsilon = 1e-9);
            }
        }
    }
}

#[test]
fn the_programme_finds_the_value_of_one_step() {
    // One step before the time limit, at rest in the open: the goal is a matter of one draw, whose
    // probability under each push is estimated in the physical world.
    let config = PointConfig { horizon: 1, start: [8.6, 0.5], ..PointConfig::default() };
    let space = Space::new(&config, &Lattice { cell: 0.1, velocity: 0.25 }, 2);
    let rewards = Rewards::new(&config, 1.0);
    let value = sweep(&space, &rewards, Utility::Return, SWEPT, 2, false, &()).value;
    let controller = Controller::new(space, &rewards, Utility::Return, 2, &());
    assert_abs_diff_eq!(controller.value(), value, epsilon = 1e-12);
    let law = play(&config, 1.0, &controller, 40_000, 3, 2, &()).expect("the world is valid").law;
    let slack = 4.0 * law.mean_standard_error() + 0.01;
    assert_abs_diff_eq!(law.mean(), value, epsilon = slack);
}

#[test]
fn a_coarse_controller_beats_the_scripts() {
    let config = PointConfig::default();
    let rewards = Rewards::new(&config, 1.0);
    let space = Space::new(&config, &COARSE, 2);
    let mean = |protagonist: &dyn Protagonist| {
        play(&config, 1.0, protagonist, 2_000, 5, 2, &()).expect("the world is valid").law.mean()
    };
    let best = mean(&Controller::new(space, &rewards, Utility::Return, 2, &()));
    for scripted in Scripted::all(&config) {
        let mean = mean(&scripted);
        assert!(best > mean + 0.05, "{} has {mean}, the controller {best}", scripted.name());
    }
    assert!(best > 0.3, "the controller's mean is {best}");
}

#[test]
fn nothing_depends_on_the_number_of_threads() {
    let config = short();
    let one = certify(&config, 0.99, 4.0, &Effort { threads: 1, ..small_effort() }, &());
    let three = certify(&config, 0.99, 4.0, &Effort { threads: 3, ..small_effort() }, &());
    let (one, mut three) = (one.expect("valid"), three.expect("valid"));
    three.seconds = one.seconds;
    assert_eq!(one, three);
}

#[test]
fn certificates_are_kept_under_all_constants() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let effort = small_effort();
    let ask = |config: &PointConfig, eta: f64, effort: &Effort| {
        certify_cached(config, 1.0, eta, effort, folder.path(), &()).expect("valid")
    };
    let count = || std::fs::read_dir(folder.path()).expect("the folder is there").count();
    let first = ask(&short(), 4.0, &effort);
    assert_eq!(first, ask(&short(), 4.0, &Effort { threads: 1, ..effort.clone() }));
    assert_eq!(count(), 1);
    ask(&short(), 1.0, &effort);
    ask(&PointConfig { noise: 1.0, ..short() }, 4.0, &effort);
    ask(&short(), 4.0, &Effort { episodes: 2_000, ..effort.clone() });
    assert_eq!(count(), 4);
    // A file that is cut short is replaced.
    for entry in std::fs::read_dir(folder.path()).expect("the folder is there") {
        std::fs::write(entry.expect("an entry").path(), "{\"key\":").expect("writable");
    }
    let again = ask(&short(), 4.0, &effort);
    assert_eq!((again.certified_cvar, count()), (first.certified_cvar, 4));
}

/// The shipped certificates are those of today's default world and effort: whoever changes one of them
/// has to compute the certificates again.
#[test]
fn the_default_world_has_shipped_certificates() {
    let config = PointConfig::default();
    let effort = Effort::of(&config);
    let etas = [
        (1.0, 0.35),
        (2.0, 0.28),
        (5.0, 0.2),
        (10.0, 0.15),
        (25.0, 0.06),
        (50.0, 0.03),
        (100.0, -0.03),
    ];
    for (eta, promised) in etas {
        let certified = shipped(&config, 1.0, eta, &effort).expect("it is shipped");
        assert_eq!((certified.eta, certified.lattice), (eta, effort.lattice));
        assert!(certified.certified_cvar_lo >= promised, "eta {eta}: {certified}");
        assert!(certified.episodes >= 200_000);
        let law = &certified.law;
        assert!((law.cvar(certified.alpha) - certified.certified_cvar).abs() < 1e-9);
    }
    assert_eq!(shipped(&config, 0.99, 25.0, &effort), None, "another discount");
    assert_eq!(shipped(&config, 1.0, 26.0, &effort), None, "another budget");
    assert_eq!(shipped(&PointConfig { noise: 1.4, ..config }, 1.0, 25.0, &effort), None);
}

/// Of a world at a budget, with few episodes.
fn quick(config: &PointConfig, eta: f64) -> Certified {
    let effort = Effort {
        episodes: 20_000,
        selection_episodes: 10_000,
        baseline_episodes: 5_000,
        ..Effort::of(config)
    };
    let lattice = Lattice { cell: 0.3, ..effort.lattice };
    certify(config, 1.0, eta, &Effort { lattice, ..effort }, &()).expect("valid")
}

#[test]
fn the_lattice_fits_the_noise() {
    for noise in [0.05, 0.5] {
        let config = PointConfig { noise, ..PointConfig::default() };
        let certified = quick(&config, 25.0);
        let best = certified.baselines.iter().map(|of| of.cvar).fold(f64::MIN, f64::max);
        assert!(certified.certified_cvar >= best, "noise {noise}: {certified}");
        assert!(certified.lattice_value < 1.0, "noise {noise}: {certified}");
        assert_eq!(certified.doubt(), None, "noise {noise}: {certified}");
    }
}

#[test]
fn kernels_have_the_variance_of_the_noise() {
    for noise in [0.0, 0.05, 0.3, 0.36, 0.5, 1.5, 4.0] {
        let config = PointConfig { noise, ..PointConfig::default() };
        let space = Space::new(&config, &Lattice { cell: 1.5, velocity: 0.5 }, 1);
        let wide = (space.kernel.len() / 2) as f64;
        let moment = |power: i32| -> f64 {
            let nodes = space.kernel.iter().enumerate();
            nodes.map(|(m, &w)| f64::from(w) * (0.5 * (m as f64 - wide)).powi(power)).sum()
        };
        assert_abs_diff_eq!(moment(0), 1.0, epsilon = 1e-6);
        assert_abs_diff_eq!(moment(1), 0.0, epsilon = 1e-6);
        // The lattice of v+ ends at four standard deviations.
        assert_abs_diff_eq!(moment(2), noise * noise, epsilon = 2e-3 * noise * noise + 1e-9);
    }
}

#[test]
fn the_lattice_of_the_default_world_is_the_documented_one() {
    let config = PointConfig::default();
    assert_eq!(Lattice::of(&config), Lattice { cell: 0.1, velocity: 0.5 });
    let far = PointConfig { horizon: 900, ..config };
    let coarser = Lattice::of(&far);
    assert!(coarser.cell > 0.1 && Space::bytes(&far, &coarser) < 3e9, "{coarser:?}");
}

/// A script that is best is what is certified: a world of one step, in which nothing can be done.
#[test]
fn no_script_is_better_than_the_answer() {
    let config = PointConfig { horizon: 1, ..PointConfig::default() };
    let certified = quick(&config, 25.0);
    assert_eq!(certified.certified_cvar, -0.035, "{certified}");
}

#[test]
fn a_contradiction_is_told() {
    let config = short();
    let mut certified = certify(&config, 1.0, 4.0, &small_effort(), &()).expect("valid");
    certified.lattice_value = certified.certified_cvar;
    assert!(!certified.to_string().contains("WARNING"), "{certified}");
    certified.lattice_value += 1.01 * certified.lattice_error
        + 1.01 * 0.75 * (certified.certified_cvar_hi - certified.certified_cvar_lo);
    assert!(certified.to_string().contains("WARNING"), "{certified}");
}

/// Above what is certified, on the scenes that the program comes with and on a short world.
#[test]
fn the_upper_bound_is_above_what_is_attained() {
    for (config, cell) in [(PointConfig::default(), 0.5), (short(), 0.2)] {
        let bound = upper_bound(&config, cell, 2, &());
        let mut before = 1.0;
        for eta in [1.0, 2.0, 25.0, 100.0, 1e4] {
            let upper = bound.at(1.0 / eta);
            assert!(upper <= before, "eta {eta}: {upper} above {before}");
            before = upper;
        }
        let attained = quick(&config, 25.0);
        assert!(bound.at(0.04) > attained.certified_cvar_lo, "{bound:?}");
        assert!(bound.at(0.04) < 0.9, "{bound:?}");
        assert_eq!(bound, upper_bound(&config, cell, 1, &()), "it depends on the threads");
    }
    let config = PointConfig::default();
    let bound = shipped_bound(&config).expect("it is shipped");
    for eta in [1.0, 2.0, 5.0, 10.0, 25.0, 50.0, 100.0] {
        let certified = shipped(&config, 1.0, eta, &Effort::of(&config)).unwrap();
        let apart = bound.at(1.0 / eta) - certified.certified_cvar_hi;
        assert!(apart > 0.0 && apart < 0.2, "eta {eta}: {apart}");
    }
}

#[test]
fn progress_goes_from_nothing_to_all() {
    struct Seen(std::sync::Mutex<Vec<f64>>);
    impl Watch for Seen {
        fn done(&self, share: f64) {
            self.0.lock().unwrap().push(share);
        }
    }
    let seen = Seen(std::sync::Mutex::new(Vec::new()));
    let effort = Effort { threads: 1, ..small_effort() };
    certify(&short(), 1.0, 4.0, &effort, &seen).expect("valid");
    let seen = seen.0.into_inner().unwrap();
    assert!(seen.is_sorted() && seen.len() > 50, "{seen:?}");
    // Some thresholds of the search may need no look.
    assert!(seen[0] < 0.1 && (0.7..=1.0).contains(seen.last().unwrap()), "{seen:?}");
}

#[test]
fn bad_arguments_are_told() {
    let refused = |gamma: f64, eta: f64, lattice: Lattice| {
        let effort = Effort { lattice, ..small_effort() };
        certify(&short(), gamma, eta, &effort, &()).expect_err("out of range").to_string()
    };
    assert!(refused(1.0, 0.5, COARSE).contains("0.5"));
    assert!(refused(0.0, 2.0, COARSE).contains("gamma"));
    assert!(refused(1.0, 2.0, Lattice { cell: 0.0, ..COARSE }).contains("cell"));
    assert!(refused(1.0, 2.0, Lattice { velocity: 0.1, ..COARSE }).contains("velocity"));
    assert!(refused(1.0, 2.0, Lattice { cell: 0.01, ..COARSE }).contains("GiB"));
}

/// Minutes. The promises of the default resolution, and that a finer lattice is not worse.
#[test]
#[ignore = "takes minutes and gibibytes"]
fn the_default_lattice_keeps_its_promises_and_a_finer_one_is_not_worse() {
    let config = PointConfig::default();
    let coarser = Lattice { cell: 0.2, velocity: 0.5 };
    let effort = Effort::of(&config);
    let at = |eta: f64, lattice: Lattice| {
        certify(&config, 1.0, eta, &Effort { lattice, ..effort.clone() }, &()).expect("valid")
    };
    for (eta, promised) in [(1.0, 0.35), (25.0, 0.06), (100.0, -0.03)] {
        let certified = at(eta, effort.lattice);
        assert!(certified.certified_cvar >= promised, "eta {eta}: {certified}");
        let known = shipped(&config, 1.0, eta, &effort).expect("it is shipped");
        assert!((certified.certified_cvar - known.certified_cvar).abs() < 1e-6, "eta {eta}");
        for baseline in &certified.baselines {
            assert!(certified.certified_cvar_lo > baseline.cvar, "eta {eta}: {baseline:?}");
        }
        let coarse = at(eta, coarser);
        assert!(certified.certified_cvar_hi >= coarse.certified_cvar_lo, "eta {eta}");
    }
}
