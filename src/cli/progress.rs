//! Progress on standard error, with the time that is left: bars on a terminal, otherwise a line now and then.
//!
//! Nothing here fails: if standard error is closed or full, progress is lost and the work goes on.

use super::answer::note;
use super::summary::Greedy;
use crate::exact::watch::Watch;
use crate::experiment::names::RunId;
use crate::experiment::runner::{Evaluated, Event, Tick};
use indicatif::{HumanCount, HumanDuration, MultiProgress, ProgressBar, ProgressStyle};
use std::cell::{Cell, RefCell};
use std::io::{IsTerminal, stderr};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How far one piece of work is: a bar on a terminal, otherwise a line now and then.
///
/// ```text
/// let mut meter = Meter::new("lava-point at eta 25", steps);
/// meter.set(done);
/// meter.finish();
/// ```
pub struct Meter {
    label: String,
    pace: Pace,
    bar: Option<ProgressBar>,
}

impl Meter {
    /// Work that consists of `total` equal parts, named by `label`.
    pub fn new(label: &str, total: u64) -> Self {
        let bar = stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total);
            bar.set_style(style("{prefix} [{bar:30}] {msg}"));
            bar.set_prefix(label.to_owned());
            bar
        });
        Meter { label: label.to_owned(), pace: Pace::new(total, 0), bar }
    }

    /// Says that so many parts are done.
    pub fn set(&mut self, done: u64) {
        let seconds = self.pace.seconds();
        match &self.bar {
            Some(bar) => {
                bar.set_position(done);
                bar.set_message(self.pace.text(done, seconds));
            }
            None if self.pace.is_due(seconds) => {
                note(format!("{}: {}", self.label, self.pace.text(done, seconds)));
            }
            None => {}
        }
    }

    /// Removes the bar.
    pub fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Work that is counted one by one.
pub struct Counter {
    meter: RefCell<Option<Meter>>,
    done: Cell<u64>,
}

impl Counter {
    /// Shown by a meter.
    pub fn new(meter: Meter) -> Self {
        Counter { meter: RefCell::new(Some(meter)), done: Cell::new(0) }
    }

    /// Not shown.
    pub fn silent() -> Self {
        Counter { meter: RefCell::new(None), done: Cell::new(0) }
    }

    /// One more is done.
    pub fn count(&self) {
        self.done.set(self.done.get() + 1);
        self.meter.borrow_mut().iter_mut().for_each(|meter| meter.set(self.done.get()));
    }

    /// Removes the bar.
    pub fn finish(self) {
        self.meter.take().into_iter().for_each(Meter::finish);
    }
}

/// A computation whose progress is shown by a [`Meter`].
pub struct Watched(Mutex<Meter>);

impl Watched {
    /// In shares of a thousandth.
    const PARTS: f64 = 1000.0;

    /// The computation that `label` names.
    pub fn new(label: &str) -> Self {
        Watched(Mutex::new(Meter::new(label, Self::PARTS as u64)))
    }

    /// Removes the bar.
    pub fn finish(self) {
        self.0.into_inner().unwrap_or_else(PoisonError::into_inner).finish();
    }
}

impl Watch for Watched {
    fn done(&self, share: f64) {
        let mut meter = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        meter.set((share * Self::PARTS) as u64);
    }

    fn note(&self, text: &str) {
        note(text);
    }
}

/// Seconds from the start of some work to its first line, and at least from each line to the next.
const BETWEEN_LINES: f64 = 30.0;

/// Seconds from one line to the next at most.
const MOST_BETWEEN_LINES: f64 = 60.0;

/// Lines become rarer as work takes longer: this share of its time passes until the next one.
const SHARE_BETWEEN_LINES: f64 = 0.1;

/// The speed of some work, and the time that is left of it.
#[derive(Debug)]
struct Pace {
    total: u64,
    /// Parts that were done before, at a speed that is not known.
    before: u64,
    begun: Instant,
    /// Seconds after which the next line is due.
    due: f64,
}

impl Pace {
    fn new(total: u64, before: u64) -> Self {
        Pace { total, before, begun: Instant::now(), due: BETWEEN_LINES }
    }

    /// Seconds since the start.
    fn seconds(&self) -> f64 {
        self.begun.elapsed().as_secs_f64()
    }

    /// Whether it is time for a line; if so, the next one is due later.
    fn is_due(&mut self, seconds: f64) -> bool {
        let due = seconds >= self.due;
        if due {
            self.due =
                seconds + (seconds * SHARE_BETWEEN_LINES).clamp(BETWEEN_LINES, MOST_BETWEEN_LINES);
        }
        due
    }

    /// Parts per second; `None` as long as nothing was done.
    fn rate(&self, done: u64, seconds: f64) -> Option<f64> {
        let rate = done.saturating_sub(self.before) as f64 / seconds;
        (rate > 0.0 && rate.is_finite()).then_some(rate)
    }

    /// Seconds that are left at the speed so far.
    fn left(&self, done: u64, seconds: f64) -> Option<f64> {
        Some(self.total.saturating_sub(done) as f64 / self.rate(done, seconds)?)
    }

