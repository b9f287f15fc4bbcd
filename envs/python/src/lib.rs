//! The module `cvar_game._core`: worlds, games and yardsticks for Python.
//!
//! Python sees few functions with plain arguments: arrays, numbers and JSON. What is pleasant to use is written in
//! Python, in `cvar_game/`. Bad input is a `ValueError` of one line; nothing here panics on it.

#![expect(clippy::needless_pass_by_value, reason = "Python hands arguments over by value")]

mod adversary;
mod games;
mod law;
mod mdp;
mod values;
mod worlds;

use cvar_game::cli;
use cvar_game::exact::yardstick::Comparison;
use cvar_game::experiment::artefacts::{Certificate, Evaluation, Findings, Play};
use cvar_game::experiment::config::RunConfig;
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::registry;
use cvar_game::files::write_in_place;
use cvar_game::game::budget::Eta;
use cvar_game::learn::options::{FamilyOptions, View};
use cvar_game::learn::policy::Mode;
use cvar_game::report::figures::{moment, rgb};
use cvar_game::report::runs::Runs;
use games::{AnyGames, Autoreset, More, Setup, Stepped};
use law::Law;
use numpy::ndarray::{ArrayView, Dimension};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray, PyReadonlyArray2,
    PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyOverflowError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use values::{Values, matrix};
use worlds::{AnyPlayers, AnyWorld, Chance, Chooser, Table};

/// An array of one dimension.
type Column<'py, T> = Bound<'py, PyArray1<T>>;

/// An array of two dimensions.
type Matrix<'py, T> = Bound<'py, PyArray2<T>>;

/// What a step of Gymnasium's vector environments returns: observation, reward, terminated, truncated, infos.
type Returned<'py> =
    (Matrix<'py, f32>, Column<'py, f64>, Column<'py, bool>, Column<'py, bool>, Bound<'py, PyDict>);

/// Bad input.
fn invalid(message: impl Into<String>) -> PyErr {
    let message: String = message.into();
    // In one line, also where a path or a name of the user's has several.
    PyValueError::new_err(message.split_whitespace().collect::<Vec<_>>().join(" "))
}

/// The numbers of an array.
///
/// # Errors
/// If they do not lie in memory as their type has to, as fields of packed records do not.
fn elements<'a, T: Element, D: Dimension>(
    array: &'a PyReadonlyArray<'_, T, D>,
) -> PyResult<ArrayView<'a, T, D>> {
    let size = size_of::<T>() as isize;
    let aligned = array.data().is_aligned() && array.strides().iter().all(|step| step % size == 0);
    if aligned {
        Ok(array.as_array())
    } else {
        Err(invalid("an array is not aligned; pass a copy of it"))
    }
}

/// A whole number; one that is too large for any use is bad input as others are.
fn index(value: &Bound<'_, PyAny>) -> PyResult<i64> {
    value.extract().map_err(|error| in_range(value, error))
}

/// A list of whole numbers, of which there is one for a slot at most.
fn indices(value: &Bound<'_, PyAny>) -> PyResult<Vec<u64>> {
    if value.len()? as u64 > MOST {
        return Err(invalid("there are more numbers than slots"));
    }
    value.extract().map_err(|error| in_range(value, error))
}

/// The same where it may be absent.
fn indices_if_any(value: &Bound<'_, PyAny>) -> PyResult<Option<Vec<u64>>> {
    if value.is_none() { Ok(None) } else { indices(value).map(Some) }
}

/// A real number, likewise.
#[derive(Debug, Clone, Copy)]
struct Real(f64);

impl<'a, 'py> FromPyObject<'a, 'py> for Real {
    type Error = PyErr;

    fn extract(value: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        value.extract().map(Real).map_err(|error| in_range(&value, error))
    }
}

fn in_range(value: &Bound<'_, PyAny>, error: PyErr) -> PyErr {
    let overflows = error.is_instance_of::<PyOverflowError>(value.py());
    if overflows { invalid("a number is out of range") } else { error }
}

