"""The scene as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from cvar_game.worlds import World

MARKS = {"lava": "L", "goal": "G", "lesser-goal": "g", "wall": "#"}
# Characters per metre, where the scene is not of cells.
PER_METRE = 2.0


def ansi(world: World, trail: Sequence[npt.NDArray[Any]]) -> str:
    """The map: ``S`` start, ``G`` goal, ``g`` lesser goal, ``L`` lava, ``#`` wall, ``o`` the way, ``@`` the protagonist."""
    scene = world.scene
    scale = 1.0 if scene["cells"] else PER_METRE
    width, height = (int(np.ceil(side * scale)) for side in scene["size"])
    rows = [["."] * width for _ in range(height)]

    def mark(position: Sequence[float] | npt.NDArray[Any], character: str) -> None:
        x, y = (int(at * scale) for at in position)
        rows[min(max(y, 0), height - 1)][min(max(x, 0), width - 1)] = character

    for area in scene["areas"]:
        (left, top), (right, bottom) = area["min"], area["max"]
        for y in range(int(top * scale), int(np.ceil(bottom * scale))):
            for x in range(int(left * scale), int(np.ceil(right * scale))):
                rows[y][x] = MARKS[area["kind"]]
    mark(scene["start"], "S")
    for position in trail[:-1]:
        mark(position, "o")
    if trail:
        mark(trail[-1], "@")
    return "\n".join("".join(row) for row in rows) + "\n"
