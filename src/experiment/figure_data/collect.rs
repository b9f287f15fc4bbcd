//! Plays for the figures: what [`super`] describes, collected step by step.

use super::{
    BIN, BUDGET_CLASSES, BudgetByTime, CellData, Deviations, FigureData, MOST_BINS, MOST_CELLS,
    MOST_STEPS, MOST_TIMES, PlaneData, ShiftMap, StoredEpisode, WorldData,
};
use crate::exact::yardstick::Solvable;
use crate::experiment::artefacts::{Chance, SCHEMA};
use crate::experiment::evaluation::Contestants;
use crate::experiment::failure::RunError;
use crate::game::returns::ReturnSoFar;
use crate::learn::method::Arena;
use crate::learn::play::Watcher;
use crate::learn::policy::{Draw, Mode, Nominal};
use crate::learn::vector_game::VectorGame;
use lava_envs::{End, Scene, World};

/// Stored episodes of each kind of chance: the first ones.
const STORED: usize = 6;
/// Further stored episodes that end in lava, the first ones among the others.
const STORED_LAVA: usize = 2;
/// Nominal episodes that are searched for them.
const NOMINAL: u64 = 5_000;
/// Trajectories in the plane.
const TRAJECTORIES: usize = 20;
/// Bins of the remaining budget per unit of log eta.
const BUDGET_BINS: f64 = 200.0;

/// A remaining budget above eta to this power counts as that: where delta falls towards 0 it grows
/// without bound.
const MOST_LEFT: f64 = 4.0;

/// The watcher of the greedy protagonist's play against its antagonist.
///
/// # Errors
/// If the world refuses its constants.
pub fn perturbed<W: Arena + Solvable>(of: &Contestants<'_, W>) -> Result<Collector, RunError> {
    let world = W::new(of.constants, 1)?;
    let (counts, episodes) = (Counts::new(&world.scene()), of.run.evaluation.figure_episodes);
    Ok(Collector::new(of, Chance::Antagonist, counts, (episodes, world.horizon())))
}

/// All figure data of trained players, from what [`perturbed`] has watched and from further plays.
///
/// # Errors
/// If the world refuses its constants or cannot be solved.
pub fn collect<W: Arena + Solvable>(
    of: &Contestants<'_, W>,
    perturbed: Collector,
) -> Result<FigureData, RunError> {
    let Contestants { run, constants, players, .. } = of;
    let episodes = run.evaluation.figure_episodes;
    let world = W::new(constants, 1)?;
    let scene = world.scene();
    // Nominal episodes carry the antagonist's likelihood ratios of what happens.
    let shown = NOMINAL.min(episodes);
    let mut nominal = Collector::new(of, Chance::Nominal, None, (shown, world.horizon()));
    match players.opponent() {
        Some(mut shadow) => {
            of.play_episodes(Mode::Greedy, shadow.as_mut(), Draw::Nominal, shown, &mut nominal)?
        }
        None => of.play_episodes(Mode::Greedy, &mut Nominal, Draw::Nominal, shown, &mut nominal)?,
    };
    let mut stored: Vec<StoredEpisode> = nominal.stored().cloned().collect();
    let (mut counts, mut budget) = (None, None);
    if players.opponent().is_some() {
        stored.extend(perturbed.stored().cloned());
        budget = Some(perturbed.budgets.summary());
        counts = perturbed.counts;
    }
    let world = if scene.cells {
        WorldData::Cells(cells(of, &scene, counts)?)
    } else {
        WorldData::Plane(plane(&scene, &nominal.first, counts))
    };
    let name = Some(run.id().to_string());
    Ok(FigureData { schema: SCHEMA, run: name, episodes, world, budget, stored })
}

/// Side of the bins of a plane.
fn bin(scene: &Scene) -> f64 {
    (scene.size[0].max(scene.size[1]) / MOST_BINS).max(BIN)
}

/// Whether a world of cells is small enough for maps.
fn has_maps(scene: &Scene) -> bool {
    scene.size[0] * scene.size[1] <= MOST_CELLS
}