    fn percent(&self, done: u64) -> u64 {
        // The product may exceed u64.
        (u128::from(done.min(self.total)) * 100 / u128::from(self.total.max(1))) as u64
    }

    /// How far it is in words: `40 %, about 2 minutes left`.
    fn text(&self, done: u64, seconds: f64) -> String {
        let left = match self.left(done, seconds) {
            Some(left) if done < self.total => format!(", about {} left", time(left)),
            _ => String::new(),
        };
        format!("{} %{left}", self.percent(done))
    }
}

/// Shows the progress of a sweep.
pub struct Progress {
    /// Number of runs to do.
    runs: usize,
    /// Those that have not ended, with their environment steps.
    todo: Vec<(RunId, u64)>,
    /// The pace of all steps.
    pace: Pace,
    active: Vec<Active>,
    bars: Option<Bars>,
    /// When a line was written last.
    said: Cell<Instant>,
}

/// A run that is being carried out.
struct Active {
    run: RunId,
    /// Its steps so far, in all, and of an update.
    done: u64,
    steps: u64,
    update: u64,
    /// Of its training, then of its evaluation; known after the first report of each.
    pace: Option<Pace>,
    evaluates: bool,
    bar: Option<ProgressBar>,
}

/// A bar for the sweep; above it there is one for each active run.
struct Bars {
    all: MultiProgress,
    sweep: ProgressBar,
}

impl Progress {
    /// For a sweep with these runs to do, each with its environment steps, and `finished` runs that were
    /// finished before.
    pub fn new(todo: Vec<(RunId, u64)>, finished: usize) -> Self {
        let runs = todo.len();
        let bars = (stderr().is_terminal() && runs > 0).then(|| Bars::new(runs));
        let pace = Pace::new(todo.iter().map(|(_, steps)| steps).sum(), 0);
        let progress = Progress {
            runs,
            todo,
            pace,
            active: Vec::new(),
            bars,
            said: Cell::new(Instant::now()),
        };
        if finished > 0 {
            progress.line(&format!("{finished} finished before, {runs} to do"));
        }
        progress
    }

    /// Shows an event.
    pub fn event(&mut self, event: &Event) {
        match event {
            &Event::Started { ref run, steps, update } => {
                self.close(run); // a run that is tried again
                let bar = self.bars.as_ref().map(|bars| bars.run(run, steps));
                if bar.is_none() {
                    self.line(&format!("{run} started"));
                }
                let (run, done, pace, evaluates) = (run.clone(), 0, None, false);
                self.active.push(Active { run, done, steps, update, pace, evaluates, bar });
            }
            Event::Ticked { run, tick } => self.ticked(run, tick),
            Event::Evaluating { run, evaluated } => self.evaluating(run, evaluated),
            Event::Finished { run, seconds, evaluation } => {
                let result = Greedy::of(evaluation).text(evaluation.eta);
                self.end(run, &format!("{run} finished in {}: {result}", time(*seconds)));
            }
            Event::Failed { run, seconds, reason } => {
                self.end(run, &format!("{run} failed after {}: {reason}", time(*seconds)));
            }
            Event::Quiet => self.quiet(),
            Event::Noted { run, note } => self.line(&format!("{run}: {note}")),
            Event::Stopped { run } => {
                self.close(run);
                self.line(&format!("{run} stopped"));
            }
        }
    }

    /// Removes the bars.
    pub fn finish(self) {
        if let Some(bars) = self.bars {
            bars.sweep.finish_and_clear();
        }
    }

    /// Says that it is still there, where an update takes minutes.
    fn quiet(&mut self) {
        if self.bars.is_none() && self.said.get().elapsed().as_secs_f64() >= MOST_BETWEEN_LINES {
            for Active { run, done, steps, .. } in &self.active {
                let percent = Pace::new(*steps, 0).percent(*done);
                self.line(&format!("{run}: {percent} %, and the next update takes long"));
            }
        }
    }

    fn ticked(&mut self, run: &RunId, tick: &Tick) {
        let Some(active) = self.active.iter_mut().find(|active| active.run == *run) else { return };
        active.done = tick.steps;
        let pace = active.pace.get_or_insert_with(|| {
            // A run that continues has the steps of its checkpoint before its first update.
            self.pace.before += tick.steps.saturating_sub(active.update);
            Pace::new(active.steps, tick.steps)
        });
        let seconds = pace.seconds();
        let rate = pace
            .rate(tick.steps, seconds)
            .map_or(String::new(), |rate| format!(", {} steps/s", HumanCount(rate as u64)));
        let text =
            format!("{}{rate}, return {:+.3}", pace.text(tick.steps, seconds), tick.mean_return);
        match &active.bar {
            Some(bar) => {
                bar.set_position(tick.steps);
                bar.set_message(text);
            }
            None if pace.is_due(seconds) => self.line(&format!("{run}: {text}")),
            None => {}
        }
        self.tell_the_sweep();
    }

