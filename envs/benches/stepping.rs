//! Control steps per second of a batch of 250 episodes with random actions, observation included.
//!
//! Random pushes keep discs at the walls more than a policy does. `lava-point/open` is the same batch
//! with the walls out of reach, so that Rapier is not called: the difference to `lava-point/batch` is
//! the time of Rapier's pipeline. `lava-point/rapier-alone` computes every substep of every disc in
//! Rapier, free flight included: the difference is what the separate free flight saves. `scenes` are those of the
//! program, in the plane.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lava_envs::map::Map;
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{
    Discrete, Force, GridConfig, LavaGrid, LavaPoint, Law, Move, PointConfig, Step, World,
};
use nalgebra::Vector2;
use rand::RngExt;
use rand_distr::StandardNormal;
use std::hint::black_box;

const EPISODES: usize = 250;

/// Drives a batch; episodes that end are reset at once.
struct Driver<W: World> {
    world: W,
    random: ChaCha8Rng,
    actions: Vec<W::Action>,
    outcomes: Vec<<W::Law as Law>::Outcome>,
    steps: Vec<Step>,
    observations: Vec<f32>,
}

impl<W: World> Driver<W> {
    fn new(world: W) -> Self {
        Driver {
            world,
            random: stream(1, Purpose::Actions, 0),
            actions: Vec::with_capacity(EPISODES),
            outcomes: Vec::with_capacity(EPISODES),
            steps: vec![Step::IDLE; EPISODES],
            observations: vec![0.0; EPISODES * W::OBSERVATION],
        }
    }

    fn step(&mut self, mut action: impl FnMut(&mut ChaCha8Rng) -> W::Action) {
        self.actions.clear();
        self.outcomes.clear();
        for slot in 0..EPISODES {
            let action = action(&mut self.random);
            self.actions.push(action);
            self.outcomes.push(self.world.law(slot, action).sample(&mut self.random));
        }
        self.world.apply(&self.actions, &self.outcomes, &mut self.steps);
        for (slot, observation) in self.observations.chunks_exact_mut(W::OBSERVATION).enumerate() {
            if self.steps[slot].end.is_some() {
                self.world.reset(slot);
            }
            self.world.observe(slot, observation);
        }
        black_box(&self.observations);
    }
}

fn push(random: &mut ChaCha8Rng) -> Force {
    Force(Vector2::new(random.sample(StandardNormal), random.sample(StandardNormal)))
}

fn stepping(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("control-steps");
    group.throughput(Throughput::Elements(EPISODES as u64));

    let mut grid = Driver::new(LavaGrid::new(&GridConfig::default(), EPISODES).unwrap());
    group.bench_function("lava-grid/batch", |bencher| {
        bencher.iter(|| grid.step(|random| Move::from_index(random.random_range(0..4))));
    });

    let config = PointConfig::default();
    let mut point = Driver::new(LavaPoint::new(&config, EPISODES).unwrap());
    group.bench_function("lava-point/batch", |bencher| {
        bencher.iter(|| point.step(push));
    });

    let open = PointConfig { arena: [1000.0; 2], start: [500.0; 2], ..PointConfig::default() };
    let mut open = Driver::new(LavaPoint::new(&open, EPISODES).unwrap());
    group.bench_function("lava-point/open", |bencher| {
        bencher.iter(|| open.step(push));
    });

    let mut rapier = Driver::new(LavaPoint::by_rapier_alone(&config, EPISODES).unwrap());
    group.bench_function("lava-point/rapier-alone", |bencher| {
        bencher.iter(|| rapier.step(push));
    });

    // Pillars all over the arena, along which discs slide.
    let pillar = |x: u32, y: u32| [f64::from(x), f64::from(y)].map(|c| 1.3 + 1.2 * c);
    let places = (0..7).flat_map(|x| (0..4).map(move |y| pillar(x, y)));
    let walls = places.map(|[x, y]| [x, y + 0.9, x + 0.4, y + 1.3]).collect();
    let pillars = PointConfig { walls, ..PointConfig::default() };
    let mut pillars = Driver::new(LavaPoint::new(&pillars, EPISODES).unwrap());
    group.bench_function("lava-point/pillars", |bencher| {
        bencher.iter(|| pillars.step(push));
    });
    group.finish();
}

/// lava-point on every scene of `configs/scenes`.
fn scenes(criterion: &mut Criterion) {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/scenes");
    let mut files: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let mut group = criterion.benchmark_group("scenes");
    group.throughput(Throughput::Elements(EPISODES as u64));
    for file in files {
        let scene: toml::Table = std::fs::read_to_string(&file).unwrap().parse().unwrap();
        let map = Map::parse(scene["map"].as_str().unwrap()).unwrap();
        let mut constants = toml::Table::try_from(PointConfig::default()).unwrap();
        constants.extend(LavaPoint::of_map(&map).unwrap());
        let config: PointConfig = constants.try_into().unwrap();
        let mut point = Driver::new(LavaPoint::new(&config, EPISODES).unwrap());
        group.bench_function(file.file_stem().unwrap().to_str().unwrap(), |bencher| {
            bencher.iter(|| point.step(push));
        });
    }
    group.finish();
}

criterion_group!(benches, stepping, scenes);
criterion_main!(benches);
