//! Real numbers squashed into a ball: how the parameters of a family keep their bounds.

use nalgebra::SVector;

/// `y = bound * v / sqrt(1 + |v|^2)`: all of R^N onto the open ball of radius `bound`.
#[derive(Debug, Clone, Copy)]
pub struct Squashed<const N: usize> {
    /// y.
    pub value: SVector<f64, N>,
    bound: f64,
    scale: f64,
}

impl<const N: usize> Squashed<N> {
    /// The y of v.
    pub fn new(raw: SVector<f64, N>, bound: f64) -> Self {
        let scale = 1.0 / (1.0 + raw.norm_squared()).sqrt();
        Squashed { value: raw * (bound * scale), bound, scale }
    }

    /// Gradient by v, from the gradient by y: (bound/r) (I - u u') g with u = v/r, r^2 = 1 + |v|^2.
    pub fn pull_back(&self, gradient: SVector<f64, N>) -> SVector<f64, N> {
        let unit = self.value / self.bound;
        (gradient - unit * unit.dot(&gradient)) * (self.bound * self.scale)
    }
}
