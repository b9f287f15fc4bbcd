//! The registry: the worlds and methods of the program, by name.
//!
//! A world or a method is one file and one line in [`standard`]. A program of your own lists its own
//! with [`crate::registry!`] and hands them to [`crate::cli::main`]; see `examples/windy_corridor.rs`.

use super::archive;
use super::artefacts::{Chance, Play};
use super::config::catalogue::MethodChecks;
use super::config::{Catalogue, MethodInfo, RunConfig, WorldConstants, WorldInfo};
use super::evaluation::{self, Contestants};
use super::failure::RunError;
use super::names::{RunId, WorldName, base_of};
use super::run;
use super::runner::{Report, WEIGHTS};
use super::steps::{self, Format};
use super::stop::Stop;
use crate::exact::walk::Walk;
use crate::exact::watch::Watch;
use crate::exact::yardstick::{Answer, Options, Solvable, Source, Yardstick};
use crate::game::returns::ReturnLaw;
use crate::learn::family::Perturbed;
use crate::learn::method::{Arena, MethodEntry, Players};
use crate::learn::policy::Mode;
use crate::learn::weights;
use lava_envs::{Scene, World};
use std::any::Any;
use std::io::{self, Write};
use std::path::Path;
use std::sync::LazyLock;

/// Worlds and methods, each with a line.
///
/// ```
/// use cvar_game::learn::methods::{Game, Uniform};
/// use lava_envs::LavaGrid;
///
/// let registry = cvar_game::registry! { worlds: LavaGrid; methods: Game, Uniform };
/// assert_eq!(registry.worlds().collect::<Vec<_>>(), ["lava-grid"]);
/// ```
#[macro_export]
macro_rules! registry {
    (worlds: $($world:ty),+ $(,)?; methods: $($method:ty),+ $(,)?) => {
        $crate::registry!(@worlds [$($world),+] [$($method),+])
    };
    // The product of the two lists, a world at a time.
    (@worlds [$($world:ty),+] $methods:tt) => {
        $crate::experiment::registry::Registry::new(vec![
            $($crate::registry!(@world $world, $methods)),+
        ])
    };
    (@world $world:ty, [$($method:ty),+]) => {
        Box::new(
            $crate::experiment::registry::WorldEntry::<$world>::new()
                $(.with::<$method>())+
        )
    };
}

/// The worlds and methods of this program.
pub fn standard() -> &'static Registry {
    use crate::learn::methods::{
        Augmented, CvarPg, Game, Iqn, Neutral, Rarl, ReturnCapping, Uniform,
    };
    use lava_envs::{LavaGrid, LavaPoint, Table};
    static STANDARD: LazyLock<Registry> = LazyLock::new(|| {
        crate::registry! {
            worlds: LavaGrid, LavaPoint, Table;
            methods: Game, Neutral, Augmented, ReturnCapping, CvarPg, Rarl, Iqn, Uniform
        }
    });
    &STANDARD
}

/// The worlds and methods of a program.
pub struct Registry {
    worlds: Vec<Box<dyn Entry>>,
    catalogue: Catalogue,
}

impl Registry {
    /// The registry of these worlds, for [`crate::registry!`].
    ///
    /// # Panics
    /// If the annotated defaults of a world or a method are not valid.
    pub fn new(worlds: Vec<Box<dyn Entry>>) -> Self {
        let infos = worlds.iter().map(|world| world.info()).collect();
        let methods = worlds.first().map_or(Vec::new(), |world| world.methods());
        let mut families: Vec<&str> = worlds.iter().flat_map(|world| world.families()).collect();
        families.sort_unstable();
        families.dedup();
        Registry { catalogue: Catalogue::new(infos, methods, families), worlds }
    }

    /// The part of the worlds and methods in configurations.
    pub fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// The names of the worlds.
    pub fn worlds(&self) -> impl Iterator<Item = &'static str> {
        self.catalogue.worlds.iter().map(|world| world.name)
    }

    /// The world of these constants.
    ///
    /// # Errors
    /// If this program has no world of that name.
    pub fn world(&self, of: &WorldConstants) -> Result<&dyn Entry, RunError> {
        let name = of.world.base();
        self.named(name).ok_or_else(|| RunError::UnknownWorld(name.to_owned()))
    }

    /// The world `W` with its methods, if it is one of them.
    pub fn entry<W: Arena + Solvable>(&self) -> Option<&WorldEntry<W>> {
        self.worlds.iter().find_map(|world| (&**world as &dyn Any).downcast_ref())
    }

    /// The world of a name, on whatever scene, if there is one.
    pub fn named(&self, name: &str) -> Option<&dyn Entry> {
        self.worlds.iter().find(|world| world.name() == base_of(name)).map(Box::as_ref)
    }
}

