//! Plays for the figures: what [`cvar_game::experiment::exhibits`] describes, collected step by step.

use super::evaluation::{Yardstick, play_episodes, policy_of};
use super::failure::RunError;
use crate::contest::{self, Contest, Outcome};
use crate::pair::Pair;
use crate::play::Watcher;
use cvar_game::exact::grid::ExactGrid;
use cvar_game::exact::law::evaluate;
use cvar_game::experiment::artefacts::{Chance, Mode, SCHEMA};
use cvar_game::experiment::config::RunConfig;
use cvar_game::experiment::exhibits::{
    BINS_PER_METRE, BUDGET_CLASSES, BudgetByTime, Deviations, Exhibits, GridExhibit, PointExhibit,
    ShiftMap, StoredEpisode, WorldExhibit,
};
use cvar_game::game::returns::ReturnLaw;
use lava_envs::{End, Force, GridConfig, LavaGrid, LavaPoint, Move, PointConfig};
use nalgebra::Vector2;

/// Stored episodes of each kind of chance: the first ones.
const STORED: usize = 6;
/// And so many that end in lava, the first ones among the others.
const STORED_LAVA: usize = 2;
/// Nominal episodes that are looked through for them.
const NOMINAL: u64 = 5_000;
/// Trajectories of the point mass.
const TRAJECTORIES: usize = 20;
/// Bins of the remaining budget per unit of log eta.
const BUDGET_BINS: f64 = 200.0;

/// A remaining budget above eta to this power counts as that: where delta falls towards 0 it grows
/// beyond all numbers.
const MOST_LEFT: f64 = 4.0;

/// How good a greedy protagonist is, asked of the pair during training.
pub type RegretMeter<W> = Box<dyn Fn(&Pair<W>) -> Result<f64, RunError>>;

/// A world with exhibits.
pub trait Exhibited: Yardstick {
    /// What is counted step by step under the learned antagonist.
    type Counts;

    /// Nothing counted yet.
    fn counts(constants: &Self::Constants) -> Self::Counts;

    /// Counts a step that began in `place` with `left` = log eta_t / log eta of the budget.
    fn count(counts: &mut Self::Counts, place: [f64; 2], left: f64, step: &Recorded<Self>);

    /// The exhibits that this world alone has; `counts` is `None` at eta = 1.
    ///
    /// # Errors
    /// If the world cannot be solved.
    fn exhibit(
        constants: &Self::Constants,
        run: &RunConfig,
        pair: &Pair<Self>,
        counts: Option<Self::Counts>,
        nominal: &[StoredEpisode],
    ) -> Result<WorldExhibit, RunError>;

    /// What tells the regret of a pair in training, where the optimum is known.
    ///
    /// # Errors
    /// If the world cannot be solved.
    fn regret_meter(
        constants: &Self::Constants,
        run: &RunConfig,
    ) -> Result<Option<RegretMeter<Self>>, RunError>;

    /// An action as an arrow.
    fn action_arrow(action: Self::Action) -> [f64; 2];

    /// An outcome as an arrow.
    fn outcome_arrow(outcome: Outcome<Self>) -> [f64; 2];
}

/// What was chosen and what happened.
pub struct Recorded<W: Yardstick> {
    action: W::Action,
    outcome: Outcome<W>,
    ratio: f64,
}

/// Plays for all exhibits of a trained pair.
///
/// # Errors
/// If the world refuses its constants or cannot be solved.
pub fn exhibits<W: Exhibited>(
    run: &RunConfig,
    constants: &W::Constants,
    pair: &Pair<W>,
) -> Result<Exhibits, RunError> {
    let mut setting = run.clone();
    let antagonist = pair.antagonist.is_some();
    let mut play = |episodes, chance, watcher: &mut Collector<W>| {
        setting.evaluation.episodes = episodes;
        play_episodes(&setting, constants, pair, Mode::Greedy, chance, watcher).map(|_| ())
    };
    let mut nominal = Collector::<W>::new(run, Chance::Nominal, None);
    let shadowed = if antagonist { contest::Chance::Shadowed } else { contest::Chance::Nominal };
    play(NOMINAL.min(run.evaluation.exhibit_episodes), shadowed, &mut nominal)?;
    let mut stored: Vec<StoredEpisode> = nominal.stored().cloned().collect();
    let (mut counts, mut budget) = (None, None);
    if antagonist {
        let mut perturbed =
            Collector::<W>::new(run, Chance::Antagonist, Some(W::counts(constants)));
        let episodes = run.evaluation.exhibit_episodes;
        play(episodes, contest::Chance::Antagonist, &mut perturbed)?;
        stored.extend(perturbed.stored().cloned());
        budget = Some(perturbed.budgets.summary());
        counts = perturbed.counts;
    }
    Ok(Exhibits {
        schema: SCHEMA,
        episodes: run.evaluation.exhibit_episodes,
        world: W::exhibit(constants, run, pair, counts, &nominal.first)?,
        budget,
        stored,
    })
}