/// A result, whose error is bad input.
fn valid<T>(result: Result<T, String>) -> PyResult<T> {
    result.map_err(invalid)
}

fn budget(Real(eta): Real) -> PyResult<Eta> {
    Eta::new(eta).map_err(|error| invalid(error.to_string()))
}

fn discount(Real(gamma): Real) -> PyResult<f64> {
    let possible = gamma > 0.0 && gamma <= 1.0;
    possible.then_some(gamma).ok_or_else(|| invalid(format!("gamma = {gamma} must be in (0, 1]")))
}

/// The most slots of a batch, and episodes of a play.
const MOST: u64 = 10_000_000;

fn count(name: &str, value: u64) -> PyResult<u64> {
    let possible = (1..=MOST).contains(&value);
    possible
        .then_some(value)
        .ok_or_else(|| invalid(format!("{name} = {value} must be in [1, {MOST}]")))
}

/// A mutex whose owner never leaves its value half-changed.
fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A world with constants.
#[pyclass(frozen, module = "cvar_game._core")]
struct World {
    world: &'static dyn AnyWorld,
    constants: cvar_game::experiment::config::WorldConstants,
}

#[pymethods]
impl World {
    /// The world of a name; `changes` are its constants that differ from the defaults, as JSON.
    #[new]
    fn new(name: &str, changes: &str) -> PyResult<Self> {
        let changes = serde_json::from_str(changes).map_err(|error| invalid(error.to_string()))?;
        let world = valid(worlds::named(name))?;
        Ok(World { world, constants: valid(worlds::constants(name, &changes))? })
    }

    /// What it is, as JSON.
    fn describe(&self) -> PyResult<String> {
        let of = valid(self.world.describe(&self.constants))?;
        let [states, outcomes] = of.finite.map_or([None; 2], |of| of.map(Some));
        let scene = &of.scene;
        let area = |area: &lava_envs::Area| serde_json::json!({"kind": area.kind, "min": area.min, "max": area.max});
        Ok(serde_json::json!({
            "name": self.constants.world.as_str(),
            "horizon": of.horizon,
            "actions": of.actions,
            "states": states,
            "outcomes": outcomes,
            "observation": of.observation,
            "positions": of.positions,
            "returns": of.returns,
            "constants": of.constants,
            "scene": {
                "size": scene.size,
                "cells": scene.cells,
                "start": scene.start,
                "areas": scene.areas.iter().map(area).collect::<Vec<_>>(),
            },
        })
        .to_string())
    }

