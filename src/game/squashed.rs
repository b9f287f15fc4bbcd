//! Real numbers squashed into a ball: how the parameters of a family keep their bounds.

/// `y = bound * v / sqrt(1 + |v|^2)`: all of R^N onto the open ball of radius `bound`.
#[derive(Debug, Clone, Copy)]
pub struct Squashed<const N: usize> {
    /// y.
    pub value: [f64; N],
    bound: f64,
    scale: f64,
}

impl<const N: usize> Squashed<N> {
    /// The y of v.
    #[inline(always)]
    pub fn new(raw: [f64; N], bound: f64) -> Self {
        let scale = bound / (1.0 + dot(&raw, &raw)).sqrt();
        Squashed { value: scaled(&raw, scale), bound, scale }
    }

    /// Gradient by v, from the gradient by y: (bound/r) (I - u u') g with u = v/r, r^2 = 1 + |v|^2.
    #[inline(always)]
    pub fn pull_back(&self, mut gradient: [f64; N]) -> [f64; N] {
        let unit = scaled(&self.value, 1.0 / self.bound);
        let along = dot(&unit, &gradient);
        let mut i = 0;
        while i < N {
            gradient[i] = (gradient[i] - unit[i] * along) * self.scale;
            i += 1;
        }
        gradient
    }
}

#[inline(always)]
fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    let (mut sum, mut i) = (0.0, 0);
    while i < N {
        sum += a[i] * b[i];
        i += 1;
    }
    sum
}

#[inline(always)]
fn scaled<const N: usize>(of: &[f64; N], by: f64) -> [f64; N] {
    let (mut product, mut i) = (*of, 0);
    while i < N {
        product[i] *= by;
        i += 1;
    }
    product
}
