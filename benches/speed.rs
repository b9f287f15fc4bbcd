//! Environment steps per second of the parts of training, and of training itself, with the default
//! options, one thread and eta = 25.
//!
//! The benchmarks of the worlds are in `envs/benches/stepping.rs`. `cargo xtask speed` runs both and makes a table.
//! Every benchmark's throughput is in environment steps, so that the times of the parts add up:
//!
//! | benchmark | what one environment step is |
//! |---|---|
//! | `perturbation/FAMILY/make` | one perturbation from its parameters |
//! | `perturbation/FAMILY/learn` | likelihood ratio, score and entropy as well |
//! | `rollout/WORLD` | one step of one of 250 episodes, recorded for both players |
//! | `limit/WORLD/PLAYER` | the arithmetic of the next one alone, on registers |
//! | `network/WORLD/PLAYER` | one sample of a minibatch: the networks' outputs and gradient |
//! | `update/WORLD/PLAYER` | one sample of the rollout: critic, advantages, all epochs |
//! | `train/WORLD` | all of it: Algorithm 1 with the antagonist active from the start |

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use cvar_game::experiment::config::{self, Config, Source};
use cvar_game::experiment::registry::standard;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::bump::Bump;
use cvar_game::game::finite::FiniteFamily;
use cvar_game::game::gaussian::GaussianFamily;
use cvar_game::game::perturbation::{Family, Perturbation};
use cvar_game::learn::budget_sensitivity::LARGEST;
use cvar_game::learn::device::Device;
use cvar_game::learn::family::Named;
use cvar_game::learn::inputs::{Inputs, Selection};
use cvar_game::learn::method::{Arena, Setting, Training};
use cvar_game::learn::methods::game::GameTraining;
use cvar_game::learn::network::{Network, Shape};
use cvar_game::learn::options::TrainOptions;
use cvar_game::learn::pair::Pair;
use cvar_game::learn::policy::Mode;
use cvar_game::learn::ppo::{Rates, Signal};
use cvar_game::learn::rollout::{Collector, Terms};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{GaussianLaw, LavaGrid, LavaPoint, Law, Move, World};
use pulp::{Arch, Simd, WithSimd};
use rand::RngExt;
use rand_distr::StandardNormal;
use std::hint::black_box;
use std::sync::LazyLock;
use std::time::Duration;

const SEED: u64 = 1;
const ETA: f64 = 25.0;
/// Perturbations made in a row: as many as a rollout has slots.
const PERTURBATIONS: usize = 250;
/// Updates of one short training: two rounds of K = 2 and 1.
const UPDATES: u64 = 6;

fn eta() -> Eta {
    Eta::new(ETA).expect("a budget")
}

/// What the players see, with what a benchmark's name says of it.
const SEEN: [(&str, &str); 2] = [("coordinates", ""), ("features", "+features")];

/// The default training options of a world, played at the full budget from the start.
fn options<W: World>() -> TrainOptions {
    seeing::<W>(SEEN[0].0)
}

/// The same, with players that see this.
fn seeing<W: World>(observation: &str) -> TrainOptions {
    let observation = config::Setting::parse(&format!("train.observation={observation}"));
    let observation = observation.expect("an option and its value");
    let config = Config::resolve(standard().catalogue(), Source::Default, &[observation])
        .expect("the embedded default configuration");
    TrainOptions { budget_wait: 0.0, budget_rise: 0.0, ..config.world(W::NAME).train.clone() }
}

/// A world with its default constants and as many slots as the options say.
fn world<W: World>(options: &TrainOptions) -> W {
    W::new(&W::defaults(), options.parallel_episodes).expect("the default constants")
}

fn setting(options: &TrainOptions) -> Setting<'_> {
    static NO_OPTIONS: LazyLock<toml::Table> = LazyLock::new(toml::Table::new);
    let (eta, device) = (eta(), Device::Cpu);
    Setting { eta, gamma: 1.0, seed: SEED, device, options, own: &NO_OPTIONS }
}