    /// The scene with the way of an episode, as pixels of shape `[height, width, 3]`.
    fn picture<'py>(
        &self,
        py: Python<'py>,
        trail: PyReadonlyArray2<'_, f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let rows = elements(&trail)?;
        if rows.ncols() != 2 {
            return Err(invalid("a way has two coordinates"));
        }
        let trail: Vec<[f64; 2]> = rows.rows().into_iter().map(|row| [row[0], row[1]]).collect();
        let drawn = py.detach(|| {
            let scene = self.world.describe(&self.constants)?.scene;
            let picture = moment(&scene, &trail).ok_or("the scene is too large to be drawn")?;
            rgb(&picture.svg)
        });
        let (pixels, shape) = valid(drawn)?;
        Ok(pixels.into_pyarray(py).reshape(shape)?.into_any())
    }

    /// All that is known of the optimum at a budget: the JSON of `cvar-game exact`. What takes minutes is
    /// computed only if `compute` is true.
    fn exact(&self, py: Python<'_>, eta: Real, gamma: Real, compute: bool) -> PyResult<String> {
        let (eta, gamma) = (budget(eta)?, discount(gamma)?);
        py.detach(|| {
            use cvar_game::exact::yardstick::{Options, Source};
            let source = if compute { Source::Computed } else { Source::Shipped };
            let options = Options { source, ..Options::default() };
            let entry =
                registry::standard().world(&self.constants).map_err(|error| error.to_string())?;
            let answer = entry.solve(&self.constants, gamma, eta.get(), &options, &());
            answer.map(|answer| answer.json()).map_err(|error| error.to_string())
        })
        .map_err(invalid)
    }

    /// Exact laws and certificate of a table of action probabilities, against an opponent where there is one.
    #[pyo3(signature = (table, eta, gamma, opponent=None))]
    fn judge_table(
        &self,
        py: Python<'_>,
        table: PyReadonlyArrayDyn<'_, f64>,
        eta: Real,
        gamma: Real,
        opponent: Option<&Opponent>,
    ) -> PyResult<Judged> {
        let (eta, gamma, table) = (budget(eta)?, discount(gamma)?, read_table(&table)?);
        let judged = py.detach(|| {
            let chance = opponent.map(Opponent::chance);
            self.world.judge(&self.constants, (gamma, eta), Ok(&table), chance.as_ref())
        });
        Ok(Judged::from(valid(judged)?))
    }

    /// The comparison of a policy by the law of its return.
    fn judge_law(&self, py: Python<'_>, law: &Law, eta: Real, gamma: Real) -> PyResult<Judged> {
        let (eta, gamma) = (budget(eta)?, discount(gamma)?);
        let judged =
            py.detach(|| self.world.judge(&self.constants, (gamma, eta), Err(&law.0), None));
        Ok(Judged::from(valid(judged)?))
    }

    /// The policy that attains the best CVaR, as a table of shape `[times, states, actions]`.
    fn optimal_policy<'py>(
        &self,
        py: Python<'py>,
        eta: Real,
        gamma: Real,
    ) -> PyResult<Option<Bound<'py, PyAny>>> {
        let at = (discount(gamma)?, budget(eta)?);
        let table = valid(py.detach(|| self.world.optimal_policy(&self.constants, at)))?;
        table.map(|table| table.array(py)).transpose()
    }

    /// What a protagonist sees in every state of a finite world at a time.
    fn sights<'py>(
        &self,
        py: Python<'py>,
        features: bool,
        time_aware: bool,
        time: u32,
    ) -> PyResult<Matrix<'py, f32>> {
        let seen = self.world.sights(&self.constants, view(features), time_aware, time);
        let (rows, width) = valid(seen)?;
        matrix(py, rows, width)
    }

    /// Width of what a protagonist sees.
    fn sight_width(&self, features: bool, time: bool) -> PyResult<usize> {
        let setup = Setup { slots: 1, view: view(features), time, eta: Eta::NEUTRAL };
        Ok(valid(self.world.games(&self.constants, setup, &Chance::Nominal))?.observation_size())
    }

    /// The likelihood ratios of the exact worst case of a table, shape `[times, states, outcomes]`.
    fn worst_case<'py>(
        &self,
        py: Python<'py>,
        table: PyReadonlyArrayDyn<'_, f64>,
        eta: Real,
        gamma: Real,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (eta, gamma, table) = (budget(eta)?, discount(gamma)?, read_table(&table)?);
        let found = py.detach(|| self.world.worst_case(&self.constants, (gamma, eta), &table));
        let (ratios, shape) = valid(found)?;
        Ok(ratios.into_pyarray(py).reshape(shape)?.into_any())
    }

    /// Plays episodes of a callable, `policy(observations) -> actions`, and returns the law of the return and
    /// the product of the likelihood ratios of each episode.
    #[pyo3(signature = (policy, *, eta, gamma, episodes, slots, seed, features, time, opponent=None))]
    #[expect(clippy::too_many_arguments, reason = "Python names them")]
    fn play<'py>(
        &self,
        py: Python<'py>,
        policy: Py<PyAny>,
        eta: Real,
        gamma: Real,
        episodes: u64,
        slots: u64,
        seed: u64,
        features: bool,
        time: bool,
        opponent: Option<&Opponent>,
    ) -> PyResult<(Law, Column<'py, f64>, Column<'py, f64>)> {
        let (eta, gamma, episodes) = (budget(eta)?, discount(gamma)?, count("episodes", episodes)?);
        let slots = count("slots", slots)?.min(episodes) as usize;
        let setup = Setup { slots, view: view(features), time, eta };
        let actions = valid(self.world.describe(&self.constants))?.actions;
        let mut asking = Asking { policy: &policy, actions, error: None };
        let played = py.detach(|| {
            let chance = opponent.map_or(Chance::Nominal, Opponent::chance);
            self.world.play(&self.constants, setup, &chance, (gamma, episodes, seed), &mut asking)
        });
        if let Some(error) = asking.error {
            return Err(error);
        }
        let played = valid(played)?;
        let ratios: Vec<f64> = played.iter().map(|of| of.likelihood_ratio).collect();
        let clearance: Vec<f64> = played.iter().map(|of| of.clearance).collect();
        let law = Law::recorded(played.iter().map(|of| of.atom));
        Ok((law, ratios.into_pyarray(py), clearance.into_pyarray(py)))
    }
}

