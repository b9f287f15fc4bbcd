//! Actor and critic of a player: one hidden layer of tanh units each, gradients written out.
//!
//! Both networks share one pass. With the input x (a constant 1 appended, so that biases are
//! weights) of shape `[n, inputs + 1]` and H hidden units each,
//!
//! ```text
//! h = tanh(x W)    [n, 2H]       W: [inputs + 1, 2H], the actor's half and the critic's half
//! y = h V + b      [n, k + 1]    V: [2H, k + 1], block diagonal: k actor outputs, one value
//! ```
//!
//! and from dL/dy, which the loss provides,
//!
//! ```text
//! dL/dV = h' dL/dy (its diagonal blocks),   dL/dh = dL/dy V',   dL/dW = x' (dL/dh * (1 - h^2)).
//! ```
//!
//! All parameters live in one flat vector `[W | V | b | c]`, where c are the constants of the
//! actor's head that no observation moves (the log standard deviations of a Gaussian policy).

use nalgebra::DMatrix;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use tch::{Device, Kind, Tensor};

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
    /// Length of a row of inputs: the observation and the constant 1.
    pub fn row(&self) -> usize {
        self.inputs + 1
    }

    /// Length of a row of y: the actor's outputs and the value.
    pub fn columns(&self) -> usize {
        self.outputs + 1
    }

    fn first(&self) -> usize {
        self.row() * 2 * self.hidden
    }

    fn second(&self) -> usize {
        2 * self.hidden * self.columns()
    }

    fn bias(&self) -> usize {
        self.first() + self.second()
    }

    /// Where the constants start.
    fn constants_at(&self) -> usize {
        self.bias() + self.columns()
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.constants_at() + self.constants
    }

    /// Index of V's entry for a hidden unit and a column, and whether it lies in a diagonal block.
    fn second_at(&self, unit: usize, column: usize) -> (usize, bool) {
        let critic = column == self.outputs;
        (self.first() + unit * self.columns() + column, (unit >= self.hidden) == critic)
    }
}

/// Actor and critic of one player.
#[derive(Debug)]
pub struct Network {
    shape: Shape,
    /// The parameters as the optimiser sees them.
    parameters: Vec<f32>,
    /// The same on the device, with W and V as views of it.
    flat: Tensor,
    first: Tensor,
    second: Tensor,
    /// Gradient on the device, with views likewise.
    gradient: Tensor,
    first_gradient: Tensor,
    second_gradient: Tensor,
    buffers: Option<Buffers>,
    device: Device,
}

/// Tensors reused from batch to batch of one size.
#[derive(Debug)]
struct Buffers {
    rows: usize,
    hidden: Tensor,
    outputs: Tensor,
    hidden_gradient: Tensor,
}

impl Network {
    /// A network with fresh weights: orthogonal, with gain sqrt(2) for the hidden layer, 0.01 for
    /// the actor's outputs and 1 for the value; biases zero (the initialisation of CleanRL).
    pub fn new(shape: Shape, constants: &[f32], device: Device, random: &mut impl Rng) -> Self {
        assert_eq!(constants.len(), shape.constants, "constants of the head");
        let hidden = shape.hidden;
        let mut parameters = vec![0.0; shape.parameters()];
        for half in 0..2 {
            let weights = orthogonal(shape.inputs, hidden, 2f64.sqrt(), random);
            for input in 0..shape.inputs {
                for unit in 0..hidden {
                    parameters[input * 2 * hidden + half * hidden + unit] =
                        weights[(input, unit)] as f32;
                }
            }
        }
        let actor = orthogonal(hidden, shape.outputs, 0.01, random);
        let critic = orthogonal(hidden, 1, 1.0, random);
        for unit in 0..hidden {
            for output in 0..shape.outputs {
                parameters[shape.second_at(unit, output).0] = actor[(unit, output)] as f32;
            }
            parameters[shape.second_at(hidden + unit, shape.outputs).0] = critic[(unit, 0)] as f32;
        }
        parameters[shape.constants_at()..].copy_from_slice(constants);
        Self::from_parameters(shape, parameters, device)
    }

    /// A network with these parameters.
    pub fn from_parameters(shape: Shape, parameters: Vec<f32>, device: Device) -> Self {
        assert_eq!(parameters.len(), shape.parameters(), "parameters of the network");
        let flat = Tensor::zeros(shape.parameters() as i64, (Kind::Float, device));
        let gradient = flat.zeros_like();
        let view = |tensor: &Tensor| {
            let (row, wide) = (shape.row() as i64, 2 * shape.hidden as i64);
            let (first, second) = (shape.first() as i64, shape.second() as i64);
            (
                tensor.narrow(0, 0, first).view([row, wide]),
                tensor.narrow(0, first, second).view([wide, shape.columns() as i64]),
            )
        };
        let (first, second) = view(&flat);
        let (first_gradient, second_gradient) = view(&gradient);
        let mut network = Network {
            shape,
            parameters,
            flat,
            first,
            second,
            gradient,
            first_gradient,
            second_gradient,
            buffers: None,
            device,
        };
        network.upload();
        network
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
        self.upload();
    }

