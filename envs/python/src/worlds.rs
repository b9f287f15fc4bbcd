//! The worlds that Python can play, whatever their types: a line each in [`WORLDS`].

use crate::adversary::{Adversary, WorstCase};
use crate::games::{AnyGames, Games, Setup, dense, sparse};
use crate::values::{ActionArray, KindOf, Playable, Values};
use cvar_game::exact::ExactError;
use cvar_game::exact::finite::ExactWorld;
use cvar_game::exact::response::Frozen;
use cvar_game::exact::table::TablePolicy;
use cvar_game::exact::yardstick::{Comparison, Evidence, Options, Yardstick};
use cvar_game::experiment::config::{Config, RunConfig, Setting, Source, WorldConstants};
use cvar_game::experiment::frozen::FrozenOpponent;
use cvar_game::experiment::names::base_of;
use cvar_game::experiment::registry;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::returns::{ReturnLaw, ReturnSoFar};
use cvar_game::learn::inputs::{Columns, Inputs};
use cvar_game::learn::method::Players;
use cvar_game::learn::observation::Observation;
use cvar_game::learn::options::{FamilyOptions, View};
use cvar_game::learn::play::{self, Play, Watcher};
use cvar_game::learn::policy::{Draw, Mode, Policy, Streams};
use cvar_game::learn::vector_game::VectorGame;
use lava_envs::random::{Purpose, stream};
use lava_envs::{Action, FiniteModel, LavaGrid, LavaPoint, World};
use std::cell::Cell;
use std::marker::PhantomData;
use std::path::Path;

/// The worlds.
pub static WORLDS: [&dyn AnyWorld; 2] =
    [&Of::<LavaGrid>(PhantomData), &Of::<LavaPoint>(PhantomData)];

/// The world of a name, on whatever scene.
///
/// # Errors
/// If there is none; the error names those that there are.
pub fn named(name: &str) -> Result<&'static dyn AnyWorld, String> {
    let names = || WORLDS.map(|world| world.name()).join(" and ");
    let found = WORLDS.iter().find(|world| world.name() == base_of(name)).copied();
    found.ok_or_else(|| format!("there is no world {name:?}; there are {}", names()))
}

/// The constants of a world: its defaults with some changes, checked.
///
/// # Errors
/// Names the first constant that does not exist or is out of range.
pub fn constants(
    world: &str,
    changes: &serde_json::Map<String, serde_json::Value>,
) -> Result<WorldConstants, String> {
    named(world)?;
    let mut settings = vec![Setting::option("the world", "experiment.envs", vec![world])];
    for (key, value) in changes {
        let value = toml::Value::try_from(value).map_err(|error| format!("{key}: {error}"))?;
        settings.push(Setting::option(key, &format!("env.{world}.{key}"), value));
    }
    let catalogue = registry::standard().catalogue();
    let config = Config::resolve(catalogue, Source::Default, &settings);
    Ok(config.map_err(|error| error.to_string())?.world(world).constants.clone())
}

/// Who decides chance.
pub enum Chance<'a> {
    /// Chance itself.
    Nominal,
    /// The exact worst case of the greedy version of a policy, at this discount.
    WorstCase(&'a Table, f64),
    /// The antagonist of a finished run.
    Trained(&'a RunConfig, &'a Path),
    /// Python.
    Played(FamilyOptions),
}

/// Action probabilities, shape `[states, actions]` or `[times, states, actions]`.
pub struct Table {
    /// The shape.
    pub shape: Vec<usize>,
    /// The probabilities.
    pub probabilities: Vec<f64>,
}

/// What a world is, for Python.
pub struct Description {
    /// Time limit.
    pub horizon: u32,
    /// Number of actions, if they are finitely many.
    pub actions: Option<usize>,
    /// Number of states and of outcomes, if they are finitely many.
    pub finite: Option<[usize; 2]>,
    /// Length of an observation as coordinates.
    pub observation: usize,
    /// How many of its first numbers are coordinates of a place, in [-1, 1].
    pub positions: usize,
    /// Least and greatest return.
    pub returns: Option<[f64; 2]>,
    /// The constants.
    pub constants: serde_json::Value,
    /// The scene.
    pub scene: lava_envs::Scene,
}

