//! Actor and critic of a player: one hidden layer of tanh units each, gradients written out.
//!
//! Both networks share one pass. A batch is a matrix with a column per sample. With the input x (a
//! constant 1 appended, so that biases are weights) of shape `[inputs + 1, n]` and H hidden units
//! each,
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
//! All parameters live in one flat vector `[W' | V | b | c]`, where c are the constants of the
//! actor's head that no observation moves (the log standard deviations of a Gaussian policy).
//!
//! The passes are carried out by `fused` on the processor and by `tensors`, which is libtorch, on
//! other devices; a test holds the two, and libtorch's own derivatives, together.

mod fused;
mod tensors;

use fused::Fused;
use nalgebra::DMatrix;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use tch::Device;
use tensors::Tensors;

/// Sizes of a player's networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Length of the observation, without the constant 1.
    pub inputs: usize,
    /// Hidden units H, of actor and of critic each.
    pub hidden: usize,
    /// Outputs k of the actor.
    pub outputs: usize,
    /// Constants of the actor's head.
    pub constants: usize,
}

impl Shape {
    /// Numbers of one sample's input: the observation and the constant 1.
    pub fn width(&self) -> usize {
        self.inputs + 1
    }

    /// Rows of y: the actor's outputs and the value.
    pub fn rows(&self) -> usize {
        self.outputs + 1
    }

    fn first(&self) -> usize {
        2 * self.hidden * self.width()
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

    /// Index of W's entry for a hidden unit (the critic's behind the actor's) and an input.
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

/// Who carries the passes out.
#[derive(Debug)]
enum Engine {
    Processor(Fused),
    Device(Tensors),
}

/// Samples of a batch whose outputs are known and whose loss is asked for.
#[derive(Debug)]
pub struct Outputs<'a> {
    /// Index of the first of them in the batch.
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
            let weights = orthogonal(hidden, shape.inputs, 2f64.sqrt(), random);
            for unit in 0..hidden {
                for input in 0..shape.inputs {
                    parameters[shape.first_at(half + unit, input)] = weights[(unit, input)] as f32;
                }
            }
        }
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
            device => Engine::Device(Tensors::new(shape, &parameters, device)),
        };
        Self::with_engine(shape, parameters, engine)
    }

    /// A network with these parameters that libtorch carries out, on the processor as well.
    pub fn by_libtorch(shape: Shape, parameters: Vec<f32>, device: Device) -> Self {
        let engine = Engine::Device(Tensors::new(shape, &parameters, device));
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
        if let Engine::Device(tensors) = &mut self.engine {
            tensors.upload(&self.parameters);
        }
    }

    /// Constants c of the actor's head.
    pub fn constants(&self) -> &[f32] {
        &self.parameters[self.shape.constants_at()..]
    }

    /// Outputs of the actor alone, shape `[k, n]`; `inputs` holds n samples one after the other,
    /// shape `[n, inputs + 1]`.
    pub fn act(&self, inputs: &[f32], outputs: &mut Vec<f32>) {
        self.evaluate(inputs, false, outputs);
    }

    /// Values of the critic alone, shape `[n]`, for inputs as in [`Network::act`].
    pub fn values(&self, inputs: &[f32], values: &mut Vec<f32>) {
        self.evaluate(inputs, true, values);
    }

    fn evaluate(&self, inputs: &[f32], critic: bool, outputs: &mut Vec<f32>) {
        let (shape, parameters) = (self.shape, &self.parameters);
        match &self.engine {
            Engine::Processor(_) => {
                fused::Evaluate { shape, parameters, inputs, critic, outputs }.run();
            }
            Engine::Device(tensors) => {
                tensors.evaluate(inputs, critic, outputs);
                let bias = shape.bias_at() + if critic { shape.outputs } else { 0 };
                let rows = if critic { 1 } else { shape.outputs };
                add_bias(outputs, &parameters[bias..bias + rows]);
            }
        }
    }

    /// Outputs and gradient in one: evaluates y on a batch of inputs as in [`Network::act`], lets
    /// `loss` turn it into dL/dy block by block, and writes dL/d parameters, except for those of the
    /// constants c, which are left zero.
    pub fn differentiate(
        &mut self,
        inputs: &[f32],
        gradient: &mut Vec<f32>,
        loss: impl FnMut(Outputs<'_>),
    ) {
        let (shape, parameters) = (self.shape, &self.parameters[..]);
        gradient.resize(shape.parameters(), 0.0);
        match &mut self.engine {
            Engine::Processor(buffers) => {
                fused::Differentiate { shape, parameters, inputs, gradient, loss, buffers }.run();
            }
            Engine::Device(tensors) => tensors.differentiate(parameters, inputs, gradient, loss),
        }
    }
}

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
