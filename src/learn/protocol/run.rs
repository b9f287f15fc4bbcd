//! One run, from its configuration to its artefacts: train, keep the weights, evaluate.
//!
//! Training writes a checkpoint every so many updates, when it is asked to stop, and at its end. A run
//! that was cut short goes on from the last one that is sound and ends with the same bits.

use super::evaluation;
use super::exhibits::{Exhibited, RegretMeter, exhibits};
use super::failure::RunError;
use crate::train::{Game, Progress, Training};
use crate::weights;
use cvar_game::experiment::artefacts::{BUILD, Evaluation, Manifest, SCHEMA};
use cvar_game::experiment::checkpoint::{self, Checkpoint, CheckpointError, Extent};
use cvar_game::experiment::config::{RunConfig, WorldConfig};
use cvar_game::experiment::lock::RunLock;
use cvar_game::experiment::runner::{Report, Tick, read_evaluation};
use cvar_game::experiment::stop::Stop;
use cvar_game::experiment::tensorboard::EventFile;
use cvar_game::files::{remove_parts, write_in_place};
use lava_envs::{LavaGrid, LavaPoint};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Points of the curve of the regret in training.
const REGRET_POINTS: u64 = 40;

/// Carries out the run and leaves its artefacts in `folder`, `evaluation.json` last. Goes on from what
/// is there of the same run.
///
/// # Errors
/// If training fails or an artefact cannot be written; [`RunError::Unfinished`] if `stop` was
/// requested or another process works on the run.
pub fn execute(
    run: &RunConfig,
    folder: &Path,
    stop: &Stop,
    report: &mut dyn FnMut(Report),
) -> Result<(), RunError> {
    tch::set_num_threads(1);
    let lock = RunLock::take(folder).map_err(RunError::file(folder))?;
    let Some(_lock) = lock else { return Err(RunError::Unfinished) };
    if matches!(read_evaluation(folder), Ok(Some(_))) {
        return Ok(()); // another process has finished it meanwhile
    }
    remove_parts(folder).map_err(RunError::file(folder))?;
    match &run.env {
        WorldConfig::LavaGrid(constants) => {
            carry_out::<LavaGrid>(run, constants, folder, stop, report)
        }
        WorldConfig::LavaPoint(constants) => {
            carry_out::<LavaPoint>(run, constants, folder, stop, report)
        }
    }
}

fn carry_out<W: Exhibited>(
    run: &RunConfig,
    constants: &W::Constants,
    folder: &Path,
    stop: &Stop,
    report: &mut dyn FnMut(Report),
) -> Result<(), RunError> {
    let game = Game {
        eta: run.eta,
        gamma: run.gamma,
        seed: run.seed,
        device: evaluation::device(run.device),
        options: &run.train,
    };
    let mut attempt = Attempt::<W>::begin(run, constants, &game, folder, report)?;
    let trained = attempt.train(stop, report);
    if matches!(trained, Err(RunError::Unfinished | RunError::File { .. })) {
        return trained;
    }
    let (steps, seconds) = (attempt.steps(), attempt.seconds());
    let mut manifest = Manifest::of(run.id(), &run.device.to_string(), steps, seconds);
    manifest.failure = trained.as_ref().err().map(ToString::to_string);
    write_json(&folder.join("manifest.json"), &manifest)?;
    trained?;

    let pair = attempt.training.pair;
    let path = folder.join("final.safetensors");
    let about = format!("schema {SCHEMA}, run {}, steps {steps}", manifest.run);
    write_in_place(&path, &weights::to_bytes(&pair, about)?).map_err(RunError::file(&path))?;

    let found = stop.interruptible(|| {
        Ok::<_, RunError>((
            evaluation::protocol(run, constants, &pair)?,
            exhibits(run, constants, &pair)?,
        ))
    });
    let (found, shown) = found.ok_or(RunError::Unfinished)??;
    let path = folder.join("exhibits.json");
    let text = serde_json::to_vec(&shown).map_err(io::Error::other);
    text.and_then(|text| write_in_place(&path, &text)).map_err(RunError::file(&path))?;
    let evaluation = Evaluation {
        schema: SCHEMA,
        env: run.env.name().to_string(),
        eta: run.eta.get(),
        seed: run.seed,
        steps,
        seconds,
        plays: found.plays,
        audit: found.audit,
        certificate: found.certificate,
    };
    write_json(&folder.join("evaluation.json"), &evaluation)?;
    checkpoint::remove(folder).map_err(RunError::file(folder))
}

/// A run being trained.
struct Attempt<'a, W: Exhibited> {
    run: &'a RunConfig,
    folder: &'a Path,
    training: Training<'a, W>,
    progress: ProgressFile,
    meter: Option<RegretMeter<W>>,
    /// Seconds of training before this attempt.
    before: f64,
    start: Instant,
}

