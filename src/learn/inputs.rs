//! What a batch of samples shows to a network.

use pulp::bytemuck;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// Sizes of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Columns {
    /// Number of cells of which each sample is in one: the width of its one-hot code. 0 where there are
    /// none.
    pub cells: usize,
    /// Numbers of a sample, without the constant 1.
    pub numbers: usize,
    /// How many of them, the last ones, only the critic sees.
    pub critic_only: usize,
}

/// A batch of n samples. A cell stands for its one-hot code, whose product with a matrix is one of the
/// matrix's columns.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Inputs {
    /// The cell of each sample, shape `[n]`; empty where there are none.
    pub cells: Vec<u32>,
    /// The numbers of each sample and the constant 1 of the biases, shape `[n, numbers + 1]`.
    pub numbers: Vec<f32>,
}

/// Consecutive samples of a batch.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// See [`Inputs::cells`].
    pub cells: &'a [u32],
    /// See [`Inputs::numbers`].
    pub numbers: &'a [f32],
}

impl Inputs {
    /// Removes all samples.
    pub fn clear(&mut self) {
        self.cells.clear();
        self.numbers.clear();
    }

    /// Appends samples.
    pub fn extend(&mut self, rows: Rows<'_>) {
        self.cells.extend_from_slice(rows.cells);
        self.numbers.extend_from_slice(rows.numbers);
    }

    /// All samples.
    pub fn rows(&self) -> Rows<'_> {
        Rows { cells: &self.cells, numbers: &self.numbers }
    }
}

/// Some samples of a batch, in any order and any number of times.
#[derive(Debug, Clone, Copy)]
pub struct Selection<'a> {
    /// The batch.
    pub all: Rows<'a>,
    /// Indices of the samples.
    pub indices: &'a [usize],
}

/// The different samples of a batch: a player that sees no more than its cell sees the same few again and again.
#[derive(Debug, Default)]
pub struct Distinct {
    /// Each of them once.
    pub inputs: Inputs,
    /// Which of them each sample of the batch is.
    pub of: Vec<usize>,
}

impl Distinct {
    /// The different samples of a batch, unless there are more than `most`; `width` is the length of a sample's
    /// numbers.
    pub fn within(batch: Rows<'_>, width: usize, most: usize) -> Option<Distinct> {
        let mut distinct = Distinct::default();
        let mut places = HashMap::new();
        for sample in batch.blocks(1, width) {
            let bits: &[u32] = bytemuck::cast_slice(sample.numbers);
            let next = places.len();
            let place = *places.entry((sample.cells, bits)).or_insert(next);
            if place == most {
                return None;
            }
            if place == next {
                distinct.inputs.extend(sample);
            }
            distinct.of.push(place);
        }
        Some(distinct)
    }
}

impl<'a> Rows<'a> {
    /// The samples before an index and those from it on; `width` is the length of a sample's numbers.
    pub fn split_at(self, sample: usize, width: usize) -> [Rows<'a>; 2] {
        let (before, after) = self.cells.split_at(sample.min(self.cells.len()));
        let (first, last) = self.numbers.split_at(sample * width);
        [Rows { cells: before, numbers: first }, Rows { cells: after, numbers: last }]
    }

    /// One sample.
    #[cfg(feature = "torch")]
    pub fn row(self, sample: usize, width: usize) -> Rows<'a> {
        let cells = if self.cells.is_empty() { &[] } else { &self.cells[sample..=sample] };
        Rows { cells, numbers: &self.numbers[sample * width..][..width] }
    }

    /// Blocks of samples, of which the last may have fewer.
    pub fn blocks(self, samples: usize, width: usize) -> impl Iterator<Item = Rows<'a>> {
        self.numbers.chunks(samples * width).enumerate().map(move |(block, numbers)| {
            let (start, end) = (block * samples, (block + 1) * samples);
            let last = self.cells.len();
            Rows { cells: &self.cells[start.min(last)..end.min(last)], numbers }
        })
    }
}