/// Python's protagonist: chooses for rows of observations.
pub trait Chooser {
    /// The actions for observations of shape `[slots, width]`; `None` stops the play.
    fn choose(&mut self, observations: Vec<f32>, width: usize) -> Option<Values>;
}

/// A trained pair.
pub trait AnyPlayers: Send {
    /// Width of an observation.
    fn observation_size(&self) -> usize;

    /// The protagonist's actions for observations of shape `[n, width]`; sampled ones from this seed.
    ///
    /// # Errors
    /// If the observations are none of its own.
    fn act(&self, rows: &[f32], width: usize, seed: Option<u64>) -> Result<Values, String>;

    /// Action probabilities by state, or by time and state, where they exist.
    ///
    /// # Errors
    /// If the world refuses its constants.
    fn table(&self) -> Result<Option<Table>, String>;
}

/// A policy compared with the best, and the laws of its return.
pub struct Judged {
    /// The law under nominal chance.
    pub law: ReturnLaw,
    /// Of the policy that draws its actions, where it is not the same.
    pub sampled: Option<ReturnLaw>,
    /// The comparison; `None` where no optimum is known.
    pub comparison: Option<Comparison>,
}

/// A world, whatever its type.
pub trait AnyWorld: Sync {
    /// Its name.
    fn name(&self) -> &'static str;

    /// What it is.
    ///
    /// # Errors
    /// If a constant is out of range.
    fn describe(&self, constants: &WorldConstants) -> Result<Description, String>;

    /// A batch of games.
    ///
    /// # Errors
    /// If there is no such adversary.
    fn games(
        &self,
        constants: &WorldConstants,
        setup: Setup,
        chance: &Chance<'_>,
    ) -> Result<Box<dyn AnyGames>, String>;

    /// The players of a finished run.
    ///
    /// # Errors
    /// If the folder has none.
    fn load(&self, run: &RunConfig, folder: &Path) -> Result<Box<dyn AnyPlayers>, String>;

    /// Plays episodes of a policy of Python's: at this discount, so many, with this seed.
    ///
    /// # Errors
    /// If there is no such adversary.
    fn play(
        &self,
        constants: &WorldConstants,
        setup: Setup,
        chance: &Chance<'_>,
        play: (f64, u64, u64),
        chooser: &mut dyn Chooser,
    ) -> Result<Vec<play::Episode>, String>;

    /// Compares a policy with the best at a discount and a budget: a table exactly, another one by the law of its return.
    ///
    /// # Errors
    /// If the table does not fit the world.
    fn judge(
        &self,
        constants: &WorldConstants,
        at: (f64, Eta),
        policy: Result<&Table, &ReturnLaw>,
        opponent: Option<&Chance<'_>>,
    ) -> Result<Judged, String>;

    /// The policy that attains the best CVaR, as a table by time and state, where the world is finite and the time
    /// says what has been accumulated.
    ///
    /// # Errors
    /// If the world is too large.
    fn optimal_policy(
        &self,
        constants: &WorldConstants,
        at: (f64, Eta),
    ) -> Result<Option<Table>, String>;

    /// What a protagonist sees in every state of a finite world at a time, and the width of a row.
    ///
    /// # Errors
    /// If the world is not finite.
    fn sights(
        &self,
        constants: &WorldConstants,
        view: View,
        time_aware: bool,
        time: u32,
    ) -> Result<(Vec<f32>, usize), String>;

    /// The likelihood ratios of the exact worst case, shape `[times, states, outcomes]`.
    ///
    /// # Errors
    /// If the world is not finite, or the table does not fit it.
    fn worst_case(
        &self,
        constants: &WorldConstants,
        at: (f64, Eta),
        policy: &Table,
    ) -> Result<(Vec<f64>, [usize; 3]), String>;
}

