//! Environment steps per second of the parts of training, and of training itself, with the default
//! options, one thread and eta = 25.
//!
//! The worlds alone are in `envs/benches/stepping.rs`. `cargo xtask speed` runs both and makes a table.
//! Every benchmark's throughput is in environment steps, so that the times of the parts add up:
//!
//! | benchmark | what one environment step is |
//! |---|---|
//! | `perturbation/FAMILY/make` | one perturbation from its parameters |
//! | `perturbation/FAMILY/learn` | likelihood ratio, score and entropy as well |
//! | `rollout/WORLD` | one step of one of 250 episodes, recorded for both players |
//! | `update/WORLD/PLAYER` | one sample of the rollout: critic, advantages, all epochs |
//! | `train/WORLD` | all of it: Algorithm 1 with the antagonist awake from the start |

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use cvar_game::experiment::config::Config;
use cvar_game::experiment::names::WorldName;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::perturbation::{Family, Perturbation};
use cvar_game::options::TrainOptions;
use cvar_learn::arena::Arena;
use cvar_learn::contest::Choosing;
use cvar_learn::pair::Pair;
use cvar_learn::ppo::Rates;
use cvar_learn::price::Spending;
use cvar_learn::rollout::Collector;
use cvar_learn::train::{Game, train};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{GaussianLaw, GridConfig, LavaGrid, LavaPoint, Law, Move, PointConfig, World};
use rand::RngExt;
use rand_distr::StandardNormal;
use std::hint::black_box;
use std::time::Duration;
use tch::Device;

/// As in the program itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const SEED: u64 = 1;
const ETA: f64 = 25.0;
/// Perturbations made in a row: as many as a rollout has slots.
const PERTURBATIONS: usize = 250;
/// Updates of one short training: two rounds of K = 2 and 1.
const UPDATES: u64 = 6;

fn eta() -> Eta {
    Eta::new(ETA).expect("a budget")
}

/// The default training options of a world, played at the full budget from the start.
fn options(world: WorldName) -> TrainOptions {
    let config = Config::resolve(None, &[]).expect("the embedded default configuration");
    TrainOptions { budget_wait: 0.0, budget_rise: 0.0, ..config.world(world).train.clone() }
}

/// A world with as many slots as the options say.
trait Bench: Arena {
    const NAME: WorldName;

    fn build(options: &TrainOptions) -> Self;
}

impl Bench for LavaGrid {
    const NAME: WorldName = WorldName::LavaGrid;

    fn build(options: &TrainOptions) -> Self {
        LavaGrid::new(&GridConfig::default(), options.parallel_episodes).expect("the default grid")
    }
}

impl Bench for LavaPoint {
    const NAME: WorldName = WorldName::LavaPoint;

    fn build(options: &TrainOptions) -> Self {
        LavaPoint::new(&PointConfig::default(), options.parallel_episodes)
            .expect("the default arena")
    }
}

fn perturbations(criterion: &mut Criterion) {
    let grid = LavaGrid::new(&GridConfig::default(), 1).expect("the default grid");
    let law = grid.law(0, Move::ALL[0]);
    perturbations_of(criterion, "finite", &LavaGrid::family(&options(WorldName::LavaGrid)), law);
    let family = LavaPoint::family(&options(WorldName::LavaPoint));
    perturbations_of(criterion, "gaussian", &family, GaussianLaw);
}

fn perturbations_of<F: Family>(criterion: &mut Criterion, name: &str, family: &F, law: F::Law) {
    let mut group = criterion.benchmark_group("perturbation");
    group.throughput(Throughput::Elements(PERTURBATIONS as u64));
    let random = &mut stream(SEED, Purpose::Outcomes, 0);
    let budget = Budget::start(eta());
    let cases: Vec<_> = (0..PERTURBATIONS)
        .map(|_| {
            let parameters: Vec<f64> =
                (0..family.parameters()).map(|_| random.sample(StandardNormal)).collect();
            (parameters, law.sample(random))
        })
        .collect();
    group.bench_function(BenchmarkId::new(name, "make"), |bencher| {
        bencher.iter(|| {
            for (parameters, _) in &cases {
                black_box(family.perturbation(black_box(parameters), &law, budget));
            }
        });
    });
    group.bench_function(BenchmarkId::new(name, "learn"), |bencher| {
        let mut score = vec![0.0; family.parameters()];
        let mut entropy_gradient = vec![0.0; family.parameters()];
        bencher.iter(|| {
            for (parameters, outcome) in &cases {
                let perturbation = family.perturbation(black_box(parameters), &law, budget);
                black_box(perturbation.likelihood_ratio(*outcome));
                perturbation.score(*outcome, &mut score);
                black_box(perturbation.entropy(&mut entropy_gradient));
                black_box((&score, &entropy_gradient));
            }
        });
    });
    group.finish();
}

