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
//! Columns per sample rather than rows, and W transposed, because the matrix library is five times
//! faster with `[5, 128] [128, n]` than with `[n, 128] [128, 5]`, and with `x (dL/dh)'` than with
//! `dL/dh x'`.

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

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.constants_at() + self.constants
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
    samples: i64,
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
        assert_eq!(parameters.len(), shape.parameters(), "parameters of the network");
        let flat = Tensor::zeros(shape.parameters() as i64, (Kind::Float, device));
        let gradient = flat.zeros_like();
        let view = |tensor: &Tensor| {
            let (first, second) = (shape.first() as i64, shape.second() as i64);
            let wide = 2 * shape.hidden as i64;
            (
                tensor.narrow(0, 0, first).view([shape.width() as i64, wide]).tr(),
                tensor.narrow(0, first, second).view([shape.rows() as i64, wide]),
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

    /// Outputs of the actor alone, shape `[k, n]`; `inputs` holds n samples one after the other,
    /// shape `[n, inputs + 1]`.
    pub fn act(&self, inputs: &[f32], outputs: &mut Vec<f32>) {
        let (hidden, k) = (self.shape.hidden as i64, self.shape.outputs as i64);
        let h = tanh_(self.first.narrow(0, 0, hidden).mm(&self.columns(inputs)));
        let y = self.second.narrow(0, 0, k).narrow(1, 0, hidden).mm(&h);
        download(&y, outputs);
        let bias = self.shape.bias_at();
        add_bias(outputs, &self.parameters[bias..bias + k as usize]);
    }

    /// Values of the critic alone, shape `[n]`, for inputs as in [`Network::act`].
    pub fn values(&self, inputs: &[f32], values: &mut Vec<f32>) {
        let (hidden, k) = (self.shape.hidden as i64, self.shape.outputs as i64);
        let h = tanh_(self.first.narrow(0, hidden, hidden).mm(&self.columns(inputs)));
        download(&self.second.narrow(0, k, 1).narrow(1, hidden, hidden).mm(&h), values);
        let bias = self.shape.bias_at() + self.shape.outputs;
        add_bias(values, &self.parameters[bias..=bias]);
    }

    /// Outputs and gradient in one: evaluates y on a batch of inputs as in [`Network::act`], lets
    /// `loss` turn it (shape `[k + 1, n]`, in place) into dL/dy and write dL/dc, given c, and writes
    /// dL/d parameters.
    pub fn differentiate<R>(
        &mut self,
        inputs: &[f32],
        gradient: &mut Vec<f32>,
        loss: impl FnOnce(&mut [f32], &[f32], &mut [f32]) -> R,
    ) -> R {
        let shape = self.shape;
        let x = self.columns(inputs).contiguous();
        let samples = x.size()[1];
        let buffers = Buffers::of(&mut self.buffers, samples, shape, self.device);
        let _ = self.first.mm_out(&buffers.hidden, &x);
        let h = tanh_(buffers.hidden.shallow_clone());
        let _ = self.second.mm_out(&buffers.outputs, &h);

        let mut y = Vec::new();
        download(&buffers.outputs, &mut y);
        let (bias, constants_at) = (shape.bias_at(), shape.constants_at());
        add_bias(&mut y, &self.parameters[bias..constants_at]);
        let mut by_constants = vec![0.0; shape.constants];
        let result = loss(&mut y, &self.parameters[constants_at..], &mut by_constants);

        let by_y = Tensor::from_slice(&y).view([-1, samples]).to_device(self.device);
        let _ = by_y.mm_out(&self.second_gradient, &h.tr());
        let by_h = &buffers.hidden_gradient;
        let _ = self.second.tr().mm_out(by_h, &by_y);
        let _ = Tensor::tanh_backward_grad_input(by_h, by_h, &h);
        let _ = x.mm_out(&self.first_gradient.tr(), &by_h.tr());

        download(&self.gradient, gradient);
        let hidden = shape.hidden;
        for row in 0..shape.outputs {
            gradient[shape.second_at(row, hidden)..shape.second_at(row, 2 * hidden)].fill(0.0);
        }
        let value = shape.outputs;
        gradient[shape.second_at(value, 0)..shape.second_at(value, hidden)].fill(0.0);
        for (sum, row) in gradient[bias..].iter_mut().zip(y.chunks_exact(samples as usize)) {
            *sum = row.iter().map(|&by| f64::from(by)).sum::<f64>() as f32;
        }
        gradient[constants_at..].copy_from_slice(&by_constants);
        result
    }

    /// x, a column per sample.
    fn columns(&self, inputs: &[f32]) -> Tensor {
        Tensor::from_slice(inputs).view([-1, self.shape.width() as i64]).to_device(self.device).tr()
    }
}

impl Buffers {
    fn of(slot: &mut Option<Buffers>, samples: i64, shape: Shape, device: Device) -> &mut Buffers {
        if slot.as_ref().is_none_or(|buffers| buffers.samples != samples) {
            let zeros = |rows: usize| Tensor::zeros([rows as i64, samples], (Kind::Float, device));
            *slot = Some(Buffers {
                samples,
                hidden: zeros(2 * shape.hidden),
                outputs: zeros(shape.rows()),
                hidden_gradient: zeros(2 * shape.hidden),
            });
        }
        slot.as_mut().expect("filled above")
    }
}

/// tanh(z) = 2 sigmoid(2z) - 1, in place: libtorch's sigmoid is vectorised everywhere, its tanh goes
/// to a library that is six times slower on some processors. A test holds it to 1e-5.
fn tanh_(mut z: Tensor) -> Tensor {
    let _ = z.g_mul_scalar_(2.0);
    let _ = z.sigmoid_();
    let _ = z.g_mul_scalar_(2.0);
    let _ = z.g_sub_scalar_(1.0);
    z
}

fn download(tensor: &Tensor, values: &mut Vec<f32>) {
    values.resize(tensor.numel(), 0.0);
    tensor.copy_data(values, tensor.numel());
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