/// The world `W`.
struct Of<W>(PhantomData<W>);

// It holds no `W`.
impl<W: Playable> Of<W> {
    fn constants(of: &WorldConstants) -> Result<W::Constants, String> {
        of.of::<W>().map_err(|error| error.to_string())
    }

    fn adversary(
        constants: &W::Constants,
        eta: Eta,
        chance: &Chance<'_>,
    ) -> Result<Adversary<W>, String> {
        Ok(match chance {
            Chance::Nominal => Adversary::Nominal,
            Chance::WorstCase(table, gamma) => {
                let policy = Self::policy(constants, table)?;
                Adversary::WorstCase(WorstCase::new::<W>(constants, *gamma, eta, &policy)?)
            }
            Chance::Trained(run, folder) => Adversary::Trained(Self::players(run, folder)?),
            Chance::Played(family) => Adversary::played(family)?,
        })
    }

    fn players(run: &RunConfig, folder: &Path) -> Result<Box<dyn Players<W>>, String> {
        let entry = registry::standard().entry::<W>().expect("the registry has this world");
        entry.load(run, folder).map_err(|error| error.to_string())
    }

    fn policy(constants: &W::Constants, table: &Table) -> Result<TablePolicy, String> {
        let world = W::new(constants, 1).map_err(|error| error.to_string())?;
        let model = finite(&world)?;
        let (states, actions, horizon) =
            (model.states(), model.actions(), world.horizon() as usize);
        let probabilities = table.probabilities.clone();
        let policy = match table.shape[..] {
            [s, a] if [s, a] == [states, actions] => {
                TablePolicy::stationary(states, actions, probabilities)
            }
            [t, s, a] if [t, s, a] == [horizon, states, actions] => {
                TablePolicy::timed(states, actions, probabilities)
            }
            _ => {
                let shape = &table.shape;
                return Err(format!(
                    "a policy must have shape ({states}, {actions}) or ({horizon}, {states}, {actions}), \
                     got {shape:?}"
                ));
            }
        };
        for time in 0..if policy.sees_time() { world.horizon() } else { 1 } {
            for state in (0..states).filter(|&state| model.ended(state).is_none()) {
                let row = policy.probabilities(time, state);
                let sum: f64 = row.iter().sum();
                if row.iter().any(|p| !(0.0..=1.0).contains(p)) || (sum - 1.0).abs() > 1e-4 {
                    return Err(format!(
                        "the probabilities of state {state} at time {time} are no law: {row:?}"
                    ));
                }
            }
        }
        Ok(policy)
    }

    fn yardstick(
        constants: &W::Constants,
        gamma: f64,
    ) -> Result<Option<Box<dyn Yardstick>>, String> {
        let options =
            Options { source: cvar_game::exact::yardstick::Source::Shipped, ..Options::default() };
        W::yardstick(constants, gamma, &options).map_err(|error| error.to_string())
    }
}

fn finite<W: World>(world: &W) -> Result<&dyn FiniteModel, String> {
    let none = || format!("{} has no finite number of states; use a callable policy", W::NAME);
    world.finite().ok_or_else(none)
}

