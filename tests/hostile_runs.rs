//! Checkpoints and weights from elsewhere are refused or played with: no input makes the program panic
//! or allocate without bound.

#[path = "support/fuzz.rs"]
mod fuzz;

use cap::Cap;
use cvar_game::experiment::artefacts::SCHEMA;
use cvar_game::experiment::registry::standard;
use fuzz::{fuzz, inputs};
use std::alloc::System;
use std::time::Duration;

/// Whoever asks for more memory than all parsers together need ends the test.
#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, 1 << 30);

fuzz::fuzz_targets!(checkpoints, sealed_checkpoints, weights);

mod trained {
    use super::standard;
    use cvar_game::experiment::checkpoint::{Checkpoint, to_bytes};
    use cvar_game::experiment::config::{Config, Source};
    use cvar_game::experiment::growing_file::Extent;
    use cvar_game::experiment::progress_file::ProgressExtent;
    use cvar_game::game::budget::Eta;
    use cvar_game::learn::device::Device;
    use cvar_game::learn::method::{Setting, Training};
    use cvar_game::learn::methods::game::GameTraining;
    use cvar_game::learn::options::TrainOptions;
    use lava_envs::{GridConfig, LavaGrid, LavaPoint, PointConfig, World};
    use std::sync::LazyLock;

    /// Small players and few slots, so that damage meets every kind of number.
    pub fn options() -> TrainOptions {
        let config = Config::resolve(standard().catalogue(), Source::Default, &[]).unwrap();
        let mut options = config.world(LavaPoint::NAME).train.clone();
        (options.parallel_episodes, options.rollout_steps) = (4, 40);
        options.steps = 4 * 40 * 3;
        for player in [&mut options.protagonist, &mut options.antagonist] {
            (player.hidden, player.minibatch, player.epochs) = (2, 80, 1);
        }
        options
    }

    static NO_OPTIONS: LazyLock<toml::Table> = LazyLock::new(toml::Table::new);

    pub fn game(options: &TrainOptions) -> Setting<'_> {
        let eta = Eta::new(25.0).unwrap();
        Setting { eta, gamma: 1.0, seed: 1, device: Device::Cpu, options, own: &NO_OPTIONS }
    }

    pub fn grid() -> LavaGrid {
        LavaGrid::new(&GridConfig::default(), 4).unwrap()
    }

    pub fn point() -> LavaPoint {
        LavaPoint::new(&PointConfig::default(), 4).unwrap()
    }

    /// A checkpoint of each world after one update.
    pub fn states() -> [Checkpoint; 2] {
        let options = options();
        let game = game(&options);
        let mut on_grid = GameTraining::new(grid(), &game);
        let mut on_point = GameTraining::new(point(), &game);
        on_grid.update().unwrap();
        on_point.update().unwrap();
        [of(Training::state(&on_grid)), of(Training::state(&on_point))]
    }

    fn of(training: Vec<u8>) -> Checkpoint {
        let extent = Extent { bytes: 100, crc: 7 };
        let progress = ProgressExtent { csv: extent, events: extent };
        let (program, config) = ("this".into(), "config".into());
        Checkpoint { program, config, seconds: 1.0, progress, training }
    }

    pub fn files() -> Vec<Vec<u8>> {
        states().iter().map(|state| to_bytes(state).unwrap()).collect()
    }
}

fn checkpoints(effort: (u32, Duration)) -> u64 {
    use cvar_game::experiment::checkpoint::from_bytes;
    let valid = trained::files();
    fuzz(&inputs(valid.clone(), "checkpoints"), effort, |bytes| {
        // The checksum finds every damage.
        if from_bytes(bytes).is_ok() {
            assert!(valid.iter().any(|file| file == bytes));
        }
    })
}

/// With a right checksum anything may follow: training refuses it or continues from it.
fn sealed_checkpoints(effort: (u32, Duration)) -> u64 {
    use cvar_game::experiment::checkpoint::from_bytes;
    use cvar_game::learn::method::{Arena, Setting, Training};
    use cvar_game::learn::methods::game::GameTraining;
    fn continued<W: Arena>(world: W, game: &Setting<'_>, state: &[u8]) {
        let mut training = GameTraining::new(world, game);
        if Training::restore(&mut training, state).is_ok() {
            let _ = training.update();
        }
    }
    let options = trained::options();
    let game = trained::game(&options);
    fuzz(&inputs(trained::files(), "sealed_checkpoints"), effort, |bytes| {
        let mut bytes = bytes.to_vec();
        bytes.resize(bytes.len().max(16), 0);
        bytes[..8].copy_from_slice(b"CVARGAME");
        bytes[8..12].copy_from_slice(&SCHEMA.to_le_bytes());
        let crc = crc32fast::hash(&bytes[16..]);
        bytes[12..16].copy_from_slice(&crc.to_le_bytes());
        if let Ok(found) = from_bytes(&bytes) {
            continued(trained::grid(), &game, &found.training);
            continued(trained::point(), &game, &found.training);
        }
    })
}

fn weights(effort: (u32, Duration)) -> u64 {
    use cvar_game::learn::method::Players;
    use cvar_game::learn::pair::Pair;
    use cvar_game::learn::play::{Play, play};
    use cvar_game::learn::policy::{Draw, Mode};
    use lava_envs::LavaPoint;
    let options = trained::options();
    let game = trained::game(&options);
    let fresh = || Pair::<LavaPoint>::new(&trained::point(), &game);
    let valid = vec![fresh().weights("valid".into()).unwrap()];
    fuzz(&inputs(valid, "weights"), effort, |bytes| {
        let mut pair = fresh();
        if pair.load(bytes).is_ok() {
            let (mode, draw) = (Mode::Sampled, Draw::Perturbed);
            let setting = Play { mode, draw, eta: game.eta, gamma: 1.0, episodes: 8, seed: 1 };
            let mut protagonist = Players::protagonist(&pair);
            let mut opponent = Players::opponent(&pair).unwrap();
            let opponent = opponent.as_mut();
            play(trained::point(), protagonist.as_mut(), opponent, &setting, &mut ());
        }
    })
}