fn view(features: bool) -> View {
    if features { View::Features } else { View::Coordinates }
}

impl Table {
    fn array(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        Ok(self.probabilities.into_pyarray(py).reshape(self.shape)?.into_any())
    }
}

fn read_table(table: &PyReadonlyArrayDyn<'_, f64>) -> PyResult<Table> {
    let probabilities = elements(table)?.iter().copied().collect();
    Ok(Table { shape: table.shape().to_vec(), probabilities })
}

/// A callable of Python's as a protagonist.
struct Asking<'a> {
    policy: &'a Py<PyAny>,
    actions: Option<usize>,
    error: Option<PyErr>,
}

impl Chooser for Asking<'_> {
    fn choose(&mut self, observations: Vec<f32>, width: usize) -> Option<Values> {
        Python::attach(|py| {
            let chosen = matrix(py, observations, width)
                .and_then(|rows| self.policy.bind(py).call1((rows,)))
                .and_then(|array| Values::of_actions(&array, self.actions))
                .and_then(|values| py.check_signals().map(|()| values));
            chosen.map_err(|error| self.error = Some(error)).ok()
        })
    }
}

/// Who decides chance.
#[pyclass(frozen, module = "cvar_game._core")]
struct Opponent(Decides);

enum Decides {
    Nominal,
    WorstCase(Table, f64),
    Trained(Box<RunConfig>, PathBuf),
    Played(FamilyOptions),
}

impl Opponent {
    fn chance(&self) -> Chance<'_> {
        match &self.0 {
            Decides::Nominal => Chance::Nominal,
            Decides::WorstCase(table, gamma) => Chance::WorstCase(table, *gamma),
            Decides::Trained(run, folder) => Chance::Trained(run, folder),
            Decides::Played(family) => Chance::Played(family.clone()),
        }
    }
}

#[pymethods]
impl Opponent {
    /// Chance itself.
    #[staticmethod]
    fn nominal() -> Self {
        Opponent(Decides::Nominal)
    }

    /// The exact worst case of the greedy version of a table.
    #[staticmethod]
    fn worst_case(table: PyReadonlyArrayDyn<'_, f64>, gamma: Real) -> PyResult<Self> {
        Ok(Opponent(Decides::WorstCase(read_table(&table)?, discount(gamma)?)))
    }

    /// The antagonist of a finished run.
    #[staticmethod]
    fn trained(folder: PathBuf) -> PyResult<Self> {
        Ok(Opponent(Decides::Trained(Box::new(configuration(&folder)?), folder)))
    }

    /// Python, by the parameters of a family of perturbations (`train.family`).
    #[staticmethod]
    fn played(kind: &str, count: usize, center: Real, curvature: Real) -> PyResult<Self> {
        let (Real(center), Real(curvature)) = (center, curvature);
        let kind = kind.to_owned();
        let in_range = (1..=3).contains(&count)
            && (center > 0.0 && center <= 100.0)
            && (curvature > 0.0 && curvature <= 1e6);
        if !in_range {
            return Err(invalid(
                "a family has 1 to 3 components, a center in (0, 100] and a curvature in (0, 1000000]",
            ));
        }
        Ok(Opponent(Decides::Played(FamilyOptions { kind, count, center, curvature })))
    }
}

