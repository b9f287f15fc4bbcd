//! The network's passes on the processor: `SAMPLES` samples at a time, from the inputs to the gradient,
//! within the nearest caches.
//!
//! With so few inputs and outputs, general matrix products spend most of their time on packing, and
//! every step of a whole minibatch through memory costs more than its arithmetic. A block holds its
//! numbers sample by sample in rows: row i of `x` is input i of all its samples. Two loops make all sums:
//! `combine` those over the terms of a linear map, `correlate` those over samples. What they load they use
//! several times, in a tile of sums that stays in registers.

use super::{Outputs, Shape};
use crate::game::columns::SAMPLES;
use crate::learn::inputs::{Rows, Selection};
use pulp::{Arch, Simd, WithSimd};
use std::hint::black_box;

/// Hidden units at a time where each sample has its own column of W: their rows of a block fit into the first cache.
const TOGETHER: usize = 128;

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
    of_sample: Aligned,
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

/// Loads the samples of a block, at most `SAMPLES`; the rest is zero.
fn load<'a>(samples: impl ExactSizeIterator<Item = &'a [f32]>, x: &mut [f32]) {
    if samples.len() < SAMPLES {
        x.fill(0.0);
    }
    for (sample, numbers) in samples.enumerate() {
        for (row, &number) in x.chunks_exact_mut(SAMPLES).zip(numbers) {
            row[sample] = number;
        }
    }
}

/// Brings samples from anywhere in a batch into the nearest cache. Read one right after the other their lines arrive
/// together; in [`load`] the processor would wait for each.
fn touch(indices: &[usize], numbers: &[f32], width: usize) {
    let ends = indices.iter().map(|&i| numbers[i * width] + numbers[(i + 1) * width - 1]);
    black_box(ends.sum::<f32>());
}

/// Vectors of a tile.
const VECTORS: usize = 4;

/// How many of the remaining rows the next tile has: 16 registers hold the sums of two rows and what they are made
/// of, 32 those of four.
#[inline(always)]
fn tile_rows<S: Simd>(remaining: usize) -> usize {
    remaining.min(if S::REGISTER_COUNT < 32 { 2 } else { 4 })
}

/// What a sum and the number in its place become.
#[derive(Clone, Copy)]
enum Finish {
    /// Their sum.
    Sum,
    /// tanh of the sum.
    Tanh,
    /// tanh of their sum.
    TanhOfBoth,
    /// The sum times the slope of tanh, given tanh: d tanh = 1 - tanh^2.
    TimesSlope,
}

impl Finish {
    #[inline(always)]
    fn of<S: Simd>(self, simd: S, sum: S::f32s, place: S::f32s) -> S::f32s {
        match self {
            Finish::Sum => simd.add_f32s(sum, place),
            Finish::Tanh => tanh(simd, sum),
            Finish::TanhOfBoth => tanh(simd, simd.add_f32s(sum, place)),
            Finish::TimesSlope => {
                let slope = simd.sub_f32s(simd.splat_f32s(1.0), simd.mul_f32s(place, place));
                simd.mul_f32s(sum, slope)
            }
        }
    }
}

/// Where a weight of a linear map is: `at + row * of_row + term * of_term`.
#[derive(Clone, Copy)]
struct Weights<'a> {
    all: &'a [f32],
    at: usize,
    of_row: usize,
    of_term: usize,
}

/// `out[row] = finish(out[row] + sum_term w[row, term] * terms[term])`, rows of a block each.
#[inline(always)]
fn combine<S: Simd>(
    simd: S,
    weights: Weights<'_>,
    terms: &[S::f32s],
    out: &mut [S::f32s],
    finish: Finish,
) {
    let vectors = SAMPLES / S::F32_LANES;
    let rows = out.len() / vectors;
    let mut row = 0;
    while row < rows {
        let tile = &mut out[row * vectors..];
        let weights = Weights { at: weights.at + row * weights.of_row, ..weights };
        row += match tile_rows::<S>(rows - row) {
            1 => combine_tile::<S, 1>(simd, weights, terms, tile, finish),
            2 => combine_tile::<S, 2>(simd, weights, terms, tile, finish),
            3 => combine_tile::<S, 3>(simd, weights, terms, tile, finish),
            _ => combine_tile::<S, 4>(simd, weights, terms, tile, finish),
        };
    }
}