/// What to play with a finished run.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    /// Who decides the law of chance.
    pub chance: Chance,
    /// Episodes of each play, if not those of the run's configuration.
    pub episodes: Option<u64>,
    /// Seed of the streams, if not that of the run's configuration.
    pub seed: Option<u64>,
    /// Constants of the world, if not those of training.
    pub constants: Option<&'a WorldConstants>,
    /// Called at the end of each episode.
    pub progress: &'a dyn Fn(),
}

impl Request<'_> {
    fn apply(&self, run: &RunConfig) -> RunConfig {
        let mut run = run.clone();
        run.evaluation.episodes = self.episodes.unwrap_or(run.evaluation.episodes);
        run.evaluation.seed = self.seed.unwrap_or(run.evaluation.seed);
        run
    }
}

/// A world with its methods, whatever their types.
pub trait Entry: Any + Send + Sync {
    /// The world's name.
    fn name(&self) -> &'static str;

    /// The world's part in configurations.
    fn info(&self) -> WorldInfo;

    /// The methods' part in configurations.
    fn methods(&self) -> Vec<MethodInfo>;

    /// The kinds of families of perturbations that fit the world.
    fn families(&self) -> Vec<&'static str>;

    /// Carries out a run, see [`run::execute`].
    ///
    /// # Errors
    /// If training fails or an artefact cannot be written.
    fn execute(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
    ) -> Result<(), RunError>;

    /// Plays the finished run in `folder` again; writes nothing.
    ///
    /// # Errors
    /// If the folder holds no weights of the run or the request makes no sense for it.
    fn evaluate(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
    ) -> Result<Vec<Play>, RunError>;

    /// The law of the return of the finished run's greedy protagonist under nominal chance: exact where it can be
    /// computed.
    ///
    /// # Errors
    /// As [`Entry::evaluate`].
    fn greedy_law(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
    ) -> Result<ReturnLaw, RunError>;

    /// What single changes of the finished run's greedy protagonist are worth, at the run's budget or another.
    ///
    /// # Errors
    /// As [`Entry::evaluate`], and if the world is not finite.
    fn changes(
        &self,
        run: &RunConfig,
        folder: &Path,
        eta: Option<f64>,
    ) -> Result<Box<dyn Answer>, RunError>;

    /// Writes every step of episodes of the finished run in `folder`.
    ///
    /// # Errors
    /// As [`Entry::evaluate`], and if the output accepts no more.
    fn rollout(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
        rows: (Mode, Format),
        output: &mut dyn Write,
    ) -> Result<(), RunError>;

    /// All that is known of the optimum at a budget.
    ///
    /// # Errors
    /// If nothing is known, or it cannot be computed.
    fn solve(
        &self,
        constants: &WorldConstants,
        gamma: f64,
        eta: f64,
        options: &Options,
        watch: &dyn Watch,
    ) -> Result<Box<dyn Answer>, RunError>;

    /// What figures draw of the world; `None` if the constants are not its own.
    fn scene(&self, constants: &toml::Table) -> Option<Scene>;

    /// The laws of the return of the policies that are optimal at some budgets, where the world can be
    /// solved exactly.
    fn frontier(&self, constants: &toml::Table, gamma: f64, etas: &[f64])
    -> Option<Vec<ReturnLaw>>;

    /// The law of the return of the best policy that is known at a budget: exactly optimal, or of a
    /// certificate that comes with the program. `None` if there is no such certificate.
    ///
    /// # Errors
    /// If the world has no yardstick, or it cannot be computed for these constants.
    fn optimum(
        &self,
        constants: &toml::Table,
        gamma: f64,
        eta: f64,
    ) -> Result<Option<ReturnLaw>, RunError>;

    /// Episodes of that policy, on the streams of an evaluation with this seed; see [`Yardstick::walks`].
    ///
    /// [`Yardstick::walks`]: crate::exact::yardstick::Yardstick::walks
    ///
    /// # Errors
    /// As [`Entry::optimum`].
    fn walks(
        &self,
        constants: &toml::Table,
        gamma: f64,
        eta: f64,
        seed: u64,
        count: u64,
    ) -> Result<Vec<Walk>, RunError>;

