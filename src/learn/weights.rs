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

use crate::arena::Arena;
use crate::head::Head;
use crate::network::{Network, Shape};
use crate::pair::Pair;
use crate::ppo::Player;
use cvar_game::options::Role;
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
    /// Numbers that no player can play with.
    #[error("{quantity} of the {role} is not finite")]
    NotFinite {
        /// Whose.
        role: Role,
        /// What.
        quantity: &'static str,
    },
}

/// The players as the bytes of a safetensors file, with `about` in its header.
///
/// # Errors
/// If the format refuses a tensor.
pub fn to_bytes<W: Arena>(pair: &Pair<W>, about: String) -> Result<Vec<u8>, WeightsError> {
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
    // One entry: the header of several would follow the random order of a hash map.
    let metadata = HashMap::from([("cvar-game".to_owned(), about)]);
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
    let refused = |quantity| WeightsError::NotFinite { role, quantity };
    player.not_finite().map_or(Ok(()), |quantity| Err(refused(quantity)))
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
        let columns = self.shape.get(1).copied().unwrap_or(1);
        let [down, across] = self.strides;
        (0..self.shape[0])
            .flat_map(move |i| (0..columns).map(move |j| self.start + i * down + j * across))
    }
}

/// All tensors of a player, out of the flat layout of [`crate::network`].
fn layout(role: Role, shape: Shape) -> Vec<(String, Place)> {
    let Shape { inputs, hidden, outputs, constants } = shape;
    let mut places = Vec::new();
    let mut add = |name: &str, shape: Vec<usize>, start, strides| {
        places.push((format!("{role}.{name}"), Place { shape, start, strides }));
    };
    let wide = 2 * hidden;
    for (net, unit, row, rows) in [("actor", 0, 0, outputs), ("critic", hidden, outputs, 1)] {
        let first = shape.first_at(unit, 0);
        add(&format!("{net}.hidden.weight"), vec![hidden, inputs], first, [1, wide]);
        let bias = shape.first_at(unit, inputs);
        add(&format!("{net}.hidden.bias"), vec![hidden], bias, [1, 0]);
        let second = shape.second_at(row, unit);
        add(&format!("{net}.output.weight"), vec![rows, hidden], second, [wide, 1]);
        add(&format!("{net}.output.bias"), vec![rows], shape.bias_at() + row, [1, 0]);
    }
    if constants > 0 {
        add("actor.constants", vec![constants], shape.constants_at(), [1, 0]);
    }
    places
}