#[inline(always)]
fn combine_tile<S: Simd, const R: usize>(
    simd: S,
    weights: Weights<'_>,
    terms: &[S::f32s],
    out: &mut [S::f32s],
    finish: Finish,
) -> usize {
    let vectors = SAMPLES / S::F32_LANES;
    let out = &mut out[..R * vectors];
    for vector in (0..vectors).step_by(VECTORS) {
        let mut sums = [[simd.splat_f32s(0.0); VECTORS]; R];
        for (term, of) in terms.chunks_exact(vectors).enumerate() {
            let of = &of[vector..][..VECTORS];
            for (row, sums) in sums.iter_mut().enumerate() {
                let at = weights.at + row * weights.of_row + term * weights.of_term;
                let weight = simd.splat_f32s(weights.all[at]);
                for (sum, &of) in sums.iter_mut().zip(of) {
                    *sum = simd.mul_add_e_f32s(weight, of, *sum);
                }
            }
        }
        for (sums, out) in sums.iter().zip(out.chunks_exact_mut(vectors)) {
            for (&sum, place) in sums.iter().zip(&mut out[vector..]) {
                *place = finish.of(simd, sum, *place);
            }
        }
    }
    R
}

/// `sums[i, j] += a[i] * b[j]`, summed over the samples of the block but for the lanes.
#[inline(always)]
fn correlate<S: Simd>(simd: S, a: &[S::f32s], b: &[S::f32s], sums: &mut [S::f32s]) {
    let vectors = SAMPLES / S::F32_LANES;
    let columns = b.len() / vectors;
    let rows = a.len() / vectors;
    let mut row = 0;
    while row < rows {
        let a = &a[row * vectors..];
        let sums = &mut sums[row * columns..];
        row += match tile_rows::<S>(rows - row) {
            1 => correlate_rows::<S, 1>(simd, a, b, sums),
            2 => correlate_rows::<S, 2>(simd, a, b, sums),
            3 => correlate_rows::<S, 3>(simd, a, b, sums),
            _ => correlate_rows::<S, 4>(simd, a, b, sums),
        };
    }
}

#[inline(always)]
fn correlate_rows<S: Simd, const R: usize>(
    simd: S,
    a: &[S::f32s],
    b: &[S::f32s],
    sums: &mut [S::f32s],
) -> usize {
    let vectors = SAMPLES / S::F32_LANES;
    let columns = b.len() / vectors;
    let mut column = 0;
    while column < columns {
        let (b, sums) = (&b[column * vectors..], &mut sums[column..]);
        column += match columns - column {
            1 => correlate_tile::<S, R, 1>(simd, a, b, sums, columns),
            2 => correlate_tile::<S, R, 2>(simd, a, b, sums, columns),
            3 => correlate_tile::<S, R, 3>(simd, a, b, sums, columns),
            _ => correlate_tile::<S, R, 4>(simd, a, b, sums, columns),
        };
    }
    R
}

#[inline(always)]
fn correlate_tile<S: Simd, const R: usize, const C: usize>(
    simd: S,
    a: &[S::f32s],
    b: &[S::f32s],
    sums: &mut [S::f32s],
    stride: usize,
) -> usize {
    let vectors = SAMPLES / S::F32_LANES;
    let (a, b) = (&a[..R * vectors], &b[..C * vectors]);
    let sums = &mut sums[..(R - 1) * stride + C];
    let mut own = [[simd.splat_f32s(0.0); C]; R];
    for row in 0..R {
        for column in 0..C {
            own[row][column] = sums[row * stride + column];
        }
    }
    for v in 0..vectors {
        for row in 0..R {
            for column in 0..C {
                own[row][column] = simd.mul_add_e_f32s(
                    a[row * vectors + v],
                    b[column * vectors + v],
                    own[row][column],
                );
            }
        }
    }
    for row in 0..R {
        for column in 0..C {
            sums[row * stride + column] = own[row][column];
        }
    }
    C
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
    let (columns, numbers) = parameters.split_at(shape.columns.cells * units);
    let weights = Weights { all: numbers, at: first, of_row: 1, of_term: units };
    let x = S::as_simd_f32s(x).0;
    if shape.columns.cells == 0 {
        combine(simd, weights, x, S::as_mut_simd_f32s(h).0, Finish::Tanh);
    } else {
        // What a cell adds to z is its column of W.
        for (some, z) in h.chunks_mut(TOGETHER * SAMPLES).enumerate() {
            for (sample, &cell) in cells.iter().enumerate() {
                let column = &columns[cell as usize * units + first + some * TOGETHER..];
                for (z, &weight) in z.chunks_exact_mut(SAMPLES).zip(column) {
                    z[sample] = weight;
                }
            }
        }
        let h = S::as_mut_simd_f32s(h).0;
        combine(simd, weights, x, h, Finish::TanhOfBoth);
    }
}

