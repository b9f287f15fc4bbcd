//! Checkpoints and weights from elsewhere are refused or played with: no input makes the program panic
//! or allocate without bound.

#[path = "../support/fuzz.rs"]
mod fuzz;

use cap::Cap;
use cvar_game::experiment::artefacts::SCHEMA;
use fuzz::{fuzz, inputs};
use std::alloc::System;
use std::time::Duration;

/// Whoever asks for more memory than all parsers together need ends the test.
#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, 1 << 30);

fuzz::fuzz_targets!(checkpoints, sealed_checkpoints, weights);

mod trained {
    use cvar_game::experiment::checkpoint::{Checkpoint, Extent, to_bytes};
    use cvar_game::experiment::config::Config;
    use cvar_game::experiment::names::WorldName;
    use cvar_game::game::budget::Eta;
    use cvar_game::options::TrainOptions;
    use cvar_learn::checkpoint::TrainingState;
    use cvar_learn::train::{Game, Training};
    use lava_envs::{GridConfig, LavaGrid, LavaPoint, PointConfig, World};
    use tch::Device;

    /// Small players and few slots, so that damage meets every kind of number.
    pub fn options() -> TrainOptions {
        let config = Config::resolve(None, &[]).unwrap();
        let mut options = config.world(WorldName::LavaPoint).train.clone();
        (options.parallel_episodes, options.rollout_steps) = (4, 40);
        options.steps = 4 * 40 * 3;
        for player in [&mut options.protagonist, &mut options.antagonist] {
            (player.hidden, player.minibatch, player.epochs) = (2, 80, 1);
        }
        options
    }

    pub fn game(options: &TrainOptions) -> Game<'_> {
        let eta = Eta::new(25.0).unwrap();
        Game { eta, gamma: 1.0, seed: 1, device: Device::Cpu, options }
    }

    pub fn grid() -> LavaGrid {
        LavaGrid::new(&GridConfig::default(), 4).unwrap()
    }

    pub fn point() -> LavaPoint {
        LavaPoint::new(&PointConfig::default(), 4).unwrap()
    }

    pub type GridState = Checkpoint<TrainingState<<LavaGrid as World>::Snapshot>>;
    pub type PointState = Checkpoint<TrainingState<<LavaPoint as World>::Snapshot>>;

    /// A checkpoint of each world after one update.
    pub fn states() -> (GridState, PointState) {
        let options = options();
        let game = game(&options);
        let mut on_grid = Training::new(grid(), &game);
        let mut on_point = Training::new(point(), &game);
        on_grid.update().unwrap();
        on_point.update().unwrap();
        (of(on_grid.state()), of(on_point.state()))
    }

    fn of<T>(training: T) -> Checkpoint<T> {
        let progress = Extent { bytes: 100, crc: 7 };
        let (program, config) = ("this".into(), "config".into());
        Checkpoint { program, config, seconds: 1.0, progress, training }
    }

    pub fn files() -> Vec<Vec<u8>> {
        let (on_grid, on_point) = states();
        vec![to_bytes(&on_grid).unwrap(), to_bytes(&on_point).unwrap()]
    }
}

fn checkpoints(effort: (u32, Duration)) -> u64 {
    use cvar_game::experiment::checkpoint::from_bytes;
    let valid = trained::files();
    fuzz(&inputs(valid.clone(), "checkpoints"), effort, |bytes| {
        let on_grid: Result<trained::GridState, _> = from_bytes(bytes);
        let on_point: Result<trained::PointState, _> = from_bytes(bytes);
        // The checksum finds every damage.
        if on_grid.is_ok() || on_point.is_ok() {
            assert!(valid.iter().any(|file| file == bytes));
        }
    })
}

/// Behind a right checksum anything may stand: training refuses it or goes on with it.
fn sealed_checkpoints(effort: (u32, Duration)) -> u64 {
    use cvar_game::experiment::checkpoint::from_bytes;
    use cvar_learn::train::Training;
    let options = trained::options();
    let game = trained::game(&options);
    fuzz(&inputs(trained::files(), "sealed_checkpoints"), effort, |bytes| {
        let mut bytes = bytes.to_vec();
        bytes.resize(bytes.len().max(16), 0);
        bytes[..8].copy_from_slice(b"CVARGAME");
        bytes[8..12].copy_from_slice(&SCHEMA.to_le_bytes());
        let crc = crc32fast::hash(&bytes[16..]);
        bytes[12..16].copy_from_slice(&crc.to_le_bytes());
        if let Ok(found) = from_bytes::<_>(&bytes) {
            let found: trained::GridState = found;
            let mut training = Training::new(trained::grid(), &game);
            if training.restore(found.training).is_ok() {
                let _ = training.update();
            }
        }
        if let Ok(found) = from_bytes::<_>(&bytes) {
            let found: trained::PointState = found;
            let mut training = Training::new(trained::point(), &game);
            if training.restore(found.training).is_ok() {
                let _ = training.update();
            }
        }
    })
}

fn weights(effort: (u32, Duration)) -> u64 {
    use cvar_learn::contest::{Chance, Choosing};
    use cvar_learn::pair::Pair;
    use cvar_learn::play::{Play, play};
    use cvar_learn::weights;
    use lava_envs::LavaPoint;
    let options = trained::options();
    let game = trained::game(&options);
    let fresh = || Pair::<LavaPoint>::new(&options, game.eta, 1, game.device);
    let valid = vec![weights::to_bytes(&fresh(), "valid".into()).unwrap()];
    fuzz(&inputs(valid, "weights"), effort, |bytes| {
        let mut pair = fresh();
        if weights::load(&mut pair, bytes, game.device).is_ok() {
            let (choosing, chance) = (Choosing::Sampled, Chance::Antagonist);
            let play_of =
                Play { choosing, chance, eta: game.eta, gamma: 1.0, episodes: 8, seed: 1 };
            play(trained::point(), &pair, &play_of, &mut ());
        }
    })
}