/// Four decimals are more than a picture shows.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

/// Four digits that matter, of a likelihood ratio or a budget; what no f32 holds is cut off, as JSON
/// has no infinity.
fn significant(value: f64) -> f64 {
    let value = value.clamp(1e-38, 1e38);
    let unit = 10f64.powi(value.log10().floor() as i32 - 3);
    (value / unit).round() * unit
}

/// The watcher of one play.
struct Collector<W: Exhibited> {
    chance: Chance,
    /// 1 / log eta, or 0 at eta = 1.
    scale: f64,
    gamma: f64,
    counts: Option<W::Counts>,
    budgets: Budgets,
    /// The episode in each slot.
    running: Vec<StoredEpisode>,
    /// The first episodes, by index.
    first: Vec<StoredEpisode>,
    /// The first of the others that end in lava, by index.
    lava: Vec<StoredEpisode>,
}

impl<W: Exhibited> Collector<W> {
    fn new(run: &RunConfig, chance: Chance, counts: Option<W::Counts>) -> Self {
        let eta = run.eta;
        Collector {
            chance,
            scale: if eta.is_neutral() { 0.0 } else { 1.0 / eta.get().ln() },
            gamma: run.gamma,
            counts,
            budgets: Budgets::default(),
            running: Vec::new(),
            first: Vec::new(),
            lava: Vec::new(),
        }
    }

    fn stored(&self) -> impl Iterator<Item = &StoredEpisode> {
        self.first.iter().take(STORED).chain(&self.lava)
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
        list.insert(place, episode.clone());
        list.truncate(room);
    }
}

impl<W: Exhibited> Watcher<W> for Collector<W> {
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
        }
        let episode = &mut self.running[slot];
        if world.time(slot) == 0 {
            episode.path.clear();
            episode.actions.clear();
            episode.outcomes.clear();
            episode.ratios.clear();
            episode.budgets.clear();
            episode.value = 0.0;
            episode.path.push(world.position(slot).map(rounded));
        }
    }

    fn after(&mut self, contest: &Contest<W>, slot: usize, index: usize) {
        let time = self.running[slot].actions.len();
        let step = contest.steps[slot];
        let recorded = Recorded::<W> {
            action: contest.actions[slot],
            outcome: contest.outcomes[slot],
            ratio: contest.ratios[slot],
        };
        let before = contest.budgets_before[slot].get();
        if let Some(counts) = &mut self.counts {
            let left = (before.ln() * self.scale).min(MOST_LEFT);
            self.budgets.add(time, left);
            W::count(counts, self.running[slot].path[time], left, &recorded);
        }
        let episode = &mut self.running[slot];
        episode.index = index as u64;
        episode.value += self.gamma.powi(time as i32) * step.reward;
        episode.path.push(contest.world.position(slot).map(rounded));
        episode.actions.push(W::action_arrow(recorded.action).map(rounded));
        episode.outcomes.push(W::outcome_arrow(recorded.outcome).map(rounded));
        episode.ratios.push(significant(recorded.ratio));
        episode.budgets.push(significant(before));
        if let Some(end) = step.end {
            episode.end = end;
            episode.value = rounded(episode.value);
            episode.budgets.push(significant(contest.budgets[slot].get()));
            self.keep(slot);
        }
    }
}

/// log eta_t / log eta by time, as sums and histograms.
#[derive(Default)]
struct Budgets {
    sums: Vec<f64>,
    histograms: Vec<Vec<u64>>,
}

impl Budgets {
    fn add(&mut self, time: usize, left: f64) {
        if self.sums.len() <= time {
            self.sums.resize(time + 1, 0.0);
            self.histograms.resize(time + 1, Vec::new());
        }
        self.sums[time] += left;
        let histogram = &mut self.histograms[time];
        let bin = (left * BUDGET_BINS).round() as usize;
        if histogram.len() <= bin {
            histogram.resize(bin + 1, 0);
        }
        histogram[bin] += 1;
    }