    /// What an episode can be: the least and the greatest return, discounted by gamma, and the time limit.
    /// `None` if the constants are not the world's own, or it does not say.
    fn limits(&self, constants: &toml::Table, gamma: f64) -> Option<Limits>;
}

/// What an episode of a world can be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// The least and the greatest return.
    pub returns: [f64; 2],
    /// The most steps.
    pub horizon: u32,
}

/// A world with its methods.
pub struct WorldEntry<W: Arena> {
    methods: Vec<MethodEntry<W>>,
}

impl<W: Arena> Default for WorldEntry<W> {
    fn default() -> Self {
        WorldEntry { methods: Vec::new() }
    }
}

impl<W: Arena> WorldEntry<W> {
    /// The world, without methods.
    pub fn new() -> Self {
        WorldEntry::default()
    }

    /// The same with a method more.
    #[must_use]
    pub fn with<M: crate::learn::method::Method>(mut self) -> Self {
        self.methods.push(MethodEntry::of::<M>());
        self
    }

    fn method(&self, run: &RunConfig) -> Result<&MethodEntry<W>, RunError> {
        let found = self.methods.iter().find(|method| method.name == run.method.as_str());
        found.ok_or_else(|| RunError::UnknownMethod(run.method.to_string()))
    }

    /// The trained players of the finished run in `folder`.
    ///
    /// # Errors
    /// If neither the folder nor the archive above it holds weights of the run, or its method is none of this program.
    pub fn load(&self, run: &RunConfig, folder: &Path) -> Result<Box<dyn Players<W>>, RunError> {
        let (path, bytes) = archive::read_file(folder, WEIGHTS).map_err(RunError::file(folder))?;
        let bytes = bytes.ok_or_else(|| RunError::NoWeights(path.display().to_string()))?;
        require_own(&weights::about(&bytes)?, &run.id()).map_err(RunError::file(&path))?;
        let world = W::new(&constants::<W>(&run.env)?, 1)?;
        let mut players = (self.method(run)?.players)(&world, &run.setting());
        players.load(&bytes)?;
        Ok(players)
    }
}

/// Refuses weights whose header names another run. Weights of other programs name none, and those of former
/// versions neither method nor variant.
fn require_own(about: &Option<String>, id: &RunId) -> io::Result<()> {
    let words = about.as_deref().and_then(|about| about.split("run ").nth(1));
    let Some(found) = words.and_then(|words| words.split(',').next()) else { return Ok(()) };
    let former = found.split('/').count() == 3;
    let same = |found: RunId| {
        let place = |of: &RunId| (of.world.clone(), of.eta, of.seed);
        found == *id || former && place(&found) == place(id)
    };
    if found.parse().is_ok_and(same) {
        return Ok(());
    }
    let problem = format!(
        "it holds the weights of the run {found}, but this is the folder of {id}; put the run's own \
         weights back, or move the folder away and train it again"
    );
    Err(io::Error::new(io::ErrorKind::InvalidData, problem))
}

fn constants<W: World>(of: &WorldConstants) -> Result<W::Constants, RunError> {
    Ok(of.of::<W>()?)
}

