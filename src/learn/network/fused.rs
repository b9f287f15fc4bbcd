//! The network's passes on the processor: `SAMPLES` samples at a time, from the inputs to the gradient,
//! without leaving the first-level cache.
//!
//! With so few inputs and outputs, general matrix products spend most of their time on packing, and
//! every step of a whole minibatch through memory costs more than its arithmetic. A block holds its
//! numbers sample by sample in rows: row i of `x` is input i of all its samples.

use super::{Outputs, Shape};
use crate::learn::inputs::Rows;
use pulp::{Arch, Simd, WithSimd};

/// Samples of a block: a multiple of the width of any vector register.
const SAMPLES: usize = 32;

/// Numbers that begin at a multiple of 64 bytes: a vector load then stays within one cache line.
#[derive(Debug, Default)]
struct Aligned(Vec<f32>);

impl Aligned {
    /// `length` numbers, whose values are those of the last call or zero.
    fn slice(&mut self, length: usize) -> &mut [f32] {
        const LINE: usize = 64;
        self.0.resize(length + LINE / size_of::<f32>(), 0.0);
        let start = self.0.as_ptr().align_offset(LINE);
        &mut self.0[start..start + length]
    }
}

/// What the passes keep between calls, so that nothing is allocated in them.
#[derive(Debug, Default)]
pub struct Fused {
    x: Aligned,
    h: Aligned,
    y: Aligned,
    /// Gradients of W' and of V, a partial sum per lane.
    by_first: Aligned,
    by_second: Aligned,
}

/// tanh, by the rational approximation of degree 13/6 that Eigen and XLA use; a test checks it to 1e-6.
#[inline(always)]
fn tanh<S: Simd>(simd: S, z: S::f32s) -> S::f32s {
    const LIMIT: f32 = 7.905_311; // beyond it tanh is 1 in f32
    const P: [f32; 7] = [
        -2.760_768_5e-16,
        2.000_188e-13,
        -8.604_672e-11,
        5.122_297e-8,
        1.485_722_4e-5,
        6.372_619e-4,
        4.893_524_6e-3,
    ];
    const Q: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];
    let z = simd.max_f32s(simd.min_f32s(z, simd.splat_f32s(LIMIT)), simd.splat_f32s(-LIMIT));
    let square = simd.mul_f32s(z, z);
    let mut p = simd.splat_f32s(P[0]);
    for c in &P[1..] {
        p = simd.mul_add_e_f32s(p, square, simd.splat_f32s(*c));
    }
    let mut q = simd.splat_f32s(Q[0]);
    for c in &Q[1..] {
        q = simd.mul_add_e_f32s(q, square, simd.splat_f32s(*c));
    }
    simd.div_f32s(simd.mul_f32s(z, p), q)
}

/// Loads a block of samples, of which the last may have fewer; the rest is zero.
fn load(inputs: &[f32], width: usize, x: &mut [f32]) {
    x.fill(0.0);
    for (sample, numbers) in inputs.chunks_exact(width).enumerate() {
        for (row, &number) in x.chunks_exact_mut(SAMPLES).zip(numbers) {
            row[sample] = number;
        }
    }
}

/// h = tanh(W x) of as many hidden units as `h` has rows, from `first` on.
#[inline(always)]
fn hidden_layer<S: Simd>(
    simd: S,
    shape: Shape,
    parameters: &[f32],
    first: usize,
    cells: &[u32],
    x: &[f32],
    h: &mut [f32],
) {
    let units = 2 * shape.hidden;
    let (columns, weights) = parameters.split_at(shape.columns.cells * units);
    // What a cell adds to z is its column of W.
    h.fill(0.0);
    for (sample, &cell) in cells.iter().enumerate() {
        let column = &columns[cell as usize * units + first..];
        for (z, &weight) in h.chunks_exact_mut(SAMPLES).zip(column) {
            z[sample] = weight;
        }
    }
    let (x, _) = S::as_simd_f32s(x);
    let (h, _) = S::as_mut_simd_f32s(h);
    let vectors = SAMPLES / S::F32_LANES;
    for (unit, h) in h.chunks_exact_mut(vectors).enumerate() {
        for (vector, h) in h.iter_mut().enumerate() {
            let mut z = *h;
            for (input, x) in x.chunks_exact(vectors).enumerate() {
                let weight = simd.splat_f32s(weights[input * units + first + unit]);
                z = simd.mul_add_e_f32s(weight, x[vector], z);
            }
            *h = tanh(simd, z);
        }
    }
}