    fn summary(&self) -> BudgetByTime {
        let mut summary = BudgetByTime::default();
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

impl Exhibited for LavaGrid {
    /// The map, and the counts by cell.
    type Counts = (LavaGrid, Deviations);

    fn counts(constants: &GridConfig) -> Self::Counts {
        let grid =
            LavaGrid::new(constants, 1).expect("the constants made the world that is played");
        let none = vec![0.0; grid.cells()];
        (grid, Deviations { visits: none.clone(), deviations: none })
    }

    fn count((grid, counts): &mut Self::Counts, [x, y]: [f64; 2], _: f64, step: &Recorded<Self>) {
        let cell = grid.cell(x as usize, y as usize);
        counts.visits[cell] += 1.0;
        if step.outcome != step.action.index() {
            counts.deviations[cell] += 1.0;
        }
    }

    fn exhibit(
        constants: &GridConfig,
        run: &RunConfig,
        pair: &Pair<Self>,
        counts: Option<Self::Counts>,
        _: &[StoredEpisode],
    ) -> Result<WorldExhibit, RunError> {
        let steady = ExactGrid::new(&GridConfig { slip: 0.0, ..constants.clone() }, run.gamma)?;
        let greedy = policy_of(&steady, constants, pair)?.greedy(steady.mdp());
        let occupancy = evaluate(steady.mdp(), &greedy).visits.into_iter().map(rounded).collect();
        let (mut exact, mut exact_budget) = (None, Vec::new());
        if counts.is_some() {
            let slippery = ExactGrid::new(constants, run.gamma)?;
            let greedy = policy_of(&slippery, constants, pair)?.greedy(slippery.mdp());
            let worst = slippery.worst_case(&greedy, run.eta.get())?;
            let exposure = slippery.exposure(&greedy, &worst);
            let expected =
                |per_episode: &f64| rounded(per_episode * run.evaluation.exhibit_episodes as f64);
            exact = Some(Deviations {
                visits: exposure.visits.iter().map(expected).collect(),
                deviations: exposure.deviations.iter().map(expected).collect(),
            });
            exact_budget = exposure.budget.into_iter().map(rounded).collect();
        }
        let learned = counts.map(|(_, counts)| counts);
        Ok(WorldExhibit::LavaGrid(GridExhibit { occupancy, learned, exact, exact_budget }))
    }

    fn regret_meter(
        constants: &GridConfig,
        run: &RunConfig,
    ) -> Result<Option<RegretMeter<Self>>, RunError> {
        let exact = ExactGrid::new(constants, run.gamma)?;
        let best = exact.optimum(run.eta.get())?.cvar;
        let (constants, alpha) = (constants.clone(), run.eta.alpha());
        Ok(Some(Box::new(move |pair| {
            let greedy = policy_of(&exact, &constants, pair)?.greedy(exact.mdp());
            let law: ReturnLaw = evaluate(exact.mdp(), &greedy).law;
            Ok(best - law.cvar(alpha))
        })))
    }

    fn action_arrow(action: Move) -> [f64; 2] {
        match action {
            Move::Up => [0.0, -1.0],
            Move::Down => [0.0, 1.0],
            Move::Right => [1.0, 0.0],
            Move::Left => [-1.0, 0.0],
        }
    }

    fn outcome_arrow(outcome: usize) -> [f64; 2] {
        Self::action_arrow(Move::from_index(outcome))
    }
}

/// Sums over the steps that began in each bin, by class of the remaining budget.
pub struct Shifts {
    bins: [usize; 2],
    classes: Vec<ShiftMap>,
}

impl Exhibited for LavaPoint {
    type Counts = Shifts;

    fn counts(constants: &PointConfig) -> Shifts {
        let bins = constants.arena.map(|side| (side * BINS_PER_METRE).ceil() as usize);
        let count = bins[0] * bins[1];
        let none = ShiftMap {
            visits: vec![0; count],
            shift: vec![[0.0; 2]; count],
            divergence: vec![0.0; count],
        };
        Shifts { bins, classes: vec![none; BUDGET_CLASSES] }
    }

    fn count(shifts: &mut Shifts, place: [f64; 2], left: f64, step: &Recorded<Self>) {
        let [x, y]: [usize; 2] = std::array::from_fn(|axis| {
            ((place[axis] * BINS_PER_METRE) as usize).min(shifts.bins[axis] - 1)
        });
        let bin = y * shifts.bins[0] + x;
        let class = ((left * BUDGET_CLASSES as f64) as usize).min(BUDGET_CLASSES - 1);
        let map = &mut shifts.classes[class];
        map.visits[bin] += 1;
        map.shift[bin][0] += step.outcome.x;
        map.shift[bin][1] += step.outcome.y;
        map.divergence[bin] += step.ratio.ln();
    }

    fn exhibit(
        _: &PointConfig,
        _: &RunConfig,
        _: &Pair<Self>,
        counts: Option<Shifts>,
        nominal: &[StoredEpisode],
    ) -> Result<WorldExhibit, RunError> {
        let (bins, mut shifts) =
            counts.map_or(([0, 0], Vec::new()), |shifts| (shifts.bins, shifts.classes));
        for map in &mut shifts {
            for (bin, &visits) in map.visits.iter().enumerate().filter(|(_, visits)| **visits > 0) {
                map.shift[bin] = map.shift[bin].map(|sum| rounded(sum / visits as f64));
                map.divergence[bin] = rounded(map.divergence[bin] / visits as f64);
            }
        }
        let trajectories = nominal.iter().map(|episode| episode.path.clone()).collect();
        Ok(WorldExhibit::LavaPoint(PointExhibit { trajectories, bins, shifts }))
    }

    fn regret_meter(_: &PointConfig, _: &RunConfig) -> Result<Option<RegretMeter<Self>>, RunError> {
        Ok(None)
    }

    fn action_arrow(action: Force) -> [f64; 2] {
        action.on_disc().into()
    }

    fn outcome_arrow(outcome: Vector2<f64>) -> [f64; 2] {
        outcome.into()
    }
}