impl<'a, W: Exhibited> Attempt<'a, W> {
    /// From the last sound checkpoint or, without one, from scratch.
    fn begin(
        run: &'a RunConfig,
        constants: &W::Constants,
        game: &'a Game<'a>,
        folder: &'a Path,
        report: &mut dyn FnMut(Report),
    ) -> Result<Self, RunError> {
        let fresh = || -> Result<_, RunError> {
            Ok(Training::new(W::build(constants, run.train.parallel_episodes)?, game))
        };
        let meter = W::regret_meter(constants, run)?;
        let start = Instant::now();
        // They tell how an earlier attempt ended.
        for name in ["manifest.json", "final.safetensors", "exhibits.json"] {
            let path = folder.join(name);
            match fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(RunError::file(&path)(error));
                }
                _ => {}
            }
        }
        for path in checkpoint::list(folder).map_err(RunError::file(folder))? {
            let mut training = fresh()?;
            match resume(&path, run, folder, &mut training) {
                Ok((progress, before)) => {
                    let update = training.updates();
                    report(Report::Note(format!("goes on after update {update}")));
                    return Ok(Attempt { run, folder, training, progress, meter, before, start });
                }
                Err(error) => {
                    let name = path.file_name().unwrap_or_default().to_string_lossy();
                    report(Report::Note(format!("{name} {error}; going back before it")));
                    fs::remove_file(&path).map_err(RunError::file(&path))?;
                }
            }
        }
        let path = folder.join(ProgressFile::NAME);
        let progress = ProgressFile::create(folder).map_err(RunError::file(&path))?;
        Ok(Attempt { run, folder, training: fresh()?, progress, meter, before: 0.0, start })
    }

    /// Environment steps so far.
    fn steps(&self) -> u64 {
        self.training.updates() * self.run.train.rollout()
    }

    /// Seconds of training so far.
    fn seconds(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64()
    }

    fn train(&mut self, stop: &Stop, report: &mut dyn FnMut(Report)) -> Result<(), RunError> {
        let every = self.run.checkpoint.every;
        let mut saved = self.training.updates();
        while let Some(update) = self.training.update()? {
            let path = self.folder.join(ProgressFile::NAME);
            let (seconds, regret) = (self.seconds(), self.regret()?);
            self.progress.add(&update, seconds, regret).map_err(RunError::file(&path))?;
            report(Report::Tick(Tick { steps: update.steps, mean_return: update.mean_return }));
            let stopped = stop.signal().is_some();
            if stopped || update.update % every == 0 {
                self.save()?;
                saved = update.update;
            }
            if stopped {
                return Err(RunError::Unfinished);
            }
        }
        // The evaluation may be cut short as well.
        if saved < self.training.updates() { self.save() } else { Ok(()) }
    }

    /// The regret after the last update, if it is one at which it is measured.
    fn regret(&self) -> Result<Option<f64>, RunError> {
        let Some(meter) = &self.meter else { return Ok(None) };
        let (steps, all) = (self.steps(), self.run.train.steps);
        let points = |steps: u64| steps.min(all) * REGRET_POINTS / all;
        let due = points(steps) > points(steps - self.run.train.rollout());
        due.then(|| meter(&self.training.pair)).transpose()
    }

    fn save(&mut self) -> Result<(), RunError> {
        let path = self.folder.join(ProgressFile::NAME);
        let checkpoint = Checkpoint {
            program: BUILD.to_owned(),
            config: self.run.to_toml(),
            seconds: self.seconds(),
            progress: self.progress.extent().map_err(RunError::file(&path))?,
            training: self.training.state(),
        };
        checkpoint::save(self.folder, self.training.updates(), &checkpoint)
            .map_err(RunError::file(self.folder))
    }
}

/// Brings training to where a checkpoint was written; the file of its progress, and the seconds that
/// it took.
fn resume<W: Exhibited>(
    path: &Path,
    run: &RunConfig,
    folder: &Path,
    training: &mut Training<'_, W>,
) -> Result<(ProgressFile, f64), CheckpointError> {
    let unfit = |reason: &str| CheckpointError::Unfit(reason.to_owned());
    let checkpoint: Checkpoint<_> = checkpoint::load(path)?;
    if checkpoint.config != run.to_toml() {
        return Err(unfit("it is of another configuration"));
    }
    if checkpoint.program != BUILD {
        return Err(unfit("it is of another version of the program"));
    }
    training.restore(checkpoint.training).map_err(|error| unfit(&error.to_string()))?;
    let progress = ProgressFile::resume(folder, checkpoint.progress)
        .map_err(|error| CheckpointError::Unfit(format!("{}: {error}", ProgressFile::NAME)))?;
    Ok((progress, checkpoint.seconds))
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), RunError> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|error| RunError::file(path)(io::Error::other(error)))?;
    text.push('\n');
    write_in_place(path, text.as_bytes()).map_err(RunError::file(path))
}