impl<W: Playable> AnyWorld for Of<W> {
    fn name(&self) -> &'static str {
        W::NAME
    }

    fn describe(&self, of: &WorldConstants) -> Result<Description, String> {
        let constants = Self::constants(of)?;
        let world = W::new(&constants, 1).map_err(|error| error.to_string())?;
        Ok(Description {
            horizon: world.horizon(),
            actions: KindOf::<W>::COUNT,
            finite: world.finite().map(|model| [model.states(), model.outcomes()]),
            observation: W::OBSERVATION,
            positions: W::POSITIONS,
            returns: world.return_range(1.0),
            constants: serde_json::to_value(&constants).map_err(|error| error.to_string())?,
            scene: world.scene(),
        })
    }

    fn games(
        &self,
        of: &WorldConstants,
        setup: Setup,
        chance: &Chance<'_>,
    ) -> Result<Box<dyn AnyGames>, String> {
        let constants = Self::constants(of)?;
        let adversary = Self::adversary(&constants, setup.eta, chance)?;
        Ok(Box::new(Games::<W>::new(&constants, setup, adversary)?))
    }

    fn load(&self, run: &RunConfig, folder: &Path) -> Result<Box<dyn AnyPlayers>, String> {
        let players = Self::players(run, folder)?;
        let observation = players.observation().ok_or_else(|| {
            format!("the players of the method {} do not act on observations", run.method)
        })?;
        let constants = Self::constants(&run.env)?;
        Ok(Box::new(Loaded::<W> { players, observation, constants }))
    }

    fn play(
        &self,
        of: &WorldConstants,
        setup: Setup,
        chance: &Chance<'_>,
        (gamma, episodes, seed): (f64, u64, u64),
        chooser: &mut dyn Chooser,
    ) -> Result<Vec<play::Episode>, String> {
        let constants = Self::constants(of)?;
        let Setup { slots, view, time, eta } = setup;
        let mut adversary = Self::adversary(&constants, eta, chance)?;
        let world = W::new(&constants, slots).map_err(|error| error.to_string())?;
        let eyes = Observation::of_view(&world, view, time, eta);
        let failed = Cell::new(false);
        let (inputs, problem) = (Inputs::default(), None);
        let mut protagonist = Asked { eyes, inputs, chooser, failed: &failed, problem };
        let setting =
            Play { mode: Mode::Greedy, draw: Draw::Perturbed, eta, gamma, episodes, seed };
        let mut played = Vec::new();
        let mut world = Some(world);
        adversary.act(None, slots, |opponent| {
            let world = world.take().expect("it plays once");
            let watcher = &mut UntilFailure(&failed);
            played = play::play(world, &mut protagonist, opponent, &setting, watcher).episodes;
        })?;
        match protagonist.problem {
            Some(problem) => Err(problem),
            None => Ok(played),
        }
    }

    fn judge(
        &self,
        of: &WorldConstants,
        (gamma, eta): (f64, Eta),
        policy: Result<&Table, &ReturnLaw>,
        opponent: Option<&Chance<'_>>,
    ) -> Result<Judged, String> {
        let constants = Self::constants(of)?;
        let text = |error: &dyn std::fmt::Display| error.to_string();
        let yardstick = Self::yardstick(&constants, gamma)?;
        let exact = yardstick.as_ref().and_then(|yardstick| yardstick.exact());
        let table = policy.ok().map(|table| Self::policy(&constants, table)).transpose()?;
        let (law, sampled) = match (&table, policy, exact) {
            (Some(table), _, Some(exact)) => {
                let laws = exact.laws(table).map_err(|error| text(&error))?;
                (laws.greedy, Some(laws.sampled))
            }
            (_, Err(law), _) => (law.clone(), None),
            _ => return Err(format!("{} cannot be solved exactly", W::NAME)),
        };
        let response = match (exact, opponent) {
            (Some(exact), Some(opponent)) => {
                let mut adversary = Self::adversary(&constants, eta, opponent)?;
                let found = match &mut adversary {
                    Adversary::WorstCase(worst) => {
                        let model = W::new(&constants, 1).map_err(|error| text(&error))?;
                        exact.best_response(eta.get(), &mut FrozenWorst { worst, world: model })
                    }
                    Adversary::Trained(players) => match players.opponent() {
                        Some(mut opponent) => {
                            let frozen = FrozenOpponent::new(&constants, opponent.as_mut());
                            let mut frozen = frozen.map_err(|error| text(&error))?;
                            exact.best_response(eta.get(), &mut frozen)
                        }
                        None => Ok(None),
                    },
                    _ => Ok(None),
                };
                found.map_err(|error| text(&error))?
            }
            _ => None,
        };
        let evidence = Evidence {
            policy: table.as_ref(),
            nominal: table.is_none().then_some(&law),
            opposed: None,
            response,
        };
        let compare = |yardstick: &dyn Yardstick| yardstick.compare(eta.get(), &evidence);
        let comparison = yardstick.as_deref().map(compare).transpose();
        let comparison = comparison.map_err(|error| text(&error))?.flatten();
        Ok(Judged { law, sampled, comparison })
    }

    fn optimal_policy(
        &self,
        of: &WorldConstants,
        (gamma, eta): (f64, Eta),
    ) -> Result<Option<Table>, String> {
        let constants = Self::constants(of)?;
        let exact = match ExactWorld::<W>::new(&constants, gamma) {
            Ok(exact) => exact,
            Err(ExactError::NotFinite(_)) => return Ok(None),
            Err(error) => return Err(error.to_string()),
        };
        let mdp = exact.mdp();
        if !mdp.one_level() {
            return Ok(None);
        }
        let optimum = exact.optimum(eta.get()).map_err(|error| error.to_string())?;
        let (states, actions) = (mdp.states(), exact.model().actions());
        let shape = vec![mdp.horizon(), states, actions];
        let mut probabilities = vec![0.0; shape.iter().product()];
        for time in 0..mdp.horizon() {
            for state in (0..states).filter(|&state| mdp.ended(state).is_none()) {
                let action = optimum.policy.action(mdp, exact.node(time as u32, state));
                probabilities[(time * states + state) * actions + action] = 1.0;
            }
        }
        Ok(Some(Table { shape, probabilities }))
    }

    fn sights(
        &self,
        of: &WorldConstants,
        view: View,
        time_aware: bool,
        time: u32,
    ) -> Result<(Vec<f32>, usize), String> {
        let constants = Self::constants(of)?;
        let one = W::new(&constants, 1).map_err(|error| error.to_string())?;
        let states = finite(&one)?.states();
        if time >= one.horizon() {
            return Err(format!("time {time} is not below the time limit {}", one.horizon()));
        }
        let mut world = W::new(&constants, states).map_err(|error| error.to_string())?;
        if let Some(model) = world.finite_mut() {
            (0..states).for_each(|state| model.place(state, state, time));
        }
        let eyes = Observation::of_view(&world, view, time_aware, Eta::NEUTRAL);
        let mut inputs = Inputs::default();
        eyes.protagonist(&world, &mut inputs);
        let columns = eyes.protagonist_columns::<W>();
        Ok((dense(&inputs, columns), columns.cells + columns.numbers - columns.critic_only))
    }

    fn worst_case(
        &self,
        of: &WorldConstants,
        (gamma, eta): (f64, Eta),
        policy: &Table,
    ) -> Result<(Vec<f64>, [usize; 3]), String> {
        let constants = Self::constants(of)?;
        let world = W::new(&constants, 1).map_err(|error| error.to_string())?;
        let shape = {
            let model = finite(&world)?;
            [world.horizon() as usize, model.states(), model.outcomes()]
        };
        let policy = Self::policy(&constants, policy)?;
        let worst = WorstCase::new::<W>(&constants, gamma, eta, &policy)?;
        Ok((worst.ratios().to_vec(), shape))
    }
}