/// The figure data of a world of cells.
fn cells<W: Arena + Solvable>(
    of: &Contestants<'_, W>,
    scene: &Scene,
    counts: Option<Counts>,
) -> Result<CellData, RunError> {
    let learned = counts.and_then(|counts| match counts {
        Counts::Cells { deviations, .. } => Some(deviations),
        Counts::Plane { .. } => None,
    });
    let mut data =
        CellData { occupancy: Vec::new(), learned, exact: None, exact_budget: Vec::new() };
    if !has_maps(scene) {
        return Ok(data);
    }
    let (yardstick, policy) = (of.yardstick()?, of.table()?);
    let exact = yardstick.as_ref().and_then(|yardstick| yardstick.exact());
    let (Some(exact), Some(policy)) = (exact, &policy) else { return Ok(data) };
    let rounded_all = |numbers: Vec<f64>| numbers.into_iter().map(rounded).collect();
    // The last row of cells may have more cells than there are states.
    let by_cell = |mut numbers: Vec<f64>| {
        numbers.resize((scene.size[0] * scene.size[1]) as usize, 0.0);
        numbers
    };
    data.occupancy = by_cell(rounded_all(exact.occupancy(policy)?));
    if data.learned.is_some() {
        let exposure = exact.exposure(of.run.eta.get(), policy)?;
        let episodes = of.run.evaluation.figure_episodes as f64;
        let expected = |numbers: &[f64]| numbers.iter().map(|n| rounded(n * episodes)).collect();
        data.exact = Some(Deviations {
            visits: by_cell(expected(&exposure.visits)),
            deviations: by_cell(expected(&exposure.deviations)),
        });
        data.exact_budget = rounded_all(exposure.budget);
        data.exact_budget.truncate(MOST_TIMES as usize);
    }
    Ok(data)
}

/// The figure data of a world in the plane.
fn plane(scene: &Scene, nominal: &[StoredEpisode], counts: Option<Counts>) -> PlaneData {
    let (bins, mut shifts) = match counts {
        Some(Counts::Plane { bins, classes, .. }) => (bins, classes),
        _ => ([0, 0], Vec::new()),
    };
    for map in &mut shifts {
        for (bin, &visits) in map.visits.iter().enumerate().filter(|(_, visits)| **visits > 0) {
            map.shift[bin] = map.shift[bin].map(|sum| rounded(sum / visits as f64));
            map.divergence[bin] = rounded(map.divergence[bin] / visits as f64);
        }
    }
    let trajectories = nominal.iter().map(|episode| episode.path.clone()).collect();
    PlaneData { trajectories, bins, bin: bin(scene), shifts }
}

/// Four decimals are more than a picture shows.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

/// Four significant digits of a likelihood ratio or a budget; what exceeds the range of f32 is clamped,
/// because JSON has no infinity.
fn significant(value: f64) -> f64 {
    let value = value.clamp(1e-38, 1e38);
    let unit = 10f64.powi(value.log10().floor() as i32 - 3);
    (value / unit).round() * unit
}

/// What is counted step by step under the learned antagonist.
enum Counts {
    /// By cell.
    Cells { width: usize, deviations: Deviations },
    /// Sums over the steps that began in each bin, by class of the remaining budget.
    Plane { bins: [usize; 2], bin: f64, classes: Vec<ShiftMap> },
}

/// What was chosen and what happened in one step.
struct Recorded<W: World> {
    action: W::Action,
    outcome: lava_envs::Outcome<W>,
    ratio: f64,
}

impl Counts {
    /// All counts are 0; `None` for a map that is too large to be seen.
    fn new(scene: &Scene) -> Option<Self> {
        let [width, height] = scene.size;
        if scene.cells {
            if !has_maps(scene) {
                return None;
            }
            let none = vec![0.0; (width * height) as usize];
            let deviations = Deviations { visits: none.clone(), deviations: none };
            return Some(Counts::Cells { width: width as usize, deviations });
        }
        let bin = bin(scene);
        let bins = scene.size.map(|side| ((side / bin).ceil() as usize).max(1));
        let count = bins[0] * bins[1];
        let none = ShiftMap {
            visits: vec![0; count],
            shift: vec![[0.0; 2]; count],
            divergence: vec![0.0; count],
        };
        Some(Counts::Plane { bins, bin, classes: vec![none; BUDGET_CLASSES] })
    }

