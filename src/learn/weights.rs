//! Weights of a pair as safetensors, named and laid out as PyTorch's `Linear` has them.
//!
//! | tensor | shape |
//! |---|---|
//! | `PLAYER.actor.hidden.weight`, `.bias` | `[hidden, inputs]`, `[hidden]` |
//! | `PLAYER.actor.output.weight`, `.bias` | `[outputs, hidden]`, `[outputs]` |
//! | `PLAYER.critic.hidden.weight`, `.bias` | `[hidden, inputs]`, `[hidden]` |
//! | `PLAYER.critic.output.weight`, `.bias` | `[1, hidden]`, `[1]` |
//! | `PLAYER.actor.constants` | `[constants]`: log standard deviations of a Gaussian policy |
//!
//! PLAYER is `protagonist` or `antagonist`; all f32. `outputs(x) = W2 tanh(W1 x + b1) + b2`.

use crate::learn::arena::Arena;
use crate::learn::head::Head;
use crate::learn::network::{Network, Shape};
use crate::learn::options::Role;
use crate::learn::pair::Pair;
use crate::learn::ppo::Player;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use std::collections::{BTreeMap, HashMap};
use tch::Device;

/// Why a file holds no weights of the pair.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// Not a safetensors file.
    #[error("not a safetensors file: {0}")]
    Format(#[from] SafeTensorError),
    /// A tensor is absent or of another shape.
    #[error("tensor `{name}` of shape {expected:?} expected, found {found}")]
    Tensor {
        /// Name of the tensor.
        name: String,
        /// Shape that the run's configuration asks for.
        expected: Vec<usize>,
        /// What the file has.
        found: String,
    },
}

/// The players as the bytes of a safetensors file, with `metadata` in its header.
///
/// # Errors
/// If the format refuses a tensor.
pub fn to_bytes<W: Arena>(
    pair: &Pair<W>,
    metadata: HashMap<String, String>,
) -> Result<Vec<u8>, WeightsError> {
    let mut tensors = BTreeMap::new();
    let mut add = |role: Role, network: &Network| {
        for (name, tensor) in layout(role, network.shape()) {
            let bytes: Vec<u8> =
                tensor.indices().flat_map(|at| network.parameters()[at].to_le_bytes()).collect();
            tensors.insert(name, (tensor.shape, bytes));
        }
    };
    add(Role::Protagonist, &pair.protagonist.network);
    if let Some(antagonist) = &pair.antagonist {
        add(Role::Antagonist, &antagonist.network);
    }
    let views = tensors
        .iter()
        .map(|(name, (shape, bytes))| {
            TensorView::new(Dtype::F32, shape.clone(), bytes).map(|view| (name, view))
        })
        .collect::<Result<Vec<_>, _>>()?;
    Ok(safetensors::serialize(views, Some(metadata))?)
}

/// Replaces the players' weights by those of a safetensors file.
///
/// # Errors
/// If the bytes are no such file, or a tensor is absent or of another shape.
pub fn load<W: Arena>(
    pair: &mut Pair<W>,
    bytes: &[u8],
    device: Device,
) -> Result<(), WeightsError> {
    let file = SafeTensors::deserialize(bytes)?;
    restore(&mut pair.protagonist, Role::Protagonist, &file, device)?;
    if let Some(antagonist) = &mut pair.antagonist {
        restore(antagonist, Role::Antagonist, &file, device)?;
    }
    Ok(())
}

fn restore<H: Head>(
    player: &mut Player<H>,
    role: Role,
    file: &SafeTensors<'_>,
    device: Device,
) -> Result<(), WeightsError> {
    let shape = player.network.shape();
    let mut parameters = vec![0.0; shape.parameters()];
    for (name, tensor) in layout(role, shape) {
        let refuse = |found: String| WeightsError::Tensor {
            name: name.clone(),
            expected: tensor.shape.clone(),
            found,
        };
        let view = file.tensor(&name).map_err(|_| refuse("none".to_owned()))?;
        if view.dtype() != Dtype::F32 || view.shape() != tensor.shape {
            return Err(refuse(format!("{:?} of {:?}", view.shape(), view.dtype())));
        }
        for (at, bytes) in tensor.indices().zip(view.data().as_chunks::<4>().0) {
            parameters[at] = f32::from_le_bytes(*bytes);
        }
    }
    *player = Player::with_network(
        player.head.clone(),
        Network::from_parameters(shape, parameters, device),
    );
    Ok(())
}

/// Where a tensor's entries lie in the flat parameters: entry (i, j) at
/// `start + i * strides[0] + j * strides[1]`.
struct Place {
    shape: Vec<usize>,
    start: usize,
    strides: [usize; 2],
}

impl Place {
    fn indices(&self) -> impl Iterator<Item = usize> + '_ {
        let (rows, columns) = match self.shape[..] {
            [rows, columns] => (rows, columns),
            _ => (self.shape[0], 1),
        };
        let [down, across] = self.strides;
        (0..rows).flat_map(move |i| (0..columns).map(move |j| self.start + i * down + j * across))
    }
}

/// All tensors of a player. See [`crate::learn::network`] for the flat layout `[W | V | b | c]`.
fn layout(role: Role, shape: Shape) -> Vec<(String, Place)> {
    let Shape { inputs, hidden, outputs, constants } = shape;
    let (wide, columns) = (2 * hidden, outputs + 1);
    let second = (inputs + 1) * wide;
    let bias = second + wide * columns;
    let mut places = Vec::new();
    let mut add = |name: &str, shape: Vec<usize>, start, strides| {
        places.push((format!("{role}.{name}"), Place { shape, start, strides }));
    };
    for (net, half, first_column, count) in [("actor", 0, 0, outputs), ("critic", 1, outputs, 1)] {
        let unit = half * hidden;
        add(&format!("{net}.hidden.weight"), vec![hidden, inputs], unit, [1, wide]);
        add(&format!("{net}.hidden.bias"), vec![hidden], inputs * wide + unit, [1, 0]);
        let start = second + unit * columns + first_column;
        add(&format!("{net}.output.weight"), vec![count, hidden], start, [1, columns]);
        add(&format!("{net}.output.bias"), vec![count], bias + first_column, [1, 0]);
    }
    if constants > 0 {
        add("actor.constants", vec![constants], bias + columns, [1, 0]);
    }
    places
}