fn configuration(folder: &Path) -> PyResult<RunConfig> {
    let run = RunConfig::of_folder(folder, registry::standard().catalogue());
    let run = run.map_err(|error| invalid(error.to_string()))?;
    run.ok_or_else(|| invalid(format!("{} holds no run", folder.display())))
}

/// A policy compared with the best.
#[pyclass(frozen, module = "cvar_game._core")]
struct Judged {
    /// The law of the greedy policy's return.
    #[pyo3(get)]
    law: Law,
    /// That of the policy that draws its actions.
    #[pyo3(get)]
    sampled: Option<Law>,
    comparison: Option<Comparison>,
}

impl From<worlds::Judged> for Judged {
    fn from(of: worlds::Judged) -> Self {
        Judged { law: Law(of.law), sampled: of.sampled.map(Law), comparison: of.comparison }
    }
}

#[pymethods]
impl Judged {
    #[getter]
    fn optimum(&self) -> Option<f64> {
        self.comparison.map(|found| found.optimum)
    }

    #[getter]
    fn regret(&self) -> Option<f64> {
        self.comparison.map(|found| found.regret)
    }

    #[getter]
    fn regret_standard_error(&self) -> Option<f64> {
        self.comparison.map(|found| found.regret_standard_error)
    }

    #[getter]
    fn class_regret(&self) -> Option<f64> {
        self.comparison?.class_regret
    }

    #[getter]
    fn exploitability(&self) -> Option<f64> {
        Some(self.comparison?.exploitability?.epsilon)
    }

    #[getter]
    fn response_gain(&self) -> Option<f64> {
        Some(self.comparison?.exploitability?.response_gain)
    }

    #[getter]
    fn response_error(&self) -> Option<f64> {
        Some(self.comparison?.exploitability?.response_error)
    }
}

/// A batch of games.
#[pyclass(frozen, module = "cvar_game._core")]
struct Games {
    // Locked only while the interpreter is released, so that nobody waits for both.
    games: Mutex<Box<dyn AnyGames>>,
    slots: usize,
    actions: Option<usize>,
    observation_size: usize,
    situation_size: usize,
    parameters: usize,
    autoreset: Autoreset,
    tells: bool,
}

#[pymethods]
impl Games {
    #[new]
    #[pyo3(signature = (world, *, slots, features, time, eta, opponent, autoreset, tells=true))]
    #[expect(clippy::too_many_arguments, reason = "Python names them")]
    fn new(
        py: Python<'_>,
        world: &World,
        slots: u64,
        features: bool,
        time: bool,
        eta: Real,
        opponent: &Opponent,
        autoreset: &str,
        tells: bool,
    ) -> PyResult<Self> {
        let slots = count("num_envs", slots)? as usize;
        let setup = Setup { slots, view: view(features), time, eta: budget(eta)? };
        let autoreset = match autoreset {
            "next-step" => Autoreset::NextStep,
            "same-step" => Autoreset::SameStep,
            "disabled" => Autoreset::Disabled,
            _ => return Err(invalid(format!("there is no autoreset mode {autoreset:?}"))),
        };
        let made = py.detach(|| {
            let games = world.world.games(&world.constants, setup, &opponent.chance())?;
            Ok((games, world.world.describe(&world.constants)?.actions))
        });
        let (games, actions) = valid(made)?;
        Ok(Games {
            slots,
            actions,
            observation_size: games.observation_size(),
            situation_size: games.situation_size(),
            parameters: games.parameters(),
            autoreset,
            tells,
            games: Mutex::new(games),
        })
    }

    #[getter]
    fn observation_size(&self) -> usize {
        self.observation_size
    }

    #[getter]
    fn situation_size(&self) -> usize {
        self.situation_size
    }