    /// Counts a step that began in `place` with `left` = log eta_t / log eta of the budget.
    fn add<W: World>(&mut self, place: [f64; 2], left: f64, step: &Recorded<W>) {
        match self {
            Counts::Cells { width, deviations } => {
                let cell = place[1] as usize * *width + place[0] as usize;
                deviations.visits[cell] += 1.0;
                if W::intended(step.action).is_some_and(|intended| intended != step.outcome) {
                    deviations.deviations[cell] += 1.0;
                }
            }
            Counts::Plane { bins, bin, classes } => {
                let [x, y]: [usize; 2] =
                    std::array::from_fn(|axis| ((place[axis] / *bin) as usize).min(bins[axis] - 1));
                let bin = y * bins[0] + x;
                let class = ((left * BUDGET_CLASSES as f64) as usize).min(BUDGET_CLASSES - 1);
                let map = &mut classes[class];
                let [dx, dy] = W::outcome_arrow(step.outcome);
                map.visits[bin] += 1;
                map.shift[bin][0] += dx;
                map.shift[bin][1] += dy;
                map.divergence[bin] += step.ratio.max(f64::MIN_POSITIVE).ln();
            }
        }
    }
}

/// The watcher of one play.
pub struct Collector {
    chance: Chance,
    /// How many episodes are collected, the first ones.
    episodes: u64,
    /// 1 / log eta, or 0 at eta = 1.
    scale: f64,
    counts: Option<Counts>,
    budgets: Budgets,
    /// Steps between the places of a thinned trajectory.
    stride: usize,
    /// The episode in each slot, up to [`MOST_STEPS`] steps, if it may be one to be stored.
    running: Vec<StoredEpisode>,
    /// Where each slot is, and its time.
    now: Vec<([f64; 2], usize)>,
    /// The first episodes, by index.
    first: Vec<StoredEpisode>,
    /// The first of the others that end in lava, by index.
    lava: Vec<StoredEpisode>,
}

impl Collector {
    fn new<W: World>(
        of: &Contestants<'_, W>,
        chance: Chance,
        counts: Option<Counts>,
        (episodes, horizon): (u64, u32),
    ) -> Self {
        let eta = of.run.eta;
        Collector {
            chance,
            episodes,
            scale: if eta.is_neutral() { 0.0 } else { 1.0 / eta.get().ln() },
            counts,
            budgets: Budgets { every: horizon.div_ceil(MOST_TIMES), ..Budgets::default() },
            stride: (horizon as usize).div_ceil(MOST_STEPS),
            running: Vec::new(),
            now: Vec::new(),
            first: Vec::new(),
            lava: Vec::new(),
        }
    }

    fn stored(&self) -> impl Iterator<Item = &StoredEpisode> {
        let whole = |of: &&StoredEpisode| of.path.len() == of.actions.len() + 1;
        self.first.iter().take(STORED).chain(&self.lava).filter(whole)
    }

    /// Whether the episode of this index may be one to be stored.
    fn may_store(&self, index: u64) -> bool {
        let room = self.lava.len() < STORED_LAVA;
        index < TRAJECTORIES as u64 || room || self.lava.last().is_some_and(|of| index < of.index)
    }

    /// Keeps the episode that has ended in the slot, if it is one to be stored.
    fn keep(&mut self, slot: usize) {
        let episode = &self.running[slot];
        let (list, room) = if episode.index < TRAJECTORIES as u64 {
            (&mut self.first, TRAJECTORIES)
        } else if episode.end == End::Lava {
            (&mut self.lava, STORED_LAVA)
        } else {
            return;
        };
        let place = list.partition_point(|kept| kept.index < episode.index);
        list.insert(place, episode.rounded());
        list.truncate(room);
    }
}

impl StoredEpisode {
    /// The same with as many digits as the file has.
    fn rounded(&self) -> StoredEpisode {
        let pairs = |list: &[[f64; 2]]| list.iter().map(|pair| pair.map(rounded)).collect();
        let numbers = |list: &[f64]| list.iter().copied().map(significant).collect();
        StoredEpisode {
            value: rounded(self.value),
            path: pairs(&self.path),
            actions: pairs(&self.actions),
            outcomes: pairs(&self.outcomes),
            ratios: numbers(&self.ratios),
            budgets: numbers(&self.budgets),
            ..*self
        }
    }
}

