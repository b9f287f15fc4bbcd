//! Progress of a sweep on standard error: bars on a terminal, plain lines otherwise.

use super::answer::Greedy;
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::runner::Event;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use std::io::{IsTerminal, stderr};
use std::time::Duration;

/// Shows what happens in a sweep.
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
    /// For a sweep with so many runs to do and so many finished before.
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
                let told = Greedy::of(evaluation).told(evaluation.eta);
                self.end(&format!("{run} finished in {}: {told}", time(*seconds)));
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
            // Fails with the terminal; the sweep goes on without it.
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
                self.active.push((*run, bar));
            }
            Event::Ticked { run, tick } => {
                if let Some((_, bar)) = self.active.iter().find(|(active, _)| active == run) {
                    bar.set_position(tick.steps);
                    bar.set_message(format!(
                        "{:.0} steps/s, return {:+.3}",
                        bar.per_sec(),
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

/// Seconds in words: `7.3 s`, `95 s`, `12 min`.
fn time(seconds: f64) -> String {
    match seconds {
        ..10.0 => format!("{seconds:.1} s"),
        ..180.0 => format!("{seconds:.0} s"),
        _ => format!("{:.0} min", seconds / 60.0),
    }
}
