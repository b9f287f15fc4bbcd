//! The processor's engine and libtorch's, against libtorch's own derivatives. With the feature `torch`.

#![cfg(feature = "torch")]

use cvar_game::learn::device::Device;
use cvar_game::learn::inputs::{Columns, Rows, Selection};
use cvar_game::learn::network::{Network, Outputs, Shape};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use tch::{Kind, Tensor};

/// The written-out gradients of the networks, ours and libtorch's products, against autograd, for a loss
/// that mixes all of y.
#[test]
fn network_gradients_equal_autograd() {
    let columns = Columns { cells: 0, numbers: 5, critic_only: 0 };
    let shape = Shape { columns, hidden: 16, outputs: 3, constants: 2 };
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut network = Network::new(shape, &[0.2, -0.4], Device::Cpu, &mut random);
    // Not V, whose blocks beside the diagonal are zero for good.
    network.change(|p| p[..shape.second_at(0, 0)].iter_mut().for_each(|p| *p += 0.1));
    network.change(|p| p[shape.bias_at()..].iter_mut().for_each(|p| *p += 0.1));
    let n = 40;
    let inputs: Vec<f32> = (0..n * shape.width())
        .map(|i| if i % 6 == 5 { 1.0 } else { random.random_range(-1.0..1.0) })
        .collect();
    let slopes: Vec<f32> = (0..4 * n).map(|_| random.random_range(-1.0..1.0)).collect();

    let flat = Tensor::from_slice(network.parameters()).set_requires_grad(true);
    let piece = |start: usize, rows: usize, columns: usize| {
        flat.narrow(0, start as i64, (rows * columns) as i64).view([rows as i64, columns as i64])
    };
    let (h, k) = (shape.hidden, shape.outputs);
    let x = Tensor::from_slice(&inputs).view([n as i64, -1]).tr();
    let hidden = piece(0, shape.width(), 2 * h).tr().mm(&x).tanh();
    let second = piece(shape.second_at(0, 0), k + 1, 2 * h);
    let bias = piece(shape.bias_at(), k + 1, 1);
    let half = |rows: (usize, usize), units: (usize, usize)| {
        second
            .narrow(0, rows.0 as i64, rows.1 as i64)
            .narrow(1, units.0 as i64, units.1 as i64)
            .mm(&hidden.narrow(0, units.0 as i64, units.1 as i64))
    };
    let y = Tensor::cat(&[half((0, k), (0, h)), half((k, 1), (h, h))], 0) + bias;
    let slopes_of_y = Tensor::from_slice(&slopes).view([(k + 1) as i64, -1]);
    (&slopes_of_y * y.square()).sum(Kind::Float).backward(); // L = sum(slopes * y^2)
    let truth = Vec::<f32>::try_from(flat.grad()).unwrap();
    let y = Vec::<f32>::try_from(y.reshape([-1])).unwrap();
    let by_libtorch = Network::by_libtorch(shape, network.parameters().to_vec(), Device::Cpu);
    for mut network in [network, by_libtorch] {
        let (mut gradient, mut outputs) = (Vec::new(), vec![0.0; slopes.len()]);
        let rows = Rows { cells: &[], numbers: &inputs };
        let all = Selection { all: rows, indices: &(0..n).collect::<Vec<_>>() };
        network.differentiate(all, &mut gradient, |Outputs { start, samples, y, stride }| {
            for (row, y) in y.chunks_exact_mut(stride).enumerate() {
                for (i, y) in y[..samples].iter_mut().enumerate() {
                    let at = row * n + start + i;
                    outputs[at] = *y;
                    *y *= 2.0 * slopes[at];
                }
            }
        });
        for (i, (written, truth)) in gradient.iter().zip(&truth).enumerate() {
            assert!(
                (written - truth).abs() < 1e-5 * (1.0 + truth.abs()),
                "{i}: {written}, {truth}"
            );
        }
        for (ours, theirs) in outputs.iter().zip(&y) {
            assert!((ours - theirs).abs() < 1e-5, "{ours} against {theirs}");
        }
        let (mut acted, mut values) = (Vec::new(), Vec::new());
        network.act(rows, &mut acted);
        network.values(rows, &mut values);
        for (one, other) in outputs.iter().zip(acted.iter().chain(&values)) {
            assert!((one - other).abs() < 1e-5, "actor and critic alone: {one} against {other}");
        }
    }
}