/// A worst case as the fixed antagonist of a best response.
struct FrozenWorst<'a, W> {
    worst: &'a WorstCase,
    world: W,
}

impl<W: World> Frozen for FrozenWorst<'_, W> {
    fn sees_time(&self) -> bool {
        true
    }

    fn ratios(
        &mut self,
        time: u32,
        state: usize,
        action: usize,
        budgets: &[f64],
        ratios: &mut Vec<f64>,
    ) -> bool {
        let Some(model) = self.world.finite() else { return false };
        let law = model.probabilities(state, action);
        for &budget in budgets {
            let Ok(budget) = Budget::remaining(budget) else { return false };
            ratios.extend(self.worst.within(time, state, action, &law, budget));
        }
        true
    }
}

/// Python's protagonist at play.
struct Asked<'a> {
    eyes: Observation,
    inputs: Inputs,
    chooser: &'a mut dyn Chooser,
    failed: &'a Cell<bool>,
    problem: Option<String>,
}

/// Ends the play when the protagonist has failed.
struct UntilFailure<'a>(&'a Cell<bool>);

impl<W: World> Watcher<W> for UntilFailure<'_> {
    fn before(&mut self, _: &W, _: usize) {}

    fn after(&mut self, _: &VectorGame<W>, _: usize, _: usize, _: &ReturnSoFar) {}

    fn has_enough(&self) -> bool {
        self.0.get()
    }
}

