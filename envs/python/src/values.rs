//! Actions, outcomes and laws as arrays: whole numbers where they are finitely many, rows of coordinates where
//! they are points of the plane.

use crate::{elements, invalid};
use cvar_game::exact::yardstick::Solvable;
use cvar_game::learn::method::Arena;
use lava_envs::action::{Action, ActionKind, Finite, Plane};
use lava_envs::{Discrete, FiniteLaw, Force, GaussianLaw, Law, World};
use nalgebra::Vector2;
use numpy::{
    IntoPyArray, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

/// Values of a batch.
#[derive(Clone)]
pub enum Values {
    /// Indices, shape `[slots]`.
    Indices(Vec<i64>),
    /// Numbers, shape `[slots, width]`.
    Rows(Vec<f64>, usize),
}

impl<'py> IntoPyObject<'py> for Values {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self {
            Values::Indices(indices) => Ok(indices.into_pyarray(py).into_any()),
            Values::Rows(rows, width) => Ok(matrix(py, rows, width)?.into_any()),
        }
    }
}

/// Numbers as a matrix of this width.
pub fn matrix<'py, T: numpy::Element>(
    py: Python<'py>,
    numbers: Vec<T>,
    width: usize,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let rows = numbers.len() / width.max(1);
    numbers.into_pyarray(py).reshape([rows, width])
}

impl Values {
    /// Reads the actions of a batch: integers where there are `count` of them, real numbers otherwise.
    ///
    /// # Errors
    /// If the array has another type or number of dimensions.
    pub fn of_actions(array: &Bound<'_, PyAny>, count: Option<usize>) -> PyResult<Values> {
        match count {
            Some(_) => {
                let array: PyReadonlyArray1<'_, i64> = (array.extract())
                    .map_err(|_| invalid("actions must be integers of shape (slots,)"))?;
                Ok(Values::Indices(elements(&array)?.to_vec()))
            }
            None => {
                let array: PyReadonlyArray2<'_, f64> = (array.extract())
                    .map_err(|_| invalid("actions must be real numbers of shape (slots, 2)"))?;
                let width = array.shape()[1];
                Ok(Values::Rows(elements(&array)?.iter().copied().collect(), width))
            }
        }
    }
}

/// A kind of actions that arrays can hold.
pub trait ActionArray<A: Action>: ActionKind {
    /// Number of actions; `None` where they are pushes in the plane.
    const COUNT: Option<usize>;

    /// Reads an action per slot.
    ///
    /// # Errors
    /// Says what is wrong: the number of actions, or one that there is not.
    fn read(values: &Values, slots: usize) -> Result<Vec<A>, String>;

    /// The actions as an array.
    fn write(actions: &[A]) -> Values;
}

impl<const N: usize, A: Discrete> ActionArray<A> for Finite<N> {
    const COUNT: Option<usize> = Some(N);

    fn read(values: &Values, slots: usize) -> Result<Vec<A>, String> {
        let Values::Indices(indices) = values else {
            return Err(format!("actions must be integers of shape ({slots},)"));
        };
        if indices.len() != slots {
            let found = indices.len();
            return Err(format!("actions must have shape ({slots},), got ({found},)"));
        }
        let action = |&index: &i64| {
            let known = usize::try_from(index).ok().filter(|index| *index < N);
            let unknown = || format!("action {index} does not exist; use 0 to {}", N - 1);
            known.map(A::from_index).ok_or_else(unknown)
        };
        indices.iter().map(action).collect()
    }

    fn write(actions: &[A]) -> Values {
        Values::Indices(actions.iter().map(|action| action.index() as i64).collect())
    }
}

impl ActionArray<Force> for Plane {
    const COUNT: Option<usize> = None;

    fn read(values: &Values, slots: usize) -> Result<Vec<Force>, String> {
        let (numbers, width) = match values {
            Values::Rows(numbers, width) => (numbers, *width),
            Values::Indices(_) => (&Vec::new(), 0),
        };
        if width != 2 || numbers.len() != 2 * slots {
            let found = numbers.len() / width.max(1);
            return Err(format!("actions must have shape ({slots}, 2), got ({found}, {width})"));
        }
        let push = |pair: &[f64; 2]| {
            let [x, y] = *pair;
            let infinite = || format!("the action ({x}, {y}) is not finite");
            (x.is_finite() && y.is_finite()).then(|| Force(Vector2::new(x, y))).ok_or_else(infinite)
        };
        numbers.as_chunks().0.iter().map(push).collect()
    }

    fn write(actions: &[Force]) -> Values {
        Values::Rows(actions.iter().flat_map(|Force(push)| [push.x, push.y]).collect(), 2)
    }
}

/// A law of chance that arrays can hold.
pub trait LawArray: Law {
    /// The outcomes as an array.
    fn outcomes(outcomes: &[Self::Outcome]) -> Values;

    /// The probabilities of all outcomes; `None` where outcomes are not finitely many: then the law is the
    /// standard normal one.
    fn probabilities(laws: &[Self]) -> Option<Values>;
}

impl<const N: usize> LawArray for FiniteLaw<N> {
    fn outcomes(outcomes: &[usize]) -> Values {
        Values::Indices(outcomes.iter().map(|&outcome| outcome as i64).collect())
    }

    fn probabilities(laws: &[Self]) -> Option<Values> {
        let mut rows = Vec::with_capacity(laws.len() * N);
        laws.iter().for_each(|law| rows.extend_from_slice(&law.probabilities));
        Some(Values::Rows(rows, N))
    }
}

impl LawArray for GaussianLaw {
    fn outcomes(outcomes: &[Vector2<f64>]) -> Values {
        Values::Rows(outcomes.iter().flat_map(|noise| [noise.x, noise.y]).collect(), 2)
    }

    fn probabilities(_: &[Self]) -> Option<Values> {
        None
    }
}

/// A world that Python can play: its actions and its law of chance are of a known kind.
pub trait Playable:
    Arena<Action: Action<Kind: ActionArray<<Self as World>::Action>>, Law: LawArray> + Solvable
{
}

impl<W> Playable for W where
    W: Arena<Action: Action<Kind: ActionArray<<W as World>::Action>>, Law: LawArray> + Solvable
{
}

/// The kind of a world's actions.
pub type KindOf<W> = <<W as World>::Action as Action>::Kind;
