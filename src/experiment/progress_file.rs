//! `progress.csv` and TensorBoard's event file: what training reports, update by update.

use super::artefacts::Close;
use super::growing_file::{Extent, GrowingFile};
use super::tensorboard::{self, EventFile};
use crate::learn::method::{Metric, Progress};
use serde::{Deserialize, Serialize};
use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Columns before those of the method.
const HEAD: [&str; 3] = ["update", "steps", "player"];

/// Columns after those of the method.
const TAIL: [Metric; 2] = [
    Metric { column: "regret", tag: "charts/regret" },
    Metric { column: "steps_per_second", tag: "charts/SPS" },
];

/// The last column. Only it and `steps_per_second` differ between two runs of one seed.
const SECONDS: &str = "seconds";

/// A line per update, in both files.
#[derive(Debug)]
pub struct ProgressFile {
    csv: csv::Writer<GrowingFile>,
    events: EventFile,
    metrics: &'static [Metric],
    /// When training would have begun without interruptions, in seconds since 1970.
    begun: f64,
}

/// How much of both files belongs to a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProgressExtent {
    /// Of `progress.csv`.
    pub csv: Extent,
    /// Of the event file.
    pub events: Extent,
}

impl ProgressFile {
    /// Name of the file in a run's folder.
    pub const NAME: &'static str = "progress.csv";

    /// Begins the files of a run's folder.
    ///
    /// # Errors
    /// If they cannot be written.
    pub fn create(folder: &Path, metrics: &'static [Metric]) -> io::Result<Self> {
        let file = GrowingFile::create(&folder.join(Self::NAME))?;
        let mut csv = csv::Writer::from_writer(file);
        let own = metrics.iter().chain(&TAIL).map(|metric| metric.column);
        csv.write_record(HEAD.into_iter().chain(own).chain([SECONDS]))?;
        let begun = now();
        Ok(ProgressFile { csv, events: EventFile::create(folder, begun)?, metrics, begun })
    }

    /// Continues the files after `extent`, when training had taken `seconds` seconds.
    ///
    /// # Errors
    /// If they cannot be written or have changed.
    pub fn resume(
        folder: &Path,
        metrics: &'static [Metric],
        extent: ProgressExtent,
        seconds: f64,
    ) -> io::Result<Self> {
        let named = |name: &'static str| {
            move |error: io::Error| io::Error::new(error.kind(), format!("{name}: {error}"))
        };
        let file = GrowingFile::resume(&folder.join(Self::NAME), extent.csv);
        let events = EventFile::resume(folder, extent.events).map_err(named(tensorboard::FILE))?;
        let csv = csv::Writer::from_writer(file.map_err(named(Self::NAME))?);
        Ok(ProgressFile { csv, events, metrics, begun: now() - seconds })
    }

    /// What was written so far, which is on the disk then.
    ///
    /// # Errors
    /// If they cannot be written to the disk.
    pub fn extent(&mut self) -> io::Result<ProgressExtent> {
        self.csv.flush()?;
        Ok(ProgressExtent { csv: self.csv.get_ref().extent()?, events: self.events.extent()? })
    }

    /// Adds an update, with the seconds of training so far and the regret where it was measured.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn add(&mut self, of: &Progress, seconds: f64, regret: Option<f64>) -> io::Result<()> {
        let rate = of.steps as f64 / seconds;
        let number = |value: &f64| format!("{value:.6}");
        let head = [of.update.to_string(), of.steps.to_string(), of.player.to_owned()];
        let tail = [
            regret.as_ref().map_or(String::new(), number),
            format!("{rate:.0}"),
            format!("{seconds:.3}"),
        ];
        self.csv.write_record(head.into_iter().chain(of.values.iter().map(number)).chain(tail))?;
        let values = of.values.iter().copied().chain([regret.unwrap_or(f64::NAN), rate]);
        let scalars: Vec<(String, f64)> = (self.metrics.iter().chain(&TAIL).zip(values))
            .map(|(metric, value)| (format!("{}/{}", of.player, metric.tag), value))
            .collect();
        self.events.add(self.begun + seconds, of.steps, &scalars)
    }
}

/// The first update of a run after which the regret was measured to be at most `regret`.
pub fn first_close(folder: &Path, regret: f64) -> Option<Close> {
    let mut reader = csv::Reader::from_path(folder.join(ProgressFile::NAME)).ok()?;
    let header = reader.headers().ok()?.clone();
    let place = |name: &str| header.iter().position(|column| column == name);
    let (steps, measured, seconds) = (place("steps")?, place(TAIL[0].column)?, place(SECONDS)?);
    let found = reader
        .records()
        .map_while(Result::ok)
        .find(|record| record[measured].parse().is_ok_and(|value: f64| value <= regret))?;
    Some(Close { steps: found[steps].parse().ok()?, seconds: found[seconds].parse().ok()? })
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_close_update_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let mut file = ProgressFile::create(dir.path(), &[]).unwrap();
        for (update, regret) in [(1, None), (2, Some(0.3)), (3, Some(0.04)), (4, Some(0.01))] {
            let of = Progress {
                update,
                steps: 100 * update,
                player: "protagonist",
                mean_return: 0.0,
                values: Vec::new(),
            };
            file.add(&of, update as f64, regret).unwrap();
        }
        file.extent().unwrap();
        let first = |regret| first_close(dir.path(), regret).map(|of| (of.steps, of.seconds));
        assert_eq!(first(0.05), Some((300, 3.0)));
        assert_eq!(first(0.005), None);
    }
}
