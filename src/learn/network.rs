//! Actor and critic of a player: one hidden layer of tanh units each, gradients written out.
//!
//! Both networks share one pass. A batch is a matrix with a column per sample. With the input x (the
//! one-hot code of a cell if there is one, numbers, and a constant 1, so that biases are weights) of shape
//! `[inputs + 1, n]` and H hidden units each,
//!
//! ```text
//! h = tanh(W x)    [2H, n]       W: [2H, inputs + 1], the actor's half above the critic's
//! y = V h + b      [k + 1, n]    V: [k + 1, 2H], block diagonal: k actor outputs, one value
//! ```
//!
//! and from dL/dy, which the loss provides,
//!
//! ```text
//! dL/dV = dL/dy h' (its diagonal blocks),   dL/dh = V' dL/dy,   dL/dW = (dL/dh * (1 - h^2)) x'.
//! ```
//!
//! All parameters are in one flat vector `[W' | V | b | c]`, where c are the constants of the
//! actor's head, which do not depend on the observation (the log standard deviations of a Gaussian policy).
//!
//! What only the critic sees has weights 0 in the actor's half of W, and stays so: their gradient is left out.
//!
//! The passes are computed by `fused` on the processor and by `tensors`, which is libtorch, on
//! other devices; a test checks that the two agree with each other and with libtorch's own derivatives.

mod fused;
#[cfg(feature = "torch")]
mod tensors;

use super::device::Device;
use super::inputs::{Columns, Rows, Selection};
use fused::Fused;
use nalgebra::DMatrix;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
#[cfg(feature = "torch")]
use tensors::Tensors;

/// Sizes of a player's networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// What a sample consists of.
    pub columns: Columns,
    /// Hidden units H, of actor and of critic each.
    pub hidden: usize,
    /// Outputs k of the actor.
    pub outputs: usize,
    /// Constants of the actor's head.
    pub constants: usize,
}

impl Shape {
    /// Length of x without the constant 1: the cell's one-hot code, then the numbers.
    pub fn inputs(&self) -> usize {
        self.columns.cells + self.columns.numbers
    }

    /// Of them, those that the actor does not see.
    pub fn critic_only(&self) -> std::ops::Range<usize> {
        self.inputs() - self.columns.critic_only..self.inputs()
    }

    /// Length of a sample's numbers with the constant 1.
    pub fn width(&self) -> usize {
        self.columns.numbers + 1
    }

    /// Rows of y: the actor's outputs and the value.
    pub fn rows(&self) -> usize {
        self.outputs + 1
    }

    fn first(&self) -> usize {
        2 * self.hidden * (self.inputs() + 1)
    }

    fn second(&self) -> usize {
        self.rows() * 2 * self.hidden
    }

    /// Where b starts.
    pub fn bias_at(&self) -> usize {
        self.first() + self.second()
    }

    /// Where c starts.
    pub fn constants_at(&self) -> usize {
        self.bias_at() + self.rows()
    }

    /// Index of W's entry for a hidden unit (the critic's after the actor's) and an input.
    pub fn first_at(&self, unit: usize, input: usize) -> usize {
        input * 2 * self.hidden + unit
    }

    /// Index of V's entry for a row of y and a hidden unit.
    pub fn second_at(&self, row: usize, unit: usize) -> usize {
        self.first() + row * 2 * self.hidden + unit
    }

    /// The hidden units that a row of y is made of: the actor's, or the critic's for the last row.
    fn half(&self, row: usize) -> std::ops::Range<usize> {
        if row < self.outputs { 0..self.hidden } else { self.hidden..2 * self.hidden }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.constants_at() + self.constants
    }
}

/// Actor and critic of one player.
#[derive(Debug)]
pub struct Network {
    shape: Shape,
    parameters: Vec<f32>,
    engine: Engine,
}

/// What computes the passes.
#[derive(Debug)]
enum Engine {
    Processor(Fused),
    #[cfg(feature = "torch")]
    Torch(Tensors),
}

/// Samples of a minibatch with their outputs, for which the loss is to be computed.
#[derive(Debug)]
pub struct Outputs<'a> {
    /// Index of the first of them in the minibatch.
    pub start: usize,
    /// Number of them.
    pub samples: usize,
    /// Outputs y, to be turned into dL/dy: `y[row * stride + sample]`.
    pub y: &'a mut [f32],
    /// Numbers between two rows, at least `samples`.
    pub stride: usize,
}

impl Network {
    /// A network with fresh weights: orthogonal, with gain sqrt(2) for the hidden layer, 0.01 for
    /// the actor's outputs and 1 for the value; biases zero (the initialisation of CleanRL).
    pub fn new(shape: Shape, constants: &[f32], device: Device, random: &mut impl Rng) -> Self {
        assert_eq!(constants.len(), shape.constants, "constants of the head");
        let hidden = shape.hidden;
        let mut parameters = vec![0.0; shape.parameters()];
        for half in [0, hidden] {
            let weights = orthogonal(hidden, shape.inputs(), 2f64.sqrt(), random);
            for unit in 0..hidden {
                for input in 0..shape.inputs() {
                    parameters[shape.first_at(half + unit, input)] = weights[(unit, input)] as f32;
                }
            }
        }
        unseen_by_actor(shape, &mut parameters);
        let actor = orthogonal(shape.outputs, hidden, 0.01, random);
        let critic = orthogonal(1, hidden, 1.0, random);
        for unit in 0..hidden {
            for output in 0..shape.outputs {
                parameters[shape.second_at(output, unit)] = actor[(output, unit)] as f32;
            }
            parameters[shape.second_at(shape.outputs, hidden + unit)] = critic[(0, unit)] as f32;
        }
        parameters[shape.constants_at()..].copy_from_slice(constants);
        Self::from_parameters(shape, parameters, device)
    }

