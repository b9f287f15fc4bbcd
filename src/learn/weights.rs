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
//! `inputs` are the one-hot code of the cell, where the player sees one, and then its numbers.
//! PLAYER is `protagonist`, `antagonist` or, in the game `joint`, `action-antagonist`; all f32. `outputs(x) = W2 tanh(W1 x + b1) + b2`.

use super::device::Device;
use super::network::{Network, Shape};
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use std::collections::{BTreeMap, HashMap};

/// The entry of the header that says which run a file is of.
const ABOUT: &str = "cvar-game";

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
        /// The shape by the run's configuration.
        expected: Vec<usize>,
        /// What the file has.
        found: String,
    },
    /// Numbers that no player can play with.
    #[error("{quantity} of the {player} is not finite")]
    NotFinite {
        /// Whose.
        player: &'static str,
        /// What.
        quantity: &'static str,
    },
}

/// The networks of some players, by their names, as the bytes of a safetensors file, with `about` in its header.
///
/// # Errors
/// If the format refuses a tensor.
pub fn to_bytes(
    networks: &[(&'static str, &Network)],
    about: String,
) -> Result<Vec<u8>, WeightsError> {
    let places = networks.iter().flat_map(|&(player, network)| {
        layout(player, network.shape()).into_iter().map(|(name, tensor)| {
            let numbers = tensor.indices().map(|at| network.parameters()[at]).collect();
            (name, tensor.shape, numbers)
        })
    });
    tensors_to_bytes(places, about)
}

/// Tensors by their names, each with its shape and its numbers, as the bytes of a safetensors file, with `about` in its
/// header.
///
/// # Errors
/// If the format refuses a tensor.
pub fn tensors_to_bytes(
    tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    about: String,
) -> Result<Vec<u8>, WeightsError> {
    let to_bytes = |(name, shape, numbers): (String, Vec<usize>, Vec<f32>)| {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        (name, (shape, bytes))
    };
    let tensors: BTreeMap<_, _> = tensors.into_iter().map(to_bytes).collect();
    let views = tensors
        .iter()
        .map(|(name, (shape, bytes))| {
            TensorView::new(Dtype::F32, shape.clone(), bytes).map(|view| (name, view))
        })
        .collect::<Result<Vec<_>, _>>()?;
    // One entry: the header of several would follow the random order of a hash map.
    let metadata = HashMap::from([(ABOUT.to_owned(), about)]);
    Ok(safetensors::serialize(views, Some(metadata))?)
}

/// What [`to_bytes`] was told about a file; `None` if the file does not say.
///
/// # Errors
/// If it is no safetensors file.
pub fn about(bytes: &[u8]) -> Result<Option<String>, WeightsError> {
    let (_, header) = SafeTensors::read_metadata(bytes)?;
    Ok(header.metadata().as_ref().and_then(|of| of.get(ABOUT).cloned()))
}

/// A safetensors file of weights.
pub struct Weights<'a>(SafeTensors<'a>);

impl<'a> Weights<'a> {
    /// The file in these bytes.
    ///
    /// # Errors
    /// If they are no safetensors file.
    pub fn read(bytes: &'a [u8]) -> Result<Self, WeightsError> {
        Ok(Weights(SafeTensors::deserialize(bytes)?))
    }

    /// The numbers of a tensor of this shape.
    ///
    /// # Errors
    /// If it is absent or of another shape.
    pub fn numbers(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightsError> {
        let refuse = |found: String| WeightsError::Tensor {
            name: name.to_owned(),
            expected: shape.to_vec(),
            found,
        };
        let view = self.0.tensor(name).map_err(|_| refuse("none".to_owned()))?;
        if view.dtype() != Dtype::F32 || view.shape() != shape {
            return Err(refuse(format!("{:?} of {:?}", view.shape(), view.dtype())));
        }
        Ok(view.data().as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    /// The network of a player.
    ///
    /// # Errors
    /// If a tensor is absent or of another shape.
    pub fn network(
        &self,
        player: &'static str,
        shape: Shape,
        device: Device,
    ) -> Result<Network, WeightsError> {
        let mut parameters = vec![0.0; shape.parameters()];
        for (name, tensor) in layout(player, shape) {
            for (at, number) in tensor.indices().zip(self.numbers(&name, &tensor.shape)?) {
                parameters[at] = number;
            }
        }
        let network = Network::from_parameters(shape, parameters, device);
        let refused = |quantity| WeightsError::NotFinite { player, quantity };
        network.not_finite().map_or(Ok(network), |quantity| Err(refused(quantity)))
    }
}

/// Where a tensor's entries are in the flat parameters: entry (i, j) at
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

/// All tensors of a player, out of the flat layout of [`crate::learn::network`].
fn layout(player: &str, shape: Shape) -> Vec<(String, Place)> {
    let Shape { hidden, outputs, constants, .. } = shape;
    let mut places = Vec::new();
    let mut add = |name: &str, shape: Vec<usize>, start, strides| {
        places.push((format!("{player}.{name}"), Place { shape, start, strides }));
    };
    let wide = 2 * hidden;
    let (actor_inputs, inputs) = (shape.critic_only().start, shape.inputs());
    for (net, seen, unit, row, rows) in
        [("actor", actor_inputs, 0, 0, outputs), ("critic", inputs, hidden, outputs, 1)]
    {
        let first = shape.first_at(unit, 0);
        add(&format!("{net}.hidden.weight"), vec![hidden, seen], first, [1, wide]);
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