/// A row of V h + b.
#[inline(always)]
fn output<S: Simd>(simd: S, weights: &[f32], bias: f32, h: &[f32], y: &mut [f32]) {
    // Several independent sums: an addition depends only on the previous one of its own sum.
    const SUMS: usize = 4;
    let (h, _) = S::as_simd_f32s(h);
    let (y, _) = S::as_mut_simd_f32s(y);
    let vectors = SAMPLES / S::F32_LANES;
    for (vector, y) in y.iter_mut().enumerate() {
        let mut sums = [simd.splat_f32s(0.0); SUMS];
        sums[0] = simd.splat_f32s(bias);
        for (weights, h) in weights.chunks(SUMS).zip(h.chunks(SUMS * vectors)) {
            for (i, &weight) in weights.iter().enumerate() {
                let h = h[i * vectors + vector];
                sums[i] = simd.mul_add_e_f32s(simd.splat_f32s(weight), h, sums[i]);
            }
        }
        let [a, b, c, d] = sums;
        *y = simd.add_f32s(simd.add_f32s(a, b), simd.add_f32s(c, d));
    }
}

/// Some rows of y on a batch.
pub struct Evaluate<'a> {
    /// Sizes of the network.
    pub shape: Shape,
    /// Its parameters.
    pub parameters: &'a [f32],
    /// n samples.
    pub inputs: Rows<'a>,
    /// The critic's row, or else the actor's.
    pub critic: bool,
    /// Outputs, shape `[rows, n]`.
    pub outputs: &'a mut Vec<f32>,
}

impl Evaluate<'_> {
    /// Writes the outputs.
    pub fn run(self) {
        Arch::new().dispatch(self);
    }
}

impl WithSimd for Evaluate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Evaluate { shape, parameters, inputs, critic, outputs } = self;
        let (width, hidden) = (shape.width(), shape.hidden);
        let (first, rows) =
            if critic { (hidden, shape.outputs..shape.rows()) } else { (0, 0..shape.outputs) };
        let samples = inputs.numbers.len() / width;
        outputs.resize(rows.len() * samples, 0.0);
        let (mut x, mut h) = (Aligned::default(), Aligned::default());
        let (x, h) = (x.slice(width * SAMPLES), h.slice(hidden * SAMPLES));
        let mut y = [0.0; SAMPLES];
        for (block, inputs) in inputs.blocks(SAMPLES, width).enumerate() {
            load(inputs.numbers, width, x);
            hidden_layer(simd, shape, parameters, first, inputs.cells, x, h);
            let start = block * SAMPLES;
            let end = samples.min(start + SAMPLES);
            for (index, row) in rows.clone().enumerate() {
                let at = shape.second_at(row, first);
                let bias = parameters[shape.bias_at() + row];
                output(simd, &parameters[at..at + hidden], bias, h, &mut y);
                outputs[index * samples + start..index * samples + end]
                    .copy_from_slice(&y[..end - start]);
            }
        }
    }
}

/// Outputs and gradient in one.
pub struct Differentiate<'a, L> {
    /// Sizes of the network.
    pub shape: Shape,
    /// Its parameters.
    pub parameters: &'a [f32],
    /// n samples.
    pub inputs: Rows<'a>,
    /// Receives the gradient by W, V and b.
    pub gradient: &'a mut [f32],
    /// Turns outputs into gradients.
    pub loss: L,
    /// What is kept between calls.
    pub buffers: &'a mut Fused,
}

