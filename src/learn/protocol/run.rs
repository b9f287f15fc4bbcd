//! One run, from its configuration to its artefacts: train, keep the weights, evaluate.

use super::evaluation;
use super::exhibits::{Exhibited, exhibits};
use super::failure::RunError;
use crate::train::{Game, Progress, train};
use crate::weights;
use cvar_game::experiment::artefacts::{Evaluation, Manifest, SCHEMA, write_in_place};
use cvar_game::experiment::config::{RunConfig, WorldConfig};
use cvar_game::experiment::runner::Tick;
use cvar_game::experiment::tensorboard::EventFile;
use lava_envs::{LavaGrid, LavaPoint};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Points of the curve of the regret in training.
const REGRET_POINTS: u64 = 40;

/// Carries out the run and leaves its artefacts in `folder`, `evaluation.json` last.
///
/// # Errors
/// If training fails or an artefact cannot be written.
pub fn execute(
    run: &RunConfig,
    folder: &Path,
    report: &mut dyn FnMut(Tick),
) -> Result<(), RunError> {
    tch::set_num_threads(1);
    match &run.env {
        WorldConfig::LavaGrid(constants) => carry_out::<LavaGrid>(run, constants, folder, report),
        WorldConfig::LavaPoint(constants) => carry_out::<LavaPoint>(run, constants, folder, report),
    }
}

fn carry_out<W: Exhibited>(
    run: &RunConfig,
    constants: &W::Constants,
    folder: &Path,
    report: &mut dyn FnMut(Tick),
) -> Result<(), RunError> {
    let world = W::build(constants, run.train.parallel_episodes)?;
    let path = folder.join("progress.csv");
    let mut progress = ProgressFile::create(folder).map_err(RunError::file(&path))?;
    let game = Game {
        eta: run.eta,
        gamma: run.gamma,
        seed: run.seed,
        device: evaluation::device(run.device),
        options: &run.train,
    };
    let start = Instant::now();
    let mut written = Ok(());
    let mut last = Tick { steps: 0, mean_return: f64::NAN };
    let meter = W::regret_meter(constants, run)?;
    let mut regret = Ok(Vec::new());
    let trained = train::<W>(world, &game, |of, pair| {
        if written.is_ok() {
            written = progress.add(of, start.elapsed().as_secs_f64());
        }
        last = Tick { steps: of.steps, mean_return: of.mean_return };
        report(last);
        if let (Some(meter), Ok(points)) = (&meter, &mut regret)
            && of.steps * REGRET_POINTS >= points.len() as u64 * run.train.steps
        {
            match meter(pair) {
                Ok(now) => points.push((of.steps, now)),
                Err(error) => regret = Err(error),
            }
        }
    });
    let seconds = start.elapsed().as_secs_f64();
    written.and_then(|()| progress.finish()).map_err(RunError::file(&path))?;

    let mut manifest = Manifest::of(run.id(), &run.device.to_string(), last.steps, seconds);
    manifest.failure = trained.as_ref().err().map(ToString::to_string);
    write_json(&folder.join("manifest.json"), &manifest)?;
    let pair = trained?;

    let path = folder.join("final.safetensors");
    let about = format!("schema {SCHEMA}, run {}, steps {}", manifest.run, last.steps);
    write_in_place(&path, &weights::to_bytes(&pair, about)?).map_err(RunError::file(&path))?;

    let found = evaluation::protocol(run, constants, &pair)?;
    let evaluation = Evaluation {
        schema: SCHEMA,
        env: run.env.name().to_string(),
        eta: run.eta.get(),
        seed: run.seed,
        steps: last.steps,
        seconds,
        plays: found.plays,
        audit: found.audit,
        certificate: found.certificate,
    };
    let shown = exhibits(run, constants, &pair, regret?)?;
    let text = serde_json::to_vec(&shown).map_err(io::Error::other);
    let path = folder.join("exhibits.json");
    text.and_then(|text| write_in_place(&path, &text)).map_err(RunError::file(&path))?;
    write_json(&folder.join("evaluation.json"), &evaluation)
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), RunError> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|error| RunError::file(path)(io::Error::other(error)))?;
    text.push('\n');
    write_in_place(path, text.as_bytes()).map_err(RunError::file(path))
}

/// `progress.csv`: a line per update; and the same for TensorBoard. `seconds` and the time of an event
/// are all that differs between two runs of one seed.
struct ProgressFile {
    csv: csv::Writer<BufWriter<File>>,
    events: EventFile,
}

impl ProgressFile {
    const COLUMNS: [&'static str; 18] = [
        "update",
        "steps",
        "player",
        "budget",
        "mean_return",
        "goal",
        "lava",
        "learning_rate",
        "policy_loss",
        "value_loss",
        "entropy",
        "approx_kl",
        "clip_fraction",
        "gradient_norm",
        "explained_variance",
        "budget_use",
        "steps_per_second",
        "seconds",
    ];

    fn create(folder: &Path) -> io::Result<Self> {
        let file = File::create(folder.join("progress.csv"))?;
        let mut csv = csv::Writer::from_writer(BufWriter::new(file));
        csv.write_record(Self::COLUMNS)?;
        Ok(ProgressFile { csv, events: EventFile::create(folder, wall_time())? })
    }

    fn add(&mut self, of: &Progress, seconds: f64) -> io::Result<()> {
        let losses = &of.losses;
        let numbers = [
            of.budget,
            of.mean_return,
            of.goal,
            of.lava,
            of.learning_rate,
            losses.policy_loss,
            losses.value_loss,
            losses.entropy,
            losses.approx_kl,
            losses.clip_fraction,
            losses.gradient_norm,
            losses.explained_variance,
            of.budget_use,
        ];
        let head = [of.update.to_string(), of.steps.to_string(), of.role.to_string()];
        let timing = [format!("{:.0}", of.steps as f64 / seconds), format!("{seconds:.3}")];
        let record = head.into_iter().chain(numbers.map(|x| format!("{x:.6}"))).chain(timing);
        self.csv.write_record(record)?;
        self.events.add(wall_time(), of.steps, &scalars(of, seconds))
    }

    fn finish(self) -> io::Result<()> {
        self.csv.into_inner().map_err(|error| io::Error::other(error.to_string()))?.flush()
    }
}

/// The numbers of an update under the names that users of CleanRL know, by player.
fn scalars(of: &Progress, seconds: f64) -> Vec<(String, f64)> {
    let losses = &of.losses;
    [
        ("charts/episodic_return", of.mean_return),
        ("charts/goal", of.goal),
        ("charts/lava", of.lava),
        ("charts/budget", of.budget),
        ("charts/budget_use", of.budget_use),
        ("charts/learning_rate", of.learning_rate),
        ("charts/SPS", of.steps as f64 / seconds),
        ("losses/policy_loss", losses.policy_loss),
        ("losses/value_loss", losses.value_loss),
        ("losses/entropy", losses.entropy),
        ("losses/approx_kl", losses.approx_kl),
        ("losses/clipfrac", losses.clip_fraction),
        ("losses/gradient_norm", losses.gradient_norm),
        ("losses/explained_variance", losses.explained_variance),
    ]
    .map(|(name, value)| (format!("{}/{name}", of.role), value))
    .into()
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}