impl<W: World> Watcher<W> for Collector {
    fn before(&mut self, world: &W, slot: usize) {
        if self.running.len() <= slot {
            let none = StoredEpisode {
                chance: self.chance,
                index: 0,
                end: End::Timeout,
                value: 0.0,
                path: Vec::new(),
                actions: Vec::new(),
                outcomes: Vec::new(),
                ratios: Vec::new(),
                budgets: Vec::new(),
            };
            self.running.resize(slot + 1, none);
            self.now.resize(slot + 1, Default::default());
        }
        self.now[slot] = (world.position(slot), world.time(slot) as usize);
    }

    fn after(&mut self, game: &VectorGame<W>, slot: usize, index: usize, so_far: &ReturnSoFar) {
        if index as u64 >= self.episodes {
            return;
        }
        let (place, time) = self.now[slot];
        let step = game.steps[slot];
        let recorded = Recorded::<W> {
            action: game.actions[slot],
            outcome: game.outcomes[slot],
            ratio: game.ratios[slot],
        };
        let before = game.budgets_before[slot].get();
        let left = (before.ln() * self.scale).min(MOST_LEFT);
        if self.chance == Chance::Antagonist {
            self.budgets.add(time, left);
        }
        if let Some(counts) = &mut self.counts {
            counts.add(place, left, &recorded);
        }
        if !self.may_store(index as u64) {
            return;
        }
        let episode = &mut self.running[slot];
        if time == 0 {
            episode.index = index as u64;
            episode.path.clear();
            episode.actions.clear();
            episode.outcomes.clear();
            episode.ratios.clear();
            episode.budgets.clear();
            episode.path.push(place);
        }
        let whole = time < MOST_STEPS;
        if whole || time.is_multiple_of(self.stride) || step.end.is_some() {
            episode.path.push(game.world.position(slot));
        }
        if whole {
            episode.actions.push(W::action_arrow(recorded.action));
            episode.outcomes.push(W::outcome_arrow(recorded.outcome));
            episode.ratios.push(recorded.ratio);
            episode.budgets.push(before);
        }
        if let Some(end) = step.end {
            episode.end = end;
            episode.value = so_far.value;
            episode.budgets.push(game.budgets[slot].get());
            self.keep(slot);
        }
    }
}

/// log eta_t / log eta by time, as sums and histograms.
#[derive(Default)]
struct Budgets {
    /// Steps from one recorded time to the next.
    every: u32,
    sums: Vec<f64>,
    histograms: Vec<Vec<u64>>,
}

impl Budgets {
    fn add(&mut self, time: usize, left: f64) {
        if !time.is_multiple_of(self.every as usize) {
            return;
        }
        let time = time / self.every as usize;
        if self.sums.len() <= time {
            self.sums.resize(time + 1, 0.0);
            self.histograms.resize(time + 1, Vec::new());
        }
        self.sums[time] += left;
        let histogram = &mut self.histograms[time];
        let bin = (left * BUDGET_BINS + 0.5) as usize;
        if histogram.len() <= bin {
            histogram.resize(bin + 1, 0);
        }
        histogram[bin] += 1;
    }

    fn summary(&self) -> BudgetByTime {
        let mut summary = BudgetByTime {
            every: self.every,
            running: Vec::new(),
            mean: Vec::new(),
            low: Vec::new(),
            high: Vec::new(),
        };
        for (sum, histogram) in self.sums.iter().zip(&self.histograms) {
            let running: u64 = histogram.iter().sum();
            let quantile = |share: f64| {
                let mut below = 0;
                let reached = |count: &u64| {
                    below += count;
                    below as f64 >= share * running as f64
                };
                histogram.iter().position(reached).unwrap_or_default() as f64 / BUDGET_BINS
            };
            summary.running.push(running);
            summary.mean.push(rounded(sum / running as f64));
            summary.low.push(rounded(quantile(0.1)));
            summary.high.push(rounded(quantile(0.9)));
        }
        summary
    }
}