/// Rows of V h + b, of the actor or of the critic.
#[inline(always)]
fn output_rows<S: Simd>(
    simd: S,
    shape: Shape,
    parameters: &[f32],
    rows: std::ops::Range<usize>,
    h: &[f32],
    y: &mut [f32],
) {
    let first = shape.half(rows.start).start;
    for (y, bias) in y.chunks_exact_mut(SAMPLES).zip(&parameters[shape.bias_at() + rows.start..]) {
        y.fill(*bias);
    }
    let at = shape.second_at(rows.start, first);
    let weights = Weights { all: parameters, at, of_row: 2 * shape.hidden, of_term: 1 };
    let (h, y) = (S::as_simd_f32s(h).0, S::as_mut_simd_f32s(y).0);
    combine(simd, weights, h, y, Finish::Sum);
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
        let mut y = Aligned::default();
        let y = y.slice(rows.len() * SAMPLES);
        for (block, inputs) in inputs.blocks(SAMPLES, width).enumerate() {
            load(inputs.numbers.chunks_exact(width), x);
            hidden_layer(simd, shape, parameters, first, inputs.cells, x, h);
            let start = block * SAMPLES;
            let end = samples.min(start + SAMPLES);
            output_rows(simd, shape, parameters, rows.clone(), h, y);
            for (row, y) in outputs.chunks_exact_mut(samples).zip(y.chunks_exact(SAMPLES)) {
                row[start..end].copy_from_slice(&y[..end - start]);
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
    pub inputs: Selection<'a>,
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
        let Selection { all, indices } = inputs;
        let samples = all.numbers.len() / width;
        // Where samples repeat, one pass over the batch serves them all.
        let repeated = 2 * samples <= indices.len();
        let blocks = if repeated { samples.div_ceil(SAMPLES) } else { 1 };
        let Fused { x, h, y, of_sample, by_first, by_second } = buffers;
        let x = x.slice(blocks * width * SAMPLES);
        let h = h.slice(blocks * units * SAMPLES);
        let y = y.slice(blocks * shape.rows() * SAMPLES);
        let by_first = by_first.slice(units * width * S::F32_LANES);
        let by_second = by_second.slice(shape.rows() * hidden * S::F32_LANES);
        by_first.fill(0.0);
        by_second.fill(0.0);
        gradient.fill(0.0);
        let mut pass = Pass { simd, shape, parameters, gradient, by_first, by_second };
        if repeated {
            let x = x.chunks_exact_mut(width * SAMPLES);
            let h = h.chunks_exact_mut(units * SAMPLES);
            let mut y: Vec<_> = y.chunks_exact_mut(shape.rows() * SAMPLES).collect();
            let mut blocks: Vec<_> = x.zip(h).zip(all.blocks(SAMPLES, width)).collect();
            for (((x, h), inputs), y) in blocks.iter_mut().zip(&mut y) {
                load(inputs.numbers.chunks_exact(width), x);
                pass.forward(inputs.cells, x, h, y);
            }
            let of_sample = of_sample.slice(shape.rows() * SAMPLES);
            loss_of_repeated(indices, &mut y, of_sample, &mut loss);
            for (((x, h), inputs), y) in blocks.iter_mut().zip(&y) {
                pass.backward(inputs.cells, x, h, y);
            }
        } else {
            let mut cells = Vec::new();
            for (block, indices) in indices.chunks(SAMPLES).enumerate() {
                let samples = indices.len();
                touch(indices, all.numbers, width);
                load(indices.iter().map(|&i| &all.numbers[i * width..][..width]), x);
                if shape.columns.cells > 0 {
                    cells.clear();
                    cells.extend(indices.iter().map(|&i| all.cells[i]));
                }
                pass.forward(&cells, x, h, y);
                loss(Outputs { start: block * SAMPLES, samples, y: &mut y[..], stride: SAMPLES });
                for y in y.chunks_exact_mut(SAMPLES) {
                    y[samples..].fill(0.0);
                }
                pass.backward(&cells, x, h, y);
            }
        }
        let Pass { by_first, by_second, gradient, .. } = pass;
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

/// The loss of samples that repeat, by the outputs of the batch: `y` has the rows of `SAMPLES` of its samples each, and
/// becomes the gradient by them.
fn loss_of_repeated(
    indices: &[usize],
    y: &mut [&mut [f32]],
    of_sample: &mut [f32],
    loss: &mut impl FnMut(Outputs<'_>),
) {
    let mut by_y: Vec<Vec<f32>> = y.iter().map(|y| vec![0.0; y.len()]).collect();
    for (block, indices) in indices.chunks(SAMPLES).enumerate() {
        for (sample, &index) in indices.iter().enumerate() {
            let rows = y[index / SAMPLES].chunks_exact(SAMPLES);
            for (of, row) in of_sample.chunks_exact_mut(SAMPLES).zip(rows) {
                of[sample] = row[index % SAMPLES];
            }
        }
        let (start, samples) = (block * SAMPLES, indices.len());
        loss(Outputs { start, samples, y: of_sample, stride: SAMPLES });
        for (sample, &index) in indices.iter().enumerate() {
            let rows = by_y[index / SAMPLES].chunks_exact_mut(SAMPLES);
            for (of, row) in of_sample.chunks_exact(SAMPLES).zip(rows) {
                row[index % SAMPLES] += of[sample];
            }
        }
    }
    for (y, by_y) in y.iter_mut().zip(by_y) {
        y.copy_from_slice(&by_y);
    }
}

/// The passes of a block and what its gradients are added to.
struct Pass<'a, S> {
    simd: S,
    shape: Shape,
    parameters: &'a [f32],
    gradient: &'a mut [f32],
    by_first: &'a mut [f32],
    by_second: &'a mut [f32],
}

impl<S: Simd> Pass<'_, S> {
    /// h and y of a block, given x.
    #[inline(always)]
    fn forward(&self, cells: &[u32], x: &[f32], h: &mut [f32], y: &mut [f32]) {
        let Pass { simd, shape, parameters, .. } = *self;
        hidden_layer(simd, shape, parameters, 0, cells, x, h);
        let (actor, critic) = h.split_at(shape.hidden * SAMPLES);
        let (action, value) = y.split_at_mut(shape.outputs * SAMPLES);
        output_rows(simd, shape, parameters, 0..shape.outputs, actor, action);
        output_rows(simd, shape, parameters, shape.outputs..shape.rows(), critic, value);
    }

    /// Adds a block's gradient by W, V and b, given x, dL/dy and h, and turns h into dL/dz, z = W x.
    #[inline(always)]
    fn backward(&mut self, cells: &[u32], x: &[f32], h: &mut [f32], y: &[f32]) {
        let Pass { simd, shape, parameters, .. } = *self;
        let units = 2 * shape.hidden;
        for (row, y) in y.chunks_exact(SAMPLES).enumerate() {
            self.gradient[shape.bias_at() + row] += y.iter().sum::<f32>();
        }
        {
            let (x, y) = (S::as_simd_f32s(x).0, S::as_simd_f32s(y).0);
            let h = S::as_mut_simd_f32s(h).0;
            let by_first = S::as_mut_simd_f32s(self.by_first).0;
            let by_second = S::as_mut_simd_f32s(self.by_second).0;
            let vectors = SAMPLES / S::F32_LANES;
            let (k, hidden) = (shape.outputs, shape.hidden);
            let (actor, critic) = h.split_at_mut(hidden * vectors);
            let (by_action, by_value) = y.split_at(k * vectors);
            let (to_action, to_value) = by_second.split_at_mut(k * hidden);
            for (row, h, y, sums) in
                [(0, actor, by_action, to_action), (k, critic, by_value, to_value)]
            {
                correlate(simd, y, h, sums);
                let at = shape.second_at(row, shape.half(row).start);
                let weights = Weights { all: parameters, at, of_row: 1, of_term: units };
                combine(simd, weights, y, h, Finish::TimesSlope);
            }
            correlate(simd, h, x, by_first);
        }
        // The gradient by the column of W that a cell selects is that by z.
        for (some, by_z) in h.chunks(TOGETHER * SAMPLES).enumerate() {
            for (sample, &cell) in cells.iter().enumerate() {
                let column = &mut self.gradient[shape.first_at(some * TOGETHER, cell as usize)..];
                for (sum, by_z) in column.iter_mut().zip(by_z.chunks_exact(SAMPLES)) {
                    *sum += by_z[sample];
                }
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