    fn upload(&mut self) {
        self.flat.copy_(&Tensor::from_slice(&self.parameters));
    }

    /// Constants c of the actor's head.
    pub fn constants(&self) -> &[f32] {
        &self.parameters[self.shape.constants_at()..]
    }

    /// Outputs of the actor alone. `inputs` has shape `[n, inputs + 1]`; writes `[n, k]`.
    pub fn act(&self, inputs: &[f32], outputs: &mut Vec<f32>) {
        let (hidden, k) = (self.shape.hidden as i64, self.shape.outputs as i64);
        let h = self.tensor(inputs).mm(&self.first.narrow(1, 0, hidden)).tanh_();
        let y = h.mm(&self.second.narrow(0, 0, hidden).narrow(1, 0, k));
        download(&y, outputs);
        let bias = self.shape.bias();
        add_bias(outputs, &self.parameters[bias..bias + k as usize]);
    }

    /// Values of the critic alone. `inputs` has shape `[n, inputs + 1]`; writes `[n]`.
    pub fn values(&self, inputs: &[f32], values: &mut Vec<f32>) {
        let (hidden, k) = (self.shape.hidden as i64, self.shape.outputs as i64);
        let h = self.tensor(inputs).mm(&self.first.narrow(1, hidden, hidden)).tanh_();
        download(&h.mm(&self.second.narrow(0, hidden, hidden).narrow(1, k, 1)), values);
        let bias = self.shape.bias() + self.shape.outputs;
        add_bias(values, &self.parameters[bias..=bias]);
    }

    /// Outputs and gradient in one: evaluates y on a batch, lets `loss` turn it (shape
    /// `[n, k + 1]`, in place) into dL/dy and write dL/dc, and writes dL/d parameters.
    pub fn differentiate<R>(
        &mut self,
        inputs: &[f32],
        gradient: &mut Vec<f32>,
        loss: impl FnOnce(&mut [f32], &[f32], &mut [f32]) -> R,
    ) -> R {
        let shape = self.shape;
        let x = self.tensor(inputs);
        let rows = x.size()[0];
        let buffers = Buffers::of(&mut self.buffers, rows as usize, shape, self.device);
        let h = &mut buffers.hidden;
        let _ = x.mm_out(h, &self.first);
        let _ = h.tanh_();
        let _ = h.mm_out(&buffers.outputs, &self.second);

        let mut y = Vec::new();
        download(&buffers.outputs, &mut y);
        let (bias, constants_at) = (shape.bias(), shape.constants_at());
        add_bias(&mut y, &self.parameters[bias..constants_at]);
        let mut constants_gradient = vec![0.0; shape.constants];
        let result = loss(&mut y, &self.parameters[constants_at..], &mut constants_gradient);

        let by_y = Tensor::from_slice(&y).view([rows, -1]).to_device(self.device);
        let _ = h.tr().mm_out(&self.second_gradient, &by_y);
        let by_h = &buffers.hidden_gradient;
        let _ = by_y.mm_out(by_h, &self.second.tr());
        let _ = Tensor::tanh_backward_grad_input(by_h, by_h, h);
        let _ = x.tr().mm_out(&self.first_gradient, by_h);

        download(&self.gradient, gradient);
        for unit in 0..2 * shape.hidden {
            for column in 0..shape.columns() {
                let (at, in_block) = shape.second_at(unit, column);
                if !in_block {
                    gradient[at] = 0.0;
                }
            }
        }
        let by_bias = &mut gradient[bias..constants_at];
        by_bias.fill(0.0);
        for row in y.chunks_exact(shape.columns()) {
            for (sum, value) in by_bias.iter_mut().zip(row) {
                *sum += value;
            }
        }
        gradient[constants_at..].copy_from_slice(&constants_gradient);
        result
    }

    fn tensor(&self, inputs: &[f32]) -> Tensor {
        Tensor::from_slice(inputs).view([-1, self.shape.row() as i64]).to_device(self.device)
    }
}

impl Buffers {
    fn of(slot: &mut Option<Buffers>, rows: usize, shape: Shape, device: Device) -> &mut Buffers {
        if slot.as_ref().is_none_or(|buffers| buffers.rows != rows) {
            let zeros = |columns: usize| {
                Tensor::zeros([rows as i64, columns as i64], (Kind::Float, device))
            };
            *slot = Some(Buffers {
                rows,
                hidden: zeros(2 * shape.hidden),
                outputs: zeros(shape.columns()),
                hidden_gradient: zeros(2 * shape.hidden),
            });
        }
        slot.as_mut().expect("filled above")
    }
}

fn download(tensor: &Tensor, values: &mut Vec<f32>) {
    values.resize(tensor.numel(), 0.0);
    tensor.copy_data(values, tensor.numel());
}

fn add_bias(outputs: &mut [f32], bias: &[f32]) {
    for row in outputs.chunks_exact_mut(bias.len()) {
        for (value, bias) in row.iter_mut().zip(bias) {
            *value += bias;
        }
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