    #[getter]
    fn parameters(&self) -> usize {
        self.parameters
    }

    /// Starts episodes in some slots and returns all observations.
    fn reset<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = indices)] slots: Vec<u64>,
        #[pyo3(from_py_with = indices_if_any)] seeds: Option<Vec<u64>>,
    ) -> PyResult<Matrix<'py, f32>> {
        if let Some(slot) = slots.iter().find(|slot| **slot >= self.slots as u64) {
            return Err(invalid(format!("there is no slot {slot}")));
        }
        let slots: Vec<usize> = slots.into_iter().map(|slot| slot as usize).collect();
        if seeds.as_ref().is_some_and(|seeds| seeds.len() != slots.len()) {
            return Err(invalid("there must be a seed for each slot"));
        }
        let observation = py.detach(|| {
            let mut games = lock(&self.games);
            games.reset(&slots, seeds.as_deref());
            games.observe()
        });
        matrix(py, observation, self.observation_size)
    }

    /// One step, as Gymnasium's vector environments return it: observation, reward, terminated, truncated, infos.
    #[pyo3(signature = (actions, parameters=None))]
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: &Bound<'py, PyAny>,
        parameters: Option<PyReadonlyArray2<'py, f32>>,
    ) -> PyResult<Returned<'py>> {
        let actions = Values::of_actions(actions, self.actions)?;
        let numbers = |array| PyResult::Ok(elements(array)?.iter().copied().collect::<Vec<f32>>());
        let parameters = parameters.as_ref().map(numbers).transpose()?;
        let stepped = py.detach(|| {
            lock(&self.games).step(&actions, parameters.as_deref(), self.autoreset, self.tells)
        });
        let Stepped { observation, reward, terminated, clearance, began, more, last } =
            valid(stepped)?;
        let infos = PyDict::new(py);
        if let Some(last) = last {
            let ended = terminated.clone().into_pyarray(py);
            let observation = matrix(py, last.observation, self.observation_size)?;
            let ends = PyDict::new(py);
            tell(&ends, "clearance", last.clearance.into_pyarray(py), &ended)?;
            if let Some(more) = last.more {
                more.tell(&ends, &ended)?;
            }
            tell(&infos, "final_obs", observation, &ended)?;
            tell(&infos, "final_info", ends, &ended)?;
        }
        let all = vec![true; self.slots].into_pyarray(py);
        tell(&infos, "clearance", clearance.into_pyarray(py), &all)?;
        match (more, began) {
            (Some(more), None) => more.tell(&infos, &all)?,
            (Some(more), Some(mut began)) if began.contains(&false) => {
                began.iter_mut().for_each(|of| *of = !*of);
                more.tell(&infos, &began.into_pyarray(py))?;
            }
            _ => {} // nobody asked, or nobody made a step
        }
        Ok((
            matrix(py, observation, self.observation_size)?,
            reward.into_pyarray(py),
            terminated.into_pyarray(py),
            vec![false; self.slots].into_pyarray(py),
            infos,
        ))
    }

    /// What the antagonist sees once these actions are chosen.
    fn situation<'py>(
        &self,
        py: Python<'py>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Matrix<'py, f32>> {
        let actions = Values::of_actions(actions, self.actions)?;
        let situation = valid(py.detach(|| lock(&self.games).situation(&actions)))?;
        matrix(py, situation, self.situation_size)
    }

    /// Distance to lava in each slot.
    fn clearance<'py>(&self, py: Python<'py>) -> Column<'py, f64> {
        py.detach(|| lock(&self.games).clearance()).into_pyarray(py)
    }

    /// Position in each slot, shape `[slots, 2]`.
    fn positions<'py>(&self, py: Python<'py>) -> PyResult<Matrix<'py, f64>> {
        matrix(py, py.detach(|| lock(&self.games).positions()), 2)
    }

    /// Steps since each slot's reset.
    fn times<'py>(&self, py: Python<'py>) -> Column<'py, i64> {
        py.detach(|| lock(&self.games).times()).into_pyarray(py)
    }

    /// The index of each slot's state, in a finite world.
    fn states<'py>(&self, py: Python<'py>) -> Option<Column<'py, i64>> {
        py.detach(|| lock(&self.games).states()).map(|states| states.into_pyarray(py))
    }

    /// All that the rest of a slot's episode depends on, as bytes.
    fn snapshot(&self, py: Python<'_>, slot: usize) -> PyResult<Vec<u8>> {
        if slot >= self.slots {
            return Err(invalid(format!("there is no slot {slot}")));
        }
        Ok(py.detach(|| lock(&self.games).snapshot(slot)))
    }

    /// Puts a slot where a snapshot was taken.
    fn restore(&self, py: Python<'_>, slot: usize, snapshot: &[u8]) -> PyResult<()> {
        if slot >= self.slots {
            return Err(invalid(format!("there is no slot {slot}")));
        }
        valid(py.detach(|| lock(&self.games).restore(slot, snapshot)))
    }
}

