//! The game on plain floats: budget, perturbations of chance, and the law of the return.

pub mod returns;
