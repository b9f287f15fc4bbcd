//! Playing a protagonist in the physical world: this, and not the lattice, is what certifies.

use super::controller::Protagonist;
use crate::exact::walk::Walk;
use crate::exact::watch::Watch;
use crate::game::returns::{Atom, ReturnLaw};
use lava_envs::law::{GaussianLaw, Law};
use lava_envs::point::Force;
use lava_envs::random::{Purpose, stream};
use lava_envs::{ConfigError, End, LavaPoint, PointConfig, Step, World};
use nalgebra::Vector2;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Episodes that are in a world at the same time, and the unit of work of a thread.
const BATCH: usize = 250;

/// Recorded episodes of a protagonist.
#[derive(Debug, Clone, PartialEq)]
pub struct Played {
    /// The law of J.
    pub law: ReturnLaw,
    /// Mean y in m at which episodes first pass the middle of the arena in x; `None` if none does.
    pub crossing_y: Option<f64>,
    /// Share of the episodes that pass it.
    pub crossed: f64,
}

/// Plays episodes `0..episodes` of a seed under nominal chance. Episode i has its own streams, so the
/// result depends neither on the number of threads nor on the batch. `watch` is told the share that is done.
///
/// # Errors
/// If the configuration is out of range.
pub fn play(
    config: &PointConfig,
    gamma: f64,
    protagonist: &dyn Protagonist,
    episodes: u64,
    seed: u64,
    threads: usize,
    watch: &dyn Watch,
) -> Result<Played, ConfigError> {
    config.validate()?;
    let blank = Episode {
        atom: Atom { value: 0.0, undiscounted: 0.0, steps: 0, end: End::Timeout, mass: 0.0 },
        crossing: None,
    };
    let mut records = vec![blank; episodes as usize];
    let batches = episodes.div_ceil(BATCH as u64);
    let done = AtomicU64::new(0);
    let queue = Mutex::new(records.chunks_mut(BATCH).enumerate());
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|_| {
                scope.spawn(|| {
                    loop {
                        let next = queue.lock().expect("no worker panics with the queue").next();
                        let Some((batch, records)) = next else { return Ok(()) };
                        let first = (batch * BATCH) as u64;
                        play_batch(config, gamma, protagonist, seed, first, records)?;
                        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
                        watch.done(done as f64 / batches as f64);
                    }
                })
            })
            .collect();
        workers.into_iter().try_for_each(|worker| worker.join().expect("a worker panicked"))
    })?;
    let crossings: Vec<f64> = records.iter().filter_map(|record| record.crossing).collect();
    Ok(Played {
        crossing_y: (!crossings.is_empty())
            .then(|| crossings.iter().sum::<f64>() / crossings.len() as f64),
        crossed: crossings.len() as f64 / episodes as f64,
        law: ReturnLaw::recorded(records.into_iter().map(|record| record.atom)),
    })
}

/// One episode of a seed's streams under nominal chance, step by step, with four decimals.
///
/// # Errors
/// If the configuration is out of range.
pub fn walk(
    config: &PointConfig,
    gamma: f64,
    protagonist: &dyn Protagonist,
    seed: u64,
    index: u64,
) -> Result<Walk, ConfigError> {
    let mut world = LavaPoint::new(config, 1)?;
    let mut chance = stream(seed, Purpose::EvaluationOutcomes, index);
    let mut own = stream(seed, Purpose::EvaluationActions, index);
    let rounded = |pair: [f64; 2]| pair.map(|number| (number * 1e4).round() / 1e4);
    let mut walk = Walk {
        index,
        end: End::Timeout,
        value: 0.0,
        path: vec![rounded(world.position(0))],
        actions: Vec::new(),
        outcomes: Vec::new(),
    };
    let (mut discount, mut value) = (1.0, 0.0);
    for time in 0..config.horizon {
        let action = protagonist.act(time, world.position(0), world.velocity(0), &mut own);
        let outcome = GaussianLaw.sample(&mut chance);
        let mut step = [Step::IDLE];
        world.apply(&[action], &[outcome], &mut step);
        value += discount * step[0].reward;
        discount *= gamma;
        walk.path.push(rounded(world.position(0)));
        walk.actions.push(rounded(LavaPoint::action_arrow(action)));
        walk.outcomes.push(rounded(LavaPoint::outcome_arrow(outcome)));
        if let Some(end) = step[0].end {
            walk.end = end;
            break;
        }
    }
    walk.value = (value * 1e4).round() / 1e4;
    Ok(walk)
}

#[derive(Debug, Clone, Copy)]
struct Episode {
    atom: Atom,
    crossing: Option<f64>,
}

fn play_batch(
    config: &PointConfig,
    gamma: f64,
    protagonist: &dyn Protagonist,
    seed: u64,
    first: u64,
    records: &mut [Episode],
) -> Result<(), ConfigError> {
    let mut world = LavaPoint::new(config, records.len())?;
    let streams = |purpose: Purpose| -> Vec<_> {
        (0..records.len() as u64).map(|index| stream(seed, purpose, first + index)).collect()
    };
    let mut chance = streams(Purpose::EvaluationOutcomes);
    let mut own = streams(Purpose::EvaluationActions);
    let mut running: Vec<bool> = vec![true; records.len()];
    let mut actions = vec![Force(Vector2::zeros()); records.len()];
    let mut outcomes = vec![Vector2::zeros(); records.len()];
    let mut steps = vec![Step::IDLE; records.len()];
    let mut before = vec![[0.0, 0.0]; records.len()];
    let middle = config.arena[0] / 2.0;
    let mut discount = 1.0;
    for time in 0..config.horizon {
        for slot in (0..records.len()).filter(|&slot| running[slot]) {
            before[slot] = world.position(slot);
            let velocity = world.velocity(slot);
            actions[slot] = protagonist.act(time, before[slot], velocity, &mut own[slot]);
            outcomes[slot] = GaussianLaw.sample(&mut chance[slot]);
        }
        world.apply(&actions, &outcomes, &mut steps);
        for (slot, record) in records.iter_mut().enumerate() {
            if !running[slot] {
                continue;
            }
            let Episode { atom, crossing } = record;
            atom.value += discount * steps[slot].reward;
            atom.undiscounted += steps[slot].reward;
            atom.steps += 1;
            let ([x0, y0], [x1, y1]) = (before[slot], world.position(slot));
            if crossing.is_none() && x0 < middle && x1 >= middle {
                *crossing = Some(y0 + (y1 - y0) * (middle - x0) / (x1 - x0));
            }
            if let Some(end) = steps[slot].end {
                atom.end = end;
                running[slot] = false;
            }
        }
        if running.iter().all(|&running| !running) {
            break;
        }
        discount *= gamma;
    }
    Ok(())
}
