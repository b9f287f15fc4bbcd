//! Progress of a sweep on standard error: bars on a terminal, plain lines otherwise.

use super::summary::Greedy;
use crate::experiment::names::RunId;
use crate::experiment::runner::Event;
use indicatif::{HumanCount, HumanDuration, MultiProgress, ProgressBar, ProgressStyle};
use std::io::{IsTerminal, stderr};
use std::time::Duration;

/// Shows the progress of a sweep.
pub struct Progress {
    /// Number of runs to do.
    runs: usize,
    ended: usize,
    bars: Option<Bars>,
}

/// A bar for the sweep and, above it, one for each active run.
struct Bars {
    all: MultiProgress,
    sweep: ProgressBar,
    active: Vec<(RunId, ProgressBar)>,
}

impl Progress {
    /// For a sweep with `runs` runs to do and `finished` runs that were finished before.
    pub fn new(runs: usize, finished: usize) -> Self {
        let bars = (stderr().is_terminal() && runs > 0).then(|| Bars::new(runs));
        let progress = Progress { runs, ended: 0, bars };
        if finished > 0 {
            progress.line(&format!("{finished} finished before, {runs} to do"));
        }
        progress
    }

    /// Shows an event.
    pub fn event(&mut self, event: &Event) {
        if let Some(bars) = &mut self.bars {
            bars.event(event);
        }
        match event {
            Event::Started { run, .. } if self.bars.is_none() => {
                self.line(&format!("{run} started"));
            }
            Event::Finished { run, seconds, evaluation } => {
                let result = Greedy::of(evaluation).text(evaluation.eta);
                self.end(&format!("{run} finished in {}: {result}", time(*seconds)));
            }
            Event::Failed { run, seconds, reason } => {
                self.end(&format!("{run} failed after {}: {reason}", time(*seconds)));
            }
            Event::Noted { run, note } => self.line(&format!("{run}: {note}")),
            Event::Stopped { run } => self.line(&format!("{run} stopped")),
            Event::Started { .. } | Event::Ticked { .. } => {}
        }
    }

    /// Removes the bars.
    pub fn finish(self) {
        if let Some(bars) = self.bars {
            bars.sweep.finish_and_clear();
        }
    }

    fn end(&mut self, text: &str) {
        self.ended += 1;
        let width = self.runs.to_string().len();
        self.line(&format!("[{:>width$}/{}] {text}", self.ended, self.runs));
    }

    fn line(&self, text: &str) {
        match &self.bars {
            // Fails if the terminal is closed; the sweep continues without it.
            Some(bars) => drop(bars.all.println(text)),
            None => eprintln!("{text}"),
        }
    }
}

impl Bars {
    fn new(runs: usize) -> Self {
        let all = MultiProgress::new();
        let sweep = all.add(ProgressBar::new(runs as u64));
        sweep.set_style(style("{pos}/{len} runs [{bar:30}] {elapsed}"));
        sweep.enable_steady_tick(Duration::from_secs(1));
        Bars { all, sweep, active: Vec::new() }
    }

    fn event(&mut self, event: &Event) {
        match event {
            Event::Started { run, steps } => {
                self.active.retain(|(active, _)| active != run); // a run that is tried again
                let bar = self.all.insert_before(&self.sweep, ProgressBar::new(*steps));
                bar.set_style(style("{prefix} [{bar:30}] {percent:>3} % {msg}"));
                bar.set_prefix(run.to_string());
                self.active.push((run.clone(), bar));
            }
            Event::Ticked { run, tick } => {
                if let Some((_, bar)) = self.active.iter().find(|(active, _)| active == run) {
                    bar.set_position(tick.steps);
                    bar.set_message(format!(
                        "{} steps/s, return {:+.3}",
                        HumanCount(bar.per_sec() as u64),
                        tick.mean_return
                    ));
                }
            }
            Event::Noted { .. } => {}
            Event::Finished { run, .. } | Event::Failed { run, .. } | Event::Stopped { run } => {
                self.active.retain(|(active, bar)| {
                    if active == run {
                        bar.finish_and_clear();
                    }
                    active != run
                });
                self.sweep.inc(u64::from(!matches!(event, Event::Stopped { .. })));
            }
        }
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template)
        .expect("the templates here are valid")
        .progress_chars("=> ")
}

/// Seconds in words: `0.4 s`, `12 seconds`, `5 minutes`.
fn time(seconds: f64) -> String {
    if seconds < 10.0 {
        return format!("{seconds:.1} s"); // whole seconds would say 0
    }
    HumanDuration(Duration::try_from_secs_f64(seconds).unwrap_or_default()).to_string()
}
