//! The game on plain floats: budget, perturbations of chance, and the law of the return.

pub mod budget;
pub mod bump;
pub mod columns;
pub mod finite;
pub mod gaussian;
pub mod normal;
pub mod perturbation;
pub mod probit;
pub mod returns;
pub mod shift;
pub mod squashed;