/// `progress.csv`: a line per update. `seconds` is the only column that differs between two runs of
/// one seed. The same goes to TensorBoard.
struct ProgressFile {
    csv: csv::Writer<Counted>,
    events: EventFile,
    /// When training would have begun had it never been cut short, in seconds since 1970.
    begun: f64,
}

impl ProgressFile {
    const NAME: &'static str = "progress.csv";

    const COLUMNS: [&'static str; 19] = [
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
        "regret",
        "steps_per_second",
        "seconds",
    ];

    fn create(folder: &Path) -> io::Result<Self> {
        let file = File::create(folder.join(Self::NAME))?;
        let mut csv = csv::Writer::from_writer(Counted::new(file));
        csv.write_record(Self::COLUMNS)?;
        let begun = now();
        Ok(ProgressFile { csv, events: EventFile::create(folder, begun)?, begun })
    }

    /// Goes on behind `extent`; what follows it is cut off.
    fn resume(folder: &Path, extent: Extent) -> io::Result<Self> {
        let path = folder.join(Self::NAME);
        let mut file = OpenOptions::new().read(true).write(true).open(&path)?;
        let mut counted = Counted::new(file.try_clone()?);
        let mut head = (&mut file).take(extent.bytes);
        io::copy(&mut head, &mut counted.seen)?;
        if counted.seen.extent() != extent {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "its lines have changed"));
        }
        file.set_len(extent.bytes)?;
        file.seek(SeekFrom::End(0))?;
        // The events from their beginning: theirs is a format that nothing can be cut off.
        let lines: Vec<csv::StringRecord> =
            csv::Reader::from_path(&path)?.records().collect::<Result<_, _>>()?;
        let seconds = lines.last().and_then(|line| line.iter().next_back()?.parse().ok());
        let begun = now() - seconds.unwrap_or(0.0);
        let mut events = EventFile::create(folder, begun)?;
        for line in &lines {
            add_event(&mut events, begun, line)?;
        }
        Ok(ProgressFile { csv: csv::Writer::from_writer(counted), events, begun })
    }

    /// What was written so far, which is on the disk then.
    fn extent(&mut self) -> io::Result<Extent> {
        self.csv.flush()?;
        let counted = self.csv.get_ref();
        counted.file.sync_data()?;
        Ok(counted.seen.extent())
    }

    fn add(&mut self, of: &Progress, seconds: f64, regret: Option<f64>) -> io::Result<()> {
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
        let regret = regret.map_or(String::new(), |regret| format!("{regret:.6}"));
        let numbers = numbers.map(|x| format!("{x:.6}")).into_iter().chain([regret]);
        let line: csv::StringRecord = head.into_iter().chain(numbers).chain(timing).collect();
        self.csv.write_record(&line)?;
        add_event(&mut self.events, self.begun, &line)
    }
}

/// Columns of `progress.csv` by the names that users of CleanRL know.
const TAGS: [(&str, &str); 15] = [
    ("mean_return", "charts/episodic_return"),
    ("goal", "charts/goal"),
    ("lava", "charts/lava"),
    ("regret", "charts/regret"),
    ("budget", "charts/budget"),
    ("budget_use", "charts/budget_use"),
    ("learning_rate", "charts/learning_rate"),
    ("steps_per_second", "charts/SPS"),
    ("policy_loss", "losses/policy_loss"),
    ("value_loss", "losses/value_loss"),
    ("entropy", "losses/entropy"),
    ("approx_kl", "losses/approx_kl"),
    ("clip_fraction", "losses/clipfrac"),
    ("gradient_norm", "losses/gradient_norm"),
    ("explained_variance", "losses/explained_variance"),
];

/// A line of `progress.csv` as an event.
fn add_event(events: &mut EventFile, begun: f64, line: &csv::StringRecord) -> io::Result<()> {
    let field = |name: &str| {
        let place = ProgressFile::COLUMNS.iter().position(|&column| column == name)?;
        line.get(place)
    };
    let number = |name| field(name).and_then(|text| text.parse().ok()).unwrap_or(f64::NAN);
    let player = field("player").unwrap_or_default();
    let scalars = TAGS.map(|(name, tag)| (format!("{player}/{tag}"), number(name)));
    events.add(begun + number("seconds"), number("steps") as u64, &scalars)
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// A file that knows its checksum. The writer above has a buffer.
struct Counted {
    file: File,
    seen: Seen,
}

impl Counted {
    fn new(file: File) -> Self {
        Counted { file, seen: Seen::default() }
    }
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.file.write(bytes)?;
        self.seen.write(&bytes[..count])
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Length and checksum of what was written.
#[derive(Debug, Clone, Default)]
struct Seen {
    bytes: u64,
    crc: crc32fast::Hasher,
}

impl Seen {
    fn extent(&self) -> Extent {
        Extent { bytes: self.bytes, crc: self.crc.clone().finalize() }
    }
}

impl Write for Seen {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.bytes += bytes.len() as u64;
        self.crc.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