impl<L: FnMut(Outputs<'_>)> Differentiate<'_, L> {
    /// Writes the gradient.
    pub fn run(self) {
        Arch::new().dispatch(self);
    }
}

impl<L: FnMut(Outputs<'_>)> WithSimd for Differentiate<'_, L> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Differentiate { shape, parameters, inputs, gradient, mut loss, buffers } = self;
        let (width, hidden, units) = (shape.width(), shape.hidden, 2 * shape.hidden);
        let Fused { x, h, y, by_first, by_second } = buffers;
        let x = x.slice(width * SAMPLES);
        let h = h.slice(units * SAMPLES);
        let y = y.slice(shape.rows() * SAMPLES);
        let by_first = by_first.slice(units * width * S::F32_LANES);
        let by_second = by_second.slice(shape.rows() * hidden * S::F32_LANES);
        by_first.fill(0.0);
        by_second.fill(0.0);
        gradient.fill(0.0);
        for (block, inputs) in inputs.blocks(SAMPLES, width).enumerate() {
            let samples = inputs.numbers.len() / width;
            load(inputs.numbers, width, x);
            hidden_layer(simd, shape, parameters, 0, inputs.cells, x, h);
            for (row, y) in y.chunks_exact_mut(SAMPLES).enumerate() {
                let units = shape.half(row);
                let at = shape.second_at(row, units.start);
                let bias = parameters[shape.bias_at() + row];
                let h = &h[units.start * SAMPLES..units.end * SAMPLES];
                output(simd, &parameters[at..at + hidden], bias, h, y);
            }
            loss(Outputs { start: block * SAMPLES, samples, y: &mut y[..], stride: SAMPLES });
            for (row, y) in y.chunks_exact_mut(SAMPLES).enumerate() {
                y[samples..].fill(0.0);
                gradient[shape.bias_at() + row] += y.iter().sum::<f32>();
            }
            backward(simd, shape, parameters, [x, y], h, by_first, by_second);
            // The gradient by the column of W that a cell selects is that by z.
            for (sample, &cell) in inputs.cells.iter().enumerate() {
                let column = &mut gradient[shape.first_at(0, cell as usize)..][..units];
                for (sum, by_z) in column.iter_mut().zip(h.chunks_exact(SAMPLES)) {
                    *sum += by_z[sample];
                }
            }
        }
        let (by_first, by_second) = (S::as_simd_f32s(by_first).0, S::as_simd_f32s(by_second).0);
        for unit in 0..units {
            for input in 0..width {
                gradient[shape.first_at(unit, shape.columns.cells + input)] =
                    simd.reduce_sum_f32s(by_first[unit * width + input]);
            }
        }
        for row in 0..shape.rows() {
            for (at, unit) in shape.half(row).enumerate() {
                gradient[shape.second_at(row, unit)] =
                    simd.reduce_sum_f32s(by_second[row * hidden + at]);
            }
        }
    }
}

/// Adds a block's gradient by V and by the columns of W for x, given x, dL/dy and h, and turns h into
/// dL/dz, z = W x.
#[inline(always)]
fn backward<S: Simd>(
    simd: S,
    shape: Shape,
    parameters: &[f32],
    [x, y]: [&[f32]; 2],
    h: &mut [f32],
    by_first: &mut [f32],
    by_second: &mut [f32],
) {
    let (x, y) = (S::as_simd_f32s(x).0, S::as_simd_f32s(y).0);
    let h = S::as_mut_simd_f32s(h).0;
    let (by_first, by_second) = (S::as_mut_simd_f32s(by_first).0, S::as_mut_simd_f32s(by_second).0);
    let vectors = SAMPLES / S::F32_LANES;
    let (k, hidden, width) = (shape.outputs, shape.hidden, shape.width());
    for (unit, h) in h.chunks_exact_mut(vectors).enumerate() {
        let (rows, at) = if unit < hidden { (0..k, unit) } else { (k..k + 1, unit - hidden) };
        for (vector, entry) in h.iter_mut().enumerate() {
            let h = *entry;
            let mut by_h = simd.splat_f32s(0.0);
            for row in rows.clone() {
                let y = y[row * vectors + vector];
                let weight = simd.splat_f32s(parameters[shape.second_at(row, unit)]);
                by_h = simd.mul_add_e_f32s(weight, y, by_h);
                let sum = &mut by_second[row * hidden + at];
                *sum = simd.mul_add_e_f32s(y, h, *sum);
            }
            // d tanh = 1 - tanh^2.
            let slope = simd.sub_f32s(simd.splat_f32s(1.0), simd.mul_f32s(h, h));
            let by_z = simd.mul_f32s(by_h, slope);
            *entry = by_z;
            for (input, sum) in by_first[unit * width..][..width].iter_mut().enumerate() {
                *sum = simd.mul_add_e_f32s(by_z, x[input * vectors + vector], *sum);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tanh_is_tanh() {
        for step in -40_000..=40_000 {
            let z = step as f32 * 5e-4;
            let ours = tanh(pulp::Scalar::new(), z);
            assert!((f64::from(ours) - f64::from(z).tanh()).abs() < 1e-6, "tanh({z}) = {ours}");
        }
    }
}