impl<W: Arena + Solvable> Entry for WorldEntry<W> {
    fn name(&self) -> &'static str {
        W::NAME
    }

    fn info(&self) -> WorldInfo {
        let checks = |of: &MethodEntry<W>| MethodChecks {
            method: of.name,
            options: of.check,
            schedule: of.check_schedule,
        };
        WorldInfo::of::<W>(self.methods.iter().map(checks).collect())
    }

    fn methods(&self) -> Vec<MethodInfo> {
        let info = |of: &MethodEntry<W>| MethodInfo { name: of.name, defaults: of.defaults };
        self.methods.iter().map(info).collect()
    }

    fn families(&self) -> Vec<&'static str> {
        W::Law::FAMILIES.iter().map(|family| family.kind).collect()
    }

    fn execute(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
    ) -> Result<(), RunError> {
        let constants = constants::<W>(&run.env)?;
        run::execute(self.method(run)?, &constants, run, folder, stop, report)
    }

    fn evaluate(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
    ) -> Result<Vec<Play>, RunError> {
        let constants = constants::<W>(request.constants.unwrap_or(&run.env))?;
        let run = request.apply(run);
        let players = self.load(&run, folder)?;
        let (run, constants, players) = (&run, &constants, &*players);
        let contestants = Contestants { run, constants, players, progress: request.progress };
        evaluation::plays(&contestants, request.chance)
    }

    fn greedy_law(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
    ) -> Result<ReturnLaw, RunError> {
        let constants = constants::<W>(request.constants.unwrap_or(&run.env))?;
        let run = request.apply(run);
        let players = self.load(&run, folder)?;
        let (run, constants, players) = (&run, &constants, &*players);
        Contestants { run, constants, players, progress: request.progress }.greedy_law()
    }

    fn changes(
        &self,
        run: &RunConfig,
        folder: &Path,
        eta: Option<f64>,
    ) -> Result<Box<dyn Answer>, RunError> {
        let constants = &constants::<W>(&run.env)?;
        let players = &*self.load(run, folder)?;
        let contestants = Contestants { run, constants, players, progress: &|| () };
        Ok(Box::new(contestants.changes(eta.unwrap_or(run.eta.get()))?))
    }

    fn rollout(
        &self,
        run: &RunConfig,
        folder: &Path,
        request: &Request<'_>,
        (mode, format): (Mode, Format),
        output: &mut dyn Write,
    ) -> Result<(), RunError> {
        let (mut run, constants) = (request.apply(run), constants::<W>(&run.env)?);
        let slots = &mut run.evaluation.parallel_episodes;
        *slots = (*slots).min(steps::MOST_PARALLEL);
        let players = self.load(&run, folder)?;
        let (run, constants, players) = (&run, &constants, &*players);
        let contestants = Contestants { run, constants, players, progress: request.progress };
        steps::write_rollout(&contestants, mode, request.chance, format, output)
    }

    fn solve(
        &self,
        of: &WorldConstants,
        gamma: f64,
        eta: f64,
        options: &Options,
        watch: &dyn Watch,
    ) -> Result<Box<dyn Answer>, RunError> {
        let yardstick = W::yardstick(&constants::<W>(of)?, gamma, options)?;
        let answer = yardstick.map(|yardstick| yardstick.answer(eta, watch)).transpose()?.flatten();
        answer.ok_or_else(|| RunError::NoYardstick(W::NAME.to_owned()))
    }

    fn scene(&self, constants: &toml::Table) -> Option<Scene> {
        let constants = constants.clone().try_into().ok()?;
        W::new(&constants, 1).ok().map(|world| world.scene())
    }

    fn frontier(
        &self,
        constants: &toml::Table,
        gamma: f64,
        etas: &[f64],
    ) -> Option<Vec<ReturnLaw>> {
        let constants = constants.clone().try_into().ok()?;
        let yardstick = W::yardstick(&constants, gamma, &Options::default()).ok()??;
        yardstick.exact()?; // a curve of sampled laws would have their errors
        let law = |eta: &f64| yardstick.optimal_law(*eta).ok()?;
        Some(etas.iter().filter_map(law).collect())
    }

    fn optimum(
        &self,
        of: &toml::Table,
        gamma: f64,
        eta: f64,
    ) -> Result<Option<ReturnLaw>, RunError> {
        Ok(shipped_yardstick::<W>(of, gamma)?.optimal_law(eta)?)
    }

    fn walks(
        &self,
        of: &toml::Table,
        gamma: f64,
        eta: f64,
        seed: u64,
        count: u64,
    ) -> Result<Vec<Walk>, RunError> {
        Ok(shipped_yardstick::<W>(of, gamma)?.walks(eta, seed, count)?)
    }

    fn limits(&self, constants: &toml::Table, gamma: f64) -> Option<Limits> {
        let constants = constants.clone().try_into().ok()?;
        let world = W::new(&constants, 1).ok()?;
        Some(Limits { returns: world.return_range(gamma)?, horizon: world.horizon() })
    }
}

/// The yardstick of a world with these constants, from what comes with the program.
fn shipped_yardstick<W: Arena + Solvable>(
    of: &toml::Table,
    gamma: f64,
) -> Result<Box<dyn Yardstick>, RunError> {
    let constants = WorldConstants { world: WorldName::of::<W>(), table: of.clone() };
    let constants = self::constants::<W>(&constants)?;
    let options = Options { source: Source::Shipped, ..Options::default() };
    let yardstick = W::yardstick(&constants, gamma, &options)?;
    yardstick.ok_or_else(|| RunError::NoYardstick(W::NAME.to_owned()))
}
