//! The network of [`super`]: quantiles of what is left of the return, by the level that it is asked for.
//!
//! ```text
//! psi(x)   = relu(W_x x + b_x)                                   [n, H]
//! phi(tau) = relu(W_tau [cos(pi i tau)]_{i < cosines} + b_tau)   [n, k, H]
//! Z_tau(x) = W_o relu(W_h (psi(x) * phi(tau)) + b_h) + b_o       [n, k, actions]
//! ```

use crate::learn::device::Device;
use crate::learn::inputs::{Columns, Rows};
use crate::learn::weights::{Weights, WeightsError};
use rand::{Rng, RngExt};
use std::f64::consts::PI;
use tch::{Kind, Reduction, Tensor};

/// Sizes of the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// What a sample consists of.
    pub columns: Columns,
    /// Whether a threshold comes with it.
    pub threshold: bool,
    /// Hidden units H.
    pub hidden: usize,
    /// Cosines of the embedding of a level.
    pub cosines: usize,
    /// Number of actions.
    pub actions: usize,
}

impl Shape {
    /// Length of x: the cell's one-hot code, the numbers, the constant 1 of every row, the threshold.
    fn inputs(&self) -> usize {
        self.columns.cells + self.columns.numbers + 1 + usize::from(self.threshold)
    }

    /// The tensors in the order in which the parameters are, each `W`, then `b`, as PyTorch's `Linear` has them.
    fn layout(&self) -> [(&'static str, Vec<usize>); 8] {
        let (hidden, actions) = (self.hidden, self.actions);
        [
            ("observation.weight", vec![hidden, self.inputs()]),
            ("observation.bias", vec![hidden]),
            ("level.weight", vec![hidden, self.cosines]),
            ("level.bias", vec![hidden]),
            ("hidden.weight", vec![hidden, hidden]),
            ("hidden.bias", vec![hidden]),
            ("output.weight", vec![actions, hidden]),
            ("output.bias", vec![actions]),
        ]
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.layout().iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
    }
}

/// The network.
#[derive(Debug)]
pub struct Quantiles {
    shape: Shape,
    device: tch::Device,
    parameters: Vec<f32>,
    /// The same on the device, a leaf of autograd.
    flat: Tensor,
}

impl Quantiles {
    /// A network with fresh weights, uniform within 1 / sqrt(inputs of the layer), as PyTorch begins.
    pub fn new(shape: Shape, device: Device, random: &mut impl Rng) -> Self {
        let mut parameters = Vec::with_capacity(shape.parameters());
        let mut bound = 0.0;
        for (name, of) in shape.layout() {
            if name.ends_with("weight") {
                bound = 1.0 / (of[1] as f32).sqrt();
            }
            let count = of.iter().product();
            parameters.extend((0..count).map(|_| random.random_range(-bound..=bound)));
        }
        Self::from_parameters(shape, device, parameters)
    }

    /// A network with these parameters.
    pub fn from_parameters(shape: Shape, device: Device, parameters: Vec<f32>) -> Self {
        assert_eq!(parameters.len(), shape.parameters(), "parameters of the network");
        let device = device.into();
        let flat = Tensor::from_slice(&parameters).to_device(device).set_requires_grad(true);
        Quantiles { shape, device, parameters, flat }
    }

    /// The network of a player in a file.
    ///
    /// # Errors
    /// If a tensor is absent, of another shape, or not finite.
    pub fn read(
        shape: Shape,
        device: Device,
        player: &'static str,
        file: &Weights<'_>,
    ) -> Result<Self, WeightsError> {
        let mut parameters = Vec::new();
        for (name, of) in shape.layout() {
            parameters.extend(file.numbers(&format!("{player}.{name}"), &of)?);
        }
        if !parameters.iter().all(|parameter| parameter.is_finite()) {
            return Err(WeightsError::NotFinite { player, quantity: "a weight" });
        }
        Ok(Self::from_parameters(shape, device, parameters))
    }

    /// The tensors of a file, by their names.
    pub fn tensors(&self, player: &str) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let mut rest = &self.parameters[..];
        let tensor = |(name, shape): (&str, Vec<usize>)| {
            let (own, others) = rest.split_at(shape.iter().product());
            rest = others;
            (format!("{player}.{name}"), shape, own.to_vec())
        };
        self.shape.layout().into_iter().map(tensor).collect()
    }

    /// Sizes of the network.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Changes the parameters.
    pub fn change(&mut self, change: impl FnOnce(&mut [f32])) {
        change(&mut self.parameters);
        let new = Tensor::from_slice(&self.parameters).to_device(self.device);
        tch::no_grad(|| self.flat.copy_(&new));
    }