/// An entry of the infos of a vector environment, and the mask of the slots that it is of.
fn tell<'py>(
    infos: &Bound<'py, PyDict>,
    key: &str,
    values: impl IntoPyObject<'py>,
    mask: &Column<'py, bool>,
) -> PyResult<()> {
    infos.set_item(key, values)?;
    infos.set_item(format!("_{key}"), mask)
}

impl More {
    fn tell<'py>(self, infos: &Bound<'py, PyDict>, mask: &Column<'py, bool>) -> PyResult<()> {
        let py = infos.py();
        tell(infos, "outcome", self.outcome, mask)?;
        if let Some(nominal) = self.nominal {
            tell(infos, "nominal", nominal, mask)?;
        }
        tell(infos, "likelihood_ratio", self.ratio.into_pyarray(py), mask)?;
        tell(infos, "budget", self.budget.into_pyarray(py), mask)?;
        tell(infos, "end", self.end.into_pyarray(py), mask)
    }
}

/// The players of a finished run.
#[pyclass(frozen, module = "cvar_game._core")]
struct Run {
    run: RunConfig,
    players: Mutex<Box<dyn AnyPlayers>>,
    actions: Option<usize>,
}

#[pymethods]
impl Run {
    #[new]
    fn new(py: Python<'_>, folder: PathBuf) -> PyResult<Self> {
        let run = configuration(&folder)?;
        let loaded = py.detach(|| {
            let world = worlds::named(run.env.world.as_str())?;
            Ok((world.load(&run, &folder)?, world.describe(&run.env)?.actions))
        });
        let (players, actions) = valid(loaded)?;
        Ok(Run { run, players: Mutex::new(players), actions })
    }

    /// The resolved configuration, as JSON.
    fn configuration(&self) -> PyResult<String> {
        serde_json::to_string(&self.run).map_err(|error| invalid(error.to_string()))
    }

    /// Number of actions, if they are finitely many.
    #[getter]
    fn actions(&self) -> Option<usize> {
        self.actions
    }

    /// Width of what the protagonist sees.
    #[getter]
    fn observation_size(&self, py: Python<'_>) -> usize {
        py.detach(|| lock(&self.players).observation_size())
    }

    /// The protagonist's actions: greedy ones, or drawn ones from a seed.
    fn act(
        &self,
        py: Python<'_>,
        observations: PyReadonlyArray2<'_, f32>,
        seed: Option<u64>,
    ) -> PyResult<Values> {
        let width = observations.shape()[1];
        let rows: Vec<f32> = elements(&observations)?.iter().copied().collect();
        valid(py.detach(|| lock(&self.players).act(&rows, width, seed)))
    }

    /// Action probabilities by state, or by time and state, where the world is finite.
    fn table<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let table = valid(py.detach(|| lock(&self.players).table()))?;
        table.map(|table| table.array(py)).transpose()
    }
}

