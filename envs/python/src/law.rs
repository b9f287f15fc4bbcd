//! The law of a return.

use crate::{Real, invalid};
use cvar_game::game::returns::{Atom, ReturnLaw};
use lava_envs::End;
use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;

/// The law of a return: exact, or of recorded episodes.
#[pyclass(frozen, from_py_object, module = "cvar_game._core")]
#[derive(Clone)]
pub struct Law(pub ReturnLaw);

impl Law {
    /// The law of recorded episodes.
    pub fn recorded(episodes: impl IntoIterator<Item = Atom>) -> Self {
        Law(ReturnLaw::recorded(episodes))
    }
}

fn level(Real(alpha): Real) -> PyResult<f64> {
    let possible = alpha > 0.0 && alpha <= 1.0;
    possible.then_some(alpha).ok_or_else(|| invalid(format!("alpha = {alpha} must be in (0, 1]")))
}

#[pymethods]
impl Law {
    /// Number of recorded episodes; `None` for an exact law.
    #[getter]
    fn episodes(&self) -> Option<u64> {
        self.0.episodes()
    }

    /// Values of the return, ascending.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |atom| atom.value)
    }

    /// Their probabilities.
    #[getter]
    fn probabilities<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |atom| atom.mass)
    }

    /// The lengths of their episodes.
    #[getter]
    fn steps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |atom| f64::from(atom.steps))
    }

    /// How their episodes end, as 1 goal, 2 lava, 3 time limit.
    #[getter]
    fn ends<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.column(py, |atom| match atom.end {
            End::Goal => 1.0,
            End::Lava => 2.0,
            End::Timeout => 3.0,
        })
    }

    /// The mean.
    fn mean(&self) -> f64 {
        self.0.mean()
    }

    /// The lower alpha-quantile.
    fn var(&self, alpha: Real) -> PyResult<f64> {
        Ok(self.0.var(level(alpha)?))
    }

    /// The mean of the worst alpha of the outcomes.
    fn cvar(&self, alpha: Real) -> PyResult<f64> {
        Ok(self.0.cvar(level(alpha)?))
    }

    /// Standard error of the mean; 0 for an exact law.
    fn mean_standard_error(&self) -> f64 {
        self.0.mean_standard_error()
    }

    /// Standard error of the CVaR; 0 for an exact law.
    fn cvar_standard_error(&self, alpha: Real) -> PyResult<f64> {
        Ok(self.0.cvar_standard_error(level(alpha)?))
    }
}

impl Law {
    fn column<'py>(&self, py: Python<'py>, of: impl Fn(&Atom) -> f64) -> Bound<'py, PyArray1<f64>> {
        self.0.atoms().iter().map(of).collect::<Vec<_>>().into_pyarray(py)
    }
}