    /// x of samples, and of their thresholds where the network sees one, shape `[n, inputs]`.
    pub fn inputs(&self, rows: Rows<'_>, thresholds: &[f32]) -> Tensor {
        let width = self.shape.columns.numbers as i64 + 1;
        let numbers = Tensor::from_slice(rows.numbers).view([-1, width]).to_device(self.device);
        let mut parts = Vec::with_capacity(3);
        if !rows.cells.is_empty() {
            let cells: Vec<i64> = rows.cells.iter().map(|&cell| i64::from(cell)).collect();
            let cells = Tensor::from_slice(&cells).to_device(self.device);
            parts.push(cells.one_hot(self.shape.columns.cells as i64).to_kind(Kind::Float));
        }
        parts.push(numbers);
        if self.shape.threshold {
            parts.push(self.tensor(thresholds, [-1, 1]));
        }
        Tensor::cat(&parts, 1)
    }

    /// Numbers on the network's device.
    pub fn tensor<const D: usize>(&self, numbers: &[f32], shape: [i64; D]) -> Tensor {
        Tensor::from_slice(numbers).view(&shape[..]).to_device(self.device)
    }

    /// `Z_tau(x, a)` of every action, shape `[n, k, actions]`, with x of shape `[n, inputs]` and levels of shape `[n, k]`,
    /// or `[1, k]` where all samples have the same.
    pub fn values(&self, x: &Tensor, levels: &Tensor) -> Tensor {
        let mut start = 0;
        let parts = self.shape.layout().map(|(_, shape)| {
            let shape: Vec<i64> = shape.iter().map(|&size| size as i64).collect();
            let length = shape.iter().product();
            let part = self.flat.narrow(0, start, length).view(&shape[..]);
            start += length;
            part
        });
        let linear =
            |x: &Tensor, layer: usize| x.linear(&parts[2 * layer], Some(&parts[2 * layer + 1]));
        let waves = Tensor::arange(self.shape.cosines as i64, (Kind::Float, self.device)) * PI;
        let seen = linear(x, 0).relu().unsqueeze(1);
        let level = linear(&(levels.unsqueeze(-1) * waves).cos(), 1).relu();
        linear(&linear(&(seen * level), 2).relu(), 3)
    }

    /// The gradient of a loss by the parameters, and the loss.
    pub fn differentiate(
        &mut self,
        loss: impl FnOnce(&Self) -> Tensor,
        gradient: &mut Vec<f32>,
    ) -> f64 {
        self.flat.zero_grad();
        let loss = loss(self);
        loss.backward();
        gradient.resize(self.parameters.len(), 0.0);
        self.flat.grad().copy_data(gradient, self.parameters.len());
        loss.double_value(&[])
    }
}

/// The quantile Huber loss, Eq. 3 of the paper: with `delta_ij = target_j - value_i`,
/// `sum_i mean_j |tau_i - 1{delta_ij < 0}| L_kappa(delta_ij) / kappa`, its mean over samples. Values and levels have shape
/// `[n, N]`, targets `[n, N']`.
pub fn quantile_huber(values: &Tensor, levels: &Tensor, targets: &Tensor, kappa: f64) -> Tensor {
    let (values, targets) = (values.unsqueeze(2), targets.unsqueeze(1));
    let delta = &targets - &values;
    let weight = (levels.unsqueeze(2) - delta.detach().less(0.0).to_kind(Kind::Float)).abs();
    let huber =
        values.expand_as(&delta).huber_loss(&targets.expand_as(&delta), Reduction::None, kappa);
    let sums = (weight * huber / kappa).mean_dim(2, false, Kind::Float).sum_dim_intlist(
        1,
        false,
        Kind::Float,
    );
    sums.mean(Kind::Float)
}

/// Levels of a mean over (0, 1), and their weights.
#[derive(Debug, Clone, PartialEq)]
pub struct Levels {
    /// The levels.
    pub at: Vec<f32>,
    /// Their weights, whose sum is 1.
    pub weights: Vec<f32>,
}

impl Levels {
    /// Midpoints of equal shares of (0, `upper`), of which all the mean is made.
    pub fn below(upper: f64, count: usize) -> Self {
        Self::between([0.0, upper], count, 1.0)
    }

    /// Midpoints of equal shares of the tail (0, `alpha`), a share `tail` of all of them, and of (`alpha`, 1).
    pub fn stratified(alpha: f64, count: usize, tail: f64) -> Self {
        let within = (count as f64 * tail).round() as usize;
        if within == 0 || within == count || alpha >= 1.0 {
            return Self::below(1.0, count);
        }
        let mut levels = Self::between([0.0, alpha], within, alpha);
        let rest = Self::between([alpha, 1.0], count - within, 1.0 - alpha);
        levels.at.extend(rest.at);
        levels.weights.extend(rest.weights);
        levels
    }

    fn between([low, high]: [f64; 2], count: usize, weight: f64) -> Self {
        let step = (high - low) / count as f64;
        let at = (0..count).map(|i| (low + step * (i as f64 + 0.5)) as f32).collect();
        Levels { at, weights: vec![(weight / count as f64) as f32; count] }
    }
}
