"""The greedy actions of a trained protagonist on lava-grid, in PyTorch.

    python greedy.py RUN_DIR

needs torch and safetensors. Prints the map with an arrow for the greedy action of every free cell; with
--json, the actions (up 0, down 1, right 2, left 3) of all cells, row by row. As a test this is held against
the program's own actions.

A network is built from `final.safetensors` alone: tensors are named and laid out as PyTorch's
`Linear` has them, so `load_state_dict` takes them once the player's name is cut off.
"""

import json
import sys
import tomllib
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import nn


class Net(nn.Module):
    """outputs(x) = W2 tanh(W1 x + b1) + b2"""

    def __init__(self, inputs, hidden, outputs):
        super().__init__()
        self.hidden = nn.Linear(inputs, hidden)
        self.output = nn.Linear(hidden, outputs)

    def forward(self, x):
        return self.output(torch.tanh(self.hidden(x)))


def load(run, player="protagonist", part="actor"):
    """The actor or the critic of a player."""
    prefix = f"{player}.{part}."
    tensors = load_file(Path(run) / "final.safetensors")
    own = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
    own.pop("constants", None)  # log standard deviations of a Gaussian policy, no weights
    hidden, inputs = own["hidden.weight"].shape
    net = Net(inputs, hidden, own["output.weight"].shape[0])
    net.load_state_dict(own)
    return net.eval()


def observations(rows, view):
    """What the protagonist sees in each cell: as features the cell, one-hot; as coordinates x and y, first to
    last cell mapped onto [-1, 1]."""
    height, width = len(rows), len(rows[0])
    if view == "features":
        return torch.eye(height * width)
    scaled = lambda i, n: 0.0 if n == 1 else 2.0 * i / (n - 1) - 1.0
    return torch.tensor([[scaled(x, width), scaled(y, height)] for y in range(height) for x in range(width)])


def main(run, as_json):
    config = tomllib.loads((Path(run) / "config.toml").read_text())
    rows = config["env"]["lava-grid"]["map"].split()
    with torch.no_grad():
        seen = observations(rows, config["train"]["observation"])
        actions = load(run)(seen).argmax(dim=1).tolist()
    if as_json:
        print(json.dumps(actions))
        return
    width = len(rows[0])
    for y, row in enumerate(rows):
        print("".join("↑↓→←"[actions[y * width + x]] if tile in ".S" else tile for x, tile in enumerate(row)))


if __name__ == "__main__":
    main(sys.argv[1], "--json" in sys.argv[2:])