impl<W: Playable> Policy<W> for Asked<'_> {
    fn choose(
        &mut self,
        world: &W,
        _: Mode,
        streams: &mut [Streams],
        actions: &mut Vec<W::Action>,
    ) {
        if self.problem.is_none() {
            self.eyes.protagonist(world, &mut self.inputs);
            let columns = self.eyes.protagonist_columns::<W>();
            let rows = dense(&self.inputs, columns);
            let width = columns.cells + columns.numbers - columns.critic_only;
            let chosen = match self.chooser.choose(rows, width) {
                Some(values) => KindOf::<W>::read(&values, world.episodes()),
                None => Err(String::new()),
            };
            match chosen {
                Ok(chosen) => return actions.extend(chosen),
                Err(problem) => {
                    self.problem = Some(problem);
                    self.failed.set(true);
                }
            }
        }
        // The play ends as soon as its watcher asks; until then any action does.
        actions.extend(streams.iter_mut().map(|of| W::Action::uniform(&mut of.actions)));
    }

    fn probabilities(&mut self, _: &W) -> Option<Vec<f64>> {
        None
    }

    fn sees_time(&self) -> bool {
        true
    }
}

/// A trained pair of the world `W`.
struct Loaded<W: Playable> {
    players: Box<dyn Players<W>>,
    observation: Observation,
    constants: W::Constants,
}

impl<W: Playable> AnyPlayers for Loaded<W> {
    fn observation_size(&self) -> usize {
        let Columns { cells, numbers, critic_only } = self.observation.protagonist_columns::<W>();
        cells + numbers - critic_only
    }

    fn act(&self, rows: &[f32], width: usize, seed: Option<u64>) -> Result<Values, String> {
        let inputs = sparse(rows, width, self.observation.protagonist_columns::<W>())?;
        let mode = if seed.is_some() { Mode::Sampled } else { Mode::Greedy };
        let random = &mut stream(seed.unwrap_or(0), Purpose::Actions, 0);
        let actions = self.players.act(&inputs, mode, random);
        Ok(KindOf::<W>::write(&actions.expect("they look at the world through an observation")))
    }

    fn table(&self) -> Result<Option<Table>, String> {
        let mut protagonist = self.players.protagonist();
        let timed = protagonist.sees_time();
        let ask = |world: &W| protagonist.probabilities(world);
        let asked = TablePolicy::ask::<W>(&self.constants, timed, ask);
        let Some(table) = asked.map_err(|error| error.to_string())? else { return Ok(None) };
        let world = W::new(&self.constants, 1).map_err(|error| error.to_string())?;
        let model = finite(&world)?;
        let times = if timed { world.horizon() } else { 1 };
        let pairs = (0..times).flat_map(|time| (0..model.states()).map(move |state| (time, state)));
        let row = |(time, state)| table.probabilities(time, state).to_vec();
        let mut shape = vec![model.states(), model.actions()];
        if timed {
            shape.insert(0, times as usize);
        }
        Ok(Some(Table { shape, probabilities: pairs.flat_map(row).collect() }))
    }
}