fn perturbations(criterion: &mut Criterion) {
    let grid: LavaGrid = world(&options::<LavaGrid>());
    let law = grid.law(0, Move::ALL[0]);
    let family = FiniteFamily::<4>::with(&options::<LavaGrid>().family);
    perturbations_of(criterion, "finite", &family, law);
    let family = GaussianFamily::<Bump>::with(&options::<LavaPoint>().family);
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
    for seen in SEEN {
        rollout::<LavaGrid>(criterion, seen);
        rollout::<LavaPoint>(criterion, seen);
    }
}

/// How the rollouts are played.
fn terms() -> Terms {
    Terms { eta: eta(), mode: Mode::Sampled, exploring: 0.0 }
}

fn rollout<W: Arena>(criterion: &mut Criterion, (seen, suffix): (&str, &str)) {
    let name = format!("{}{suffix}", W::NAME);
    let options = seeing::<W>(seen);
    let mut group = criterion.benchmark_group("rollout");
    group.throughput(Throughput::Elements(options.rollout()));
    let (pair, mut collector) = opening::<W>(&options);
    group.bench_function(&name, |bencher| {
        bencher.iter(|| collector.collect(&pair, terms(), &options));
    });
    group.finish();
}

fn updates(criterion: &mut Criterion) {
    for seen in SEEN {
        update::<LavaGrid>(criterion, seen);
        update::<LavaPoint>(criterion, seen);
    }
}

fn networks(criterion: &mut Criterion) {
    for seen in SEEN {
        network::<LavaGrid>(criterion, seen);
        network::<LavaPoint>(criterion, seen);
    }
}

fn network<W: Arena>(criterion: &mut Criterion, (seen, suffix): (&str, &str)) {
    let name = format!("{}{suffix}", W::NAME);
    let options = seeing::<W>(seen);
    let (mut pair, mut collector) = opening::<W>(&options);
    collector.collect(&pair, terms(), &options);
    let mut differentiate = |player, network: &mut Network, inputs: &Inputs, minibatch: usize| {
        let indices: Vec<usize> = (0..minibatch).collect();
        let samples = Selection { all: inputs.rows(), indices: &indices };
        let mut gradient = Vec::new();
        let mut limits = criterion.benchmark_group("limit");
        limits.throughput(Throughput::Elements(minibatch as u64));
        let arithmetic = Arithmetic::of(network.shape(), minibatch);
        limits.bench_function(BenchmarkId::new(&name, player), |bencher| {
            bencher.iter(|| Arch::new().dispatch(arithmetic));
        });
        limits.finish();
        let mut group = criterion.benchmark_group("network");
        group.throughput(Throughput::Elements(minibatch as u64));
        group.bench_function(BenchmarkId::new(&name, player), |bencher| {
            bencher.iter(|| {
                network.differentiate(samples, &mut gradient, |outputs| {
                    black_box(outputs);
                });
            });
        });
    };
    let (played, minibatch) = (&collector.protagonist.inputs, options.protagonist.minibatch);
    differentiate("protagonist", &mut pair.protagonist.network, played, minibatch);
    let antagonist = pair.antagonist.as_mut().expect("eta is above 1");
    let (played, minibatch) = (&collector.antagonist.inputs, options.antagonist.minibatch);
    differentiate("antagonist", antagonist.network_mut(), played, minibatch);
}

/// The arithmetic of a minibatch's outputs and gradient.
#[derive(Debug, Clone, Copy)]
struct Arithmetic {
    /// Multiplications with an addition, and what takes as long as one.
    operations: usize,
    divisions: usize,
}

impl Arithmetic {
    fn of(shape: Shape, samples: usize) -> Self {
        let units = 2 * shape.hidden;
        // Both linear maps forwards and by their weights, and the second one backwards.
        let linear = 2 * units * shape.width() + 3 * shape.rows() * shape.hidden;
        // A cell's column, added forwards and backwards; tanh by a rational function, and its slope.
        let cell = if shape.columns.cells > 0 { 2 * units } else { 0 };
        let tanh = (13 + 2) * units;
        Arithmetic { operations: samples * (linear + cell + tanh), divisions: samples * units }
    }
}