fn rollouts(criterion: &mut Criterion) {
    rollout::<LavaGrid>(criterion);
    rollout::<LavaPoint>(criterion);
}

fn rollout<W: Bench>(criterion: &mut Criterion) {
    let options = options(W::NAME);
    let mut group = criterion.benchmark_group("rollout");
    group.throughput(Throughput::Elements(options.rollout()));
    let (pair, mut collector) = opening::<W>(&options);
    group.bench_function(W::NAME.to_string(), |bencher| {
        bencher.iter(|| collector.collect(&pair, eta(), Choosing::Sampled, &options));
    });
    group.finish();
}

fn updates(criterion: &mut Criterion) {
    update::<LavaGrid>(criterion);
    update::<LavaPoint>(criterion);
}

/// The learning rate is 0: every update costs the same, and the players stay as they are.
fn update<W: Bench>(criterion: &mut Criterion) {
    let options = options(W::NAME);
    let mut group = criterion.benchmark_group("update");
    group.throughput(Throughput::Elements(options.rollout()));
    let (mut pair, mut collector) = opening::<W>(&options);
    collector.collect(&pair, eta(), Choosing::Sampled, &options);
    let rates = |entropy: f64| Rates { learning_rate: 0.0, entropy };
    let random: &mut ChaCha8Rng = &mut stream(SEED, Purpose::Minibatches, 0);

    let player = &mut pair.protagonist;
    let its = &options.protagonist;
    group.bench_function(BenchmarkId::new(W::NAME.to_string(), "protagonist"), |bencher| {
        bencher.iter(|| {
            player.update(&collector.protagonist, None, 1.0, its, rates(its.entropy), random)
        });
    });
    let player = pair.antagonist.as_mut().expect("eta is above 1");
    let its = &options.antagonist;
    group.bench_function(BenchmarkId::new(W::NAME.to_string(), "antagonist"), |bencher| {
        bencher.iter(|| {
            let played = &collector.antagonist;
            let spending =
                options.price_budget.then(|| Spending::of::<W>(player, played, &pair.views));
            player.update(played, spending.as_ref(), 1.0, its, rates(its.entropy), random)
        });
    });
    group.finish();
}

fn trainings(criterion: &mut Criterion) {
    training::<LavaGrid>(criterion);
    training::<LavaPoint>(criterion);
}

fn training<W: Bench>(criterion: &mut Criterion) {
    let mut options = options(W::NAME);
    options.steps = UPDATES * options.rollout();
    let mut group = criterion.benchmark_group("train");
    group.sample_size(10);
    group.throughput(Throughput::Elements(options.steps));
    let game = Game { eta: eta(), gamma: 1.0, seed: SEED, device: Device::Cpu, options: &options };
    group.bench_function(W::NAME.to_string(), |bencher| {
        bencher.iter_batched(
            || W::build(&options),
            |world| {
                train(world, &game, |progress| {
                    black_box(progress);
                })
            },
            BatchSize::PerIteration,
        );
    });
    group.finish();
}

/// A fresh pair and its games.
fn opening<W: Bench>(options: &TrainOptions) -> (Pair<W>, Collector<W>) {
    let pair = Pair::new(options, eta(), SEED, Device::Cpu);
    let collector = Collector::new(W::build(options), &pair, 1.0, SEED);
    (pair, collector)
}

/// Short measurements: the whole file in a minute.
fn configured() -> Criterion {
    // As in a run: one torch thread.
    tch::set_num_threads(1);
    Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3))
}

criterion_group! {
    name = benches;
    config = configured();
    targets = perturbations, rollouts, updates, trainings
}
criterion_main!(benches);