/// Writes what the greedy protagonist of a method of Python's attains, as a finished run of a results folder, and
/// returns the run's own folder. `method` may have a variant: `METHOD/VARIANT`.
#[pyfunction]
#[pyo3(signature = (out, world, judged, *, method, eta, gamma, seed, steps, seconds, clearance))]
#[expect(clippy::too_many_arguments, reason = "Python names them")]
fn write_run(
    out: PathBuf,
    world: &World,
    judged: &Judged,
    method: &str,
    eta: Real,
    gamma: Real,
    seed: u64,
    steps: u64,
    seconds: Real,
    clearance: Option<f64>,
) -> PyResult<PathBuf> {
    let text = |error: &dyn std::fmt::Display| invalid(error.to_string());
    let (method, variant) = match method.split_once('/') {
        Some((method, variant)) => (method, Some(variant.parse().map_err(|error| text(&error))?)),
        None => (method, None),
    };
    let run = RunId {
        world: world.constants.world.clone(),
        method: method.parse().map_err(|error| text(&error))?,
        variant,
        eta: budget(eta)?,
        seed,
    };
    let play = |protagonist, law: &Law, mean_clearance| Play {
        protagonist,
        chance: cvar_game::experiment::artefacts::Chance::Nominal,
        law: law.0.clone(),
        mean_clearance,
    };
    let mut plays = vec![play(Mode::Greedy, &judged.law, clearance)];
    plays.extend(judged.sampled.as_ref().map(|law| play(Mode::Sampled, law, None)));
    let certificate = judged.comparison.map(Certificate::from);
    let findings = Findings { plays, audit: None, certificate };
    let evaluation = Evaluation::new(&run, (steps, seconds.0), findings);
    let folder = run.folder(&out);
    let mut task = toml::Table::new();
    task.insert("gamma".to_owned(), discount(gamma)?.into());
    let of_world = [(world.constants.world.to_string(), world.constants.table.clone().into())];
    task.insert("env".to_owned(), toml::Value::Table(of_world.into_iter().collect()));
    let write = || -> std::io::Result<()> {
        std::fs::create_dir_all(&folder)?;
        write_in_place(&folder.join("config.toml"), task.to_string().as_bytes())?;
        let json = serde_json::to_string_pretty(&evaluation)? + "\n";
        write_in_place(&folder.join("evaluation.json"), json.as_bytes())
    };
    write().map_err(|error| invalid(format!("cannot write to {}: {error}", folder.display())))?;
    Ok(folder)
}

/// The runs of a results folder as the text of `runs.csv`, and what was left out.
#[pyfunction]
fn read_results(folder: PathBuf) -> PyResult<(String, Vec<String>)> {
    let runs = Runs::read(&folder, registry::standard());
    let runs = runs.map_err(|error| invalid(error.to_string()))?;
    Ok((runs.to_csv(), runs.notes))
}

/// The program `cvar-game`: its command line begins with the path that starts it again. Returns its exit code.
#[pyfunction]
fn program(py: Python<'_>, command: Vec<OsString>) -> u8 {
    // Nothing returns to Python before it ends, and it has its own handlers of signals.
    py.detach(|| cli::hosted(registry::standard(), &command))
}

/// The names of the worlds.
#[pyfunction]
fn worlds_of() -> Vec<&'static str> {
    worlds::WORLDS.iter().map(|world| world.name()).collect()
}

/// The scenes of the program: name, what is special about it, and its map as text.
#[pyfunction]
fn scenes_of() -> Vec<(&'static str, String, String)> {
    cvar_game::experiment::config::scenes::all()
        .map(|(name, scene)| (name, scene.about, scene.map.to_string()))
        .collect()
}

#[pymodule]
mod _core {
    #[pymodule_export]
    use super::law::Law;
    #[pymodule_export]
    use super::mdp::{Mdp, MdpWorstCase, Optimum};
    #[pymodule_export]
    use super::{
        Games, Judged, Opponent, Run, World, program, read_results, scenes_of, worlds_of, write_run,
    };
}