    fn evaluating(&mut self, run: &RunId, evaluated: &Evaluated) {
        let Some(active) = self.active.iter_mut().find(|active| active.run == *run) else { return };
        let Evaluated { episodes, of } = *evaluated;
        // Those that were not seen were made before.
        self.pace.before += active.steps.saturating_sub(active.done);
        active.done = active.steps;
        if !active.evaluates {
            active.evaluates = true;
            active.pace = Some(Pace::new(of, episodes));
            if let Some(bar) = &active.bar {
                bar.set_length(of);
            }
        }
        let Some(pace) = &mut active.pace else { return };
        let seconds = pace.seconds();
        let text = format!("evaluating, {}", pace.text(episodes, seconds));
        match &active.bar {
            Some(bar) => {
                bar.set_position(episodes);
                bar.set_message(text);
            }
            None if pace.is_due(seconds) => self.line(&format!("{run}: {text}")),
            None => {}
        }
        self.tell_the_sweep();
    }

    /// How far all runs are, where there are several.
    fn tell_the_sweep(&mut self) {
        let todo: u64 = self.todo.iter().map(|(_, steps)| steps).sum();
        let active: u64 = self.active.iter().map(|active| active.done).sum();
        let steps = (self.pace.total + active).saturating_sub(todo);
        let seconds = self.pace.seconds();
        let text = self.pace.text(steps, seconds);
        match &self.bars {
            Some(bars) => bars.sweep.set_message(text),
            None if self.runs > 1 && self.pace.is_due(seconds) => {
                self.line(&format!("{} of {} runs ended, {text}", self.ended(), self.runs));
            }
            None => {}
        }
    }

    fn end(&mut self, run: &RunId, text: &str) {
        let done = self.close(run);
        if let Some(at) = self.todo.iter().position(|(todo, _)| todo == run) {
            // Another process made them, or the run failed: they say nothing about the speed.
            self.pace.before += self.todo.remove(at).1.saturating_sub(done);
        }
        if let Some(bars) = &self.bars {
            bars.sweep.inc(1);
        }
        let width = self.runs.to_string().len();
        self.line(&format!("[{:>width$}/{}] {text}", self.ended(), self.runs));
    }

    /// Number of runs that have ended.
    fn ended(&self) -> usize {
        self.runs - self.todo.len()
    }

    /// Takes a run from the active ones; the steps that it has made.
    fn close(&mut self, run: &RunId) -> u64 {
        let Some(at) = self.active.iter().position(|active| active.run == *run) else { return 0 };
        let Active { done, bar, .. } = self.active.remove(at);
        if let Some(bar) = bar {
            bar.finish_and_clear();
        }
        done
    }

    fn line(&self, text: &str) {
        self.said.set(Instant::now());
        match &self.bars {
            // Fails if the terminal is closed; the sweep continues without it.
            Some(bars) => drop(bars.all.println(text)),
            None => note(text),
        }
    }
}

impl Bars {
    fn new(runs: usize) -> Self {
        let all = MultiProgress::new();
        let sweep = all.add(ProgressBar::new(runs as u64));
        sweep.set_style(style("{pos} of {len} ended [{bar:30}] {elapsed} {msg}"));
        sweep.enable_steady_tick(Duration::from_secs(1));
        Bars { all, sweep }
    }

    /// The bar of a run.
    fn run(&self, run: &RunId, steps: u64) -> ProgressBar {
        let bar = self.all.insert_before(&self.sweep, ProgressBar::new(steps));
        bar.set_style(style("{prefix} [{bar:30}] {msg}"));
        bar.set_prefix(run.to_string());
        bar
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

#[cfg(test)]
mod tests {
    use super::*;

    fn pace(total: u64, before: u64) -> Pace {
        Pace::new(total, before)
    }

    #[test]
    fn the_time_that_is_left_follows_from_the_speed_so_far() {
        assert_eq!(pace(1_000, 0).text(400, 80.0), "40 %, about 2 minutes left");
        // Half of it was done before: 100 parts in 20 seconds.
        assert_eq!(pace(1_000, 500).text(600, 20.0), "60 %, about 80 seconds left");
        assert_eq!(pace(1_000, 0).text(1_000, 80.0), "100 %");
    }

    #[test]
    fn nothing_is_promised_before_anything_was_done() {
        for seconds in [0.0, 10.0] {
            assert_eq!(pace(10, 0).text(0, seconds), "0 %");
            assert_eq!(pace(10, 5).text(5, seconds), "50 %");
            assert_eq!(pace(0, 0).text(0, seconds), "0 %");
        }
        assert_eq!(pace(u64::MAX, 0).text(u64::MAX, 1.0), "100 %");
    }

    #[test]
    fn lines_come_every_half_minute_and_later_every_minute() {
        let mut pace = pace(10, 0);
        let mut told = Vec::new();
        for second in 0..3_600 {
            if pace.is_due(f64::from(second)) {
                told.push(second);
            }
        }
        assert_eq!(told[..3], [30, 60, 90]);
        assert!(told.windows(2).all(|pair| pair[1] - pair[0] >= 30), "{told:?}");
        assert!(told.len() < 80 && told.windows(2).all(|pair| pair[1] - pair[0] <= 60), "{told:?}");
    }
}