    /// A network with these parameters.
    pub fn from_parameters(shape: Shape, parameters: Vec<f32>, device: Device) -> Self {
        let engine = match device {
            Device::Cpu => Engine::Processor(Fused::default()),
            #[cfg(feature = "torch")]
            device => Engine::Torch(Tensors::new(shape, &parameters, device.into())),
            #[cfg(not(feature = "torch"))]
            Device::Cuda(_) => unreachable!("`Device::require` refuses it"),
        };
        Self::with_engine(shape, parameters, engine)
    }

    /// A network with these parameters that libtorch computes, on the processor as well.
    #[cfg(feature = "torch")]
    pub fn by_libtorch(shape: Shape, parameters: Vec<f32>, device: Device) -> Self {
        let engine = Engine::Torch(Tensors::new(shape, &parameters, device.into()));
        Self::with_engine(shape, parameters, engine)
    }

    fn with_engine(shape: Shape, parameters: Vec<f32>, engine: Engine) -> Self {
        assert_eq!(parameters.len(), shape.parameters(), "parameters of the network");
        Network { shape, parameters, engine }
    }

    /// Sizes of the network.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// All parameters, shape `[Shape::parameters]`.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    /// Changes the parameters.
    pub fn change(&mut self, change: impl FnOnce(&mut [f32])) {
        change(&mut self.parameters);
        #[cfg(feature = "torch")]
        if let Engine::Torch(tensors) = &mut self.engine {
            tensors.upload(&self.parameters);
        }
    }

    /// Constants c of the actor's head.
    pub fn constants(&self) -> &[f32] {
        &self.parameters[self.shape.constants_at()..]
    }

    /// The first quantity of the network that is not a finite number, or would not be in an evaluation.
    pub fn not_finite(&self) -> Option<&'static str> {
        // Inputs are about 1 and tanh units at most 1: with these weights no f32 can overflow.
        const LARGEST: f32 = 1e15;
        if !self.parameters.iter().all(|parameter| parameter.is_finite()) {
            Some("a weight")
        } else if !self.parameters.iter().all(|parameter| parameter.abs() <= LARGEST) {
            Some("a network's output")
        } else if !self.constants().iter().all(|&log| f64::from(log).exp().is_finite()) {
            Some("a standard deviation")
        } else {
            None
        }
    }

    /// Outputs of the actor only, shape `[k, n]`, for n samples.
    pub fn act(&self, inputs: Rows<'_>, outputs: &mut Vec<f32>) {
        self.evaluate(inputs, false, outputs);
    }

    /// Values of the critic only, shape `[n]`, for inputs as in [`Network::act`].
    pub fn values(&self, inputs: Rows<'_>, values: &mut Vec<f32>) {
        self.evaluate(inputs, true, values);
    }

    fn evaluate(&self, inputs: Rows<'_>, critic: bool, outputs: &mut Vec<f32>) {
        let (shape, parameters) = (self.shape, &self.parameters);
        match &self.engine {
            Engine::Processor(_) => {
                fused::Evaluate { shape, parameters, inputs, critic, outputs }.run();
            }
            #[cfg(feature = "torch")]
            Engine::Torch(tensors) => {
                tensors.evaluate(inputs, critic, outputs);
                let bias = shape.bias_at() + if critic { shape.outputs } else { 0 };
                let rows = if critic { 1 } else { shape.outputs };
                add_bias(outputs, &parameters[bias..bias + rows]);
            }
        }
    }

    /// Outputs and gradient in one: evaluates y on a minibatch of inputs as in [`Network::act`], lets
    /// `loss` turn it into dL/dy block by block, and writes dL/d parameters, except for those of the
    /// constants c and of what the actor does not see, which are zero.
    pub fn differentiate(
        &mut self,
        inputs: Selection<'_>,
        gradient: &mut Vec<f32>,
        loss: impl FnMut(Outputs<'_>),
    ) {
        let (shape, parameters) = (self.shape, &self.parameters[..]);
        gradient.resize(shape.parameters(), 0.0);
        match &mut self.engine {
            Engine::Processor(buffers) => {
                fused::Differentiate { shape, parameters, inputs, gradient, loss, buffers }.run();
            }
            #[cfg(feature = "torch")]
            Engine::Torch(tensors) => tensors.differentiate(parameters, inputs, gradient, loss),
        }
        unseen_by_actor(shape, gradient);
    }
}

/// Sets the entries of W to 0 that would show the actor what only the critic sees.
fn unseen_by_actor(shape: Shape, parameters: &mut [f32]) {
    for input in shape.critic_only() {
        let at = shape.first_at(0, input);
        parameters[at..at + shape.hidden].fill(0.0);
    }
}

#[cfg(feature = "torch")]
fn add_bias(outputs: &mut [f32], bias: &[f32]) {
    let samples = outputs.len() / bias.len();
    for (row, bias) in outputs.chunks_exact_mut(samples).zip(bias) {
        row.iter_mut().for_each(|value| *value += bias);
    }
}

/// A `rows x columns` matrix with orthonormal rows or columns, whichever are fewer, times `gain`.
fn orthogonal(rows: usize, columns: usize, gain: f64, random: &mut impl Rng) -> DMatrix<f64> {
    let (long, short) = (rows.max(columns), rows.min(columns));
    let normal = DMatrix::from_fn(long, short, |_, _| random.sample::<f64, _>(StandardNormal));
    let qr = normal.qr();
    let mut q = qr.q();
    // With the signs of R's diagonal the law is uniform over orthonormal frames.
    for (mut column, sign) in q.column_iter_mut().zip(qr.r().diagonal().iter()) {
        column *= gain * sign.signum();
    }
    if rows < columns { q.transpose() } else { q }
}