impl WithSimd for Arithmetic {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        /// Enough of them in a row that none waits for another.
        const SUMS: usize = 8;
        let [divisions, operations] =
            [self.divisions, self.operations].map(|all| all / S::F32_LANES);
        let (a, b) = (simd.splat_f32s(black_box(0.999)), simd.splat_f32s(black_box(1e-3)));
        let (mut quotients, mut sums) = ([a; 4], [b; SUMS]);
        for _ in 0..divisions / 4 {
            for quotient in &mut quotients {
                *quotient = simd.div_f32s(*quotient, a);
            }
            for _ in 0..4 * operations / divisions / SUMS {
                for sum in &mut sums {
                    *sum = simd.mul_add_f32s(*sum, a, b);
                }
            }
        }
        black_box((quotients, sums));
    }
}

/// The learning rate is 0: every update costs the same, and the players stay as they are.
fn update<W: Arena>(criterion: &mut Criterion, (seen, suffix): (&str, &str)) {
    let name = format!("{}{suffix}", W::NAME);
    let options = seeing::<W>(seen);
    let mut group = criterion.benchmark_group("update");
    group.throughput(Throughput::Elements(options.rollout()));
    let (mut pair, mut collector) = opening::<W>(&options);
    collector.collect(&pair, terms(), &options);
    let rates = |entropy: f64| Rates { learning_rate: 0.0, entropy };
    let random: &mut ChaCha8Rng = &mut stream(SEED, Purpose::Minibatches, 0);

    let player = &mut pair.protagonist;
    let its = &options.protagonist;
    group.bench_function(BenchmarkId::new(&name, "protagonist"), |bencher| {
        bencher.iter(|| {
            player.update(&collector.protagonist, Signal::Own, 1.0, its, rates(its.entropy), random)
        });
    });
    let player = pair.antagonist.as_mut().expect("eta is above 1");
    let its = &options.antagonist;
    let observation = pair.observation;
    let more = |inputs: &mut Inputs, by: f64| observation.with_more_budget::<W>(inputs, by);
    group.bench_function(BenchmarkId::new(&name, "antagonist"), |bencher| {
        bencher.iter(|| {
            let played = &collector.antagonist;
            let sensitivity = options
                .budget_sensitivity
                .then(|| player.budget_sensitivity(played, &more, LARGEST));
            let signal = sensitivity.as_ref().map_or(Signal::Own, Signal::Charged);
            player.update(played, signal, 1.0, its, rates(its.entropy), random)
        });
    });
    group.finish();
}

fn trainings(criterion: &mut Criterion) {
    for seen in SEEN {
        training::<LavaGrid>(criterion, seen);
        training::<LavaPoint>(criterion, seen);
    }
}

fn training<W: Arena>(criterion: &mut Criterion, (seen, suffix): (&str, &str)) {
    let name = format!("{}{suffix}", W::NAME);
    let mut options = seeing::<W>(seen);
    options.steps = UPDATES * options.rollout();
    let mut group = criterion.benchmark_group("train");
    group.sample_size(10);
    group.throughput(Throughput::Elements(options.steps));
    let setting = setting(&options);
    group.bench_function(&name, |bencher| {
        bencher.iter_batched(
            || world::<W>(&options),
            |world| {
                let mut training = GameTraining::new(world, &setting);
                while let Ok(Some(progress)) = training.update() {
                    black_box(progress);
                }
            },
            BatchSize::PerIteration,
        );
    });
    group.finish();
}

/// A fresh pair and its games.
fn opening<W: Arena>(options: &TrainOptions) -> (Pair<W>, Collector<W>) {
    let setting = setting(options);
    (Pair::new(&world(options), &setting), Collector::new(world(options), &setting))
}

/// Short measurements: the whole file in a minute.
fn configured() -> Criterion {
    Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(3))
}

criterion_group! {
    name = benches;
    config = configured();
    targets = perturbations, networks, rollouts, updates, trainings
}
criterion_main!(benches);
