//! The network's passes by libtorch, on any device: products of whole minibatches.
//!
//! Columns per sample rather than rows, and W transposed, because the matrix library is five times
//! faster with `[5, 128] [128, n]` than with `[n, 128] [128, 5]`, and with `x (dL/dh)'` than with
//! `dL/dh x'`.

use super::{Outputs, Shape};
use crate::learn::inputs::{Inputs, Rows, Selection};
use tch::{Device, Kind, Tensor};

/// The network on a device.
#[derive(Debug)]
pub struct Tensors {
    shape: Shape,
    device: Device,
    /// The parameters, with W and V as views of them.
    flat: Tensor,
    first: Tensor,
    second: Tensor,
    /// The gradient, with views likewise.
    gradient: Tensor,
    first_gradient: Tensor,
    second_gradient: Tensor,
    buffers: Option<Buffers>,
}

/// Tensors reused from batch to batch of one size.
#[derive(Debug)]
struct Buffers {
    samples: i64,
    hidden: Tensor,
    outputs: Tensor,
    hidden_gradient: Tensor,
}

impl Tensors {
    /// The network with these parameters.
    pub fn new(shape: Shape, parameters: &[f32], device: Device) -> Self {
        let flat = Tensor::zeros(shape.parameters() as i64, (Kind::Float, device));
        let gradient = flat.zeros_like();
        let view = |tensor: &Tensor| {
            let (first, second) = (shape.first() as i64, shape.second() as i64);
            let wide = 2 * shape.hidden as i64;
            (
                tensor.narrow(0, 0, first).view([shape.inputs() as i64 + 1, wide]).tr(),
                tensor.narrow(0, first, second).view([shape.rows() as i64, wide]),
            )
        };
        let (first, second) = view(&flat);
        let (first_gradient, second_gradient) = view(&gradient);
        let buffers = None;
        let mut tensors = Tensors {
            shape,
            device,
            flat,
            first,
            second,
            gradient,
            first_gradient,
            second_gradient,
            buffers,
        };
        tensors.upload(parameters);
        tensors
    }

    /// Changes the parameters.
    pub fn upload(&mut self, parameters: &[f32]) {
        self.flat.copy_(&Tensor::from_slice(parameters));
    }

    /// The actor's outputs, shape `[k, n]`, or the critic's, shape `[1, n]`, without their biases.
    pub fn evaluate(&self, inputs: Rows<'_>, critic: bool, outputs: &mut Vec<f32>) {
        let (hidden, k) = (self.shape.hidden as i64, self.shape.outputs as i64);
        let (unit, row, rows) = if critic { (hidden, k, 1) } else { (0, 0, k) };
        let h = tanh_(self.first.narrow(0, unit, hidden).mm(&self.columns(inputs)));
        download(&self.second.narrow(0, row, rows).narrow(1, unit, hidden).mm(&h), outputs);
    }

    /// Outputs and gradient in one, as in `Network::differentiate`; the whole batch is one block.
    pub fn differentiate(
        &mut self,
        parameters: &[f32],
        inputs: Selection<'_>,
        gradient: &mut Vec<f32>,
        mut loss: impl FnMut(Outputs<'_>),
    ) {
        let shape = self.shape;
        let mut minibatch = Inputs::default();
        for &index in inputs.indices {
            minibatch.extend(inputs.all.row(index, shape.width()));
        }
        let x = self.columns(minibatch.rows()).contiguous();
        let samples = x.size()[1];
        let buffers = Buffers::of(&mut self.buffers, samples, shape, self.device);
        let _ = self.first.mm_out(&buffers.hidden, &x);
        let h = tanh_(buffers.hidden.shallow_clone());
        let _ = self.second.mm_out(&buffers.outputs, &h);

        let mut y = Vec::new();
        download(&buffers.outputs, &mut y);
        let (bias, constants_at) = (shape.bias_at(), shape.constants_at());
        super::add_bias(&mut y, &parameters[bias..constants_at]);
        let stride = samples as usize;
        loss(Outputs { start: 0, samples: stride, y: &mut y, stride });

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
        for (sum, row) in gradient[bias..].iter_mut().zip(y.chunks_exact(stride)) {
            *sum = row.iter().map(|&by| f64::from(by)).sum::<f64>() as f32;
        }
    }

    /// x, a column per sample.
    fn columns(&self, inputs: Rows<'_>) -> Tensor {
        let numbers = Tensor::from_slice(inputs.numbers).view([-1, self.shape.width() as i64]);
        let numbers = numbers.to_device(self.device);
        if inputs.cells.is_empty() {
            return numbers.tr();
        }
        let cells: Vec<i64> = inputs.cells.iter().map(|&cell| i64::from(cell)).collect();
        let cells = Tensor::from_slice(&cells).to_device(self.device);
        let one_hot = cells.one_hot(self.shape.columns.cells as i64).to_kind(Kind::Float);
        Tensor::cat(&[one_hot, numbers], 1).tr()
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

/// tanh(z) = 2 sigmoid(2z) - 1, in place: libtorch's sigmoid is vectorised everywhere, its tanh is
/// that of a library that is six times slower on some processors. A test checks it to 1e-5.
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
