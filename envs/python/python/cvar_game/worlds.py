"""The worlds: their constants, and who may decide chance in them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import numpy.typing as npt

from cvar_game import _core
from cvar_game._arguments import number, numbers, shown

if TYPE_CHECKING:
    from cvar_game.results import Run

Array = npt.NDArray[Any]


def worlds() -> list[str]:
    """The names of the worlds."""
    return list(_core.worlds_of())


def scenes() -> dict[str, str]:
    """The maps of the scenes, by name.

    A world is played on one by the name ``WORLD/SCENE``, such as ``"lava-point/detour"``.
    """
    return {name: picture for name, _, picture in _core.scenes_of()}


class World:
    """A world with its constants.

    Args:
        name: ``"lava-grid"`` or ``"lava-point"``, or either on a scene, such as ``"lava-grid/detour"``.
        constants: Those that differ from the defaults, such as ``slip=0.1`` or ``noise=1.5``;
            ``cvar-game envs`` prints all with their meaning and range.

    Raises:
        ValueError: If there is no such world or constant, or a value is out of range.
    """

    def __init__(self, name: str, **constants: Any) -> None:
        changes = ",".join(_entry(key, value) for key, value in constants.items())
        self._core = _core.World(name, f"{{{changes}}}")
        described = json.loads(self._core.describe())
        self.name: str = described["name"]
        """The name."""
        self.constants: dict[str, Any] = described["constants"]
        """All constants, by name."""
        self.horizon: int = described["horizon"]
        """Time limit T in steps. A true end of the episode."""
        self.actions: int | None = described["actions"]
        """Number of actions; ``None`` where they are pushes in the plane."""
        self.states: int | None = described["states"]
        """Number of states, if they are finitely many; the start and ends are among them."""
        self.outcomes: int | None = described["outcomes"]
        """Number of outcomes of chance, if they are finitely many."""
        self.scene: dict[str, Any] = described["scene"]
        """What figures draw: ``size``, ``start`` and ``areas`` of lava, goals and walls."""
        self._observation: int = described["observation"]
        self._positions: int = described["positions"]

    def __repr__(self) -> str:
        return f"World({self.name!r})"

    @property
    def changes(self) -> dict[str, Any]:
        """The constants that differ from the defaults."""
        defaults = World(self.name).constants
        return {key: value for key, value in self.constants.items() if value != defaults[key]}

    @classmethod
    def of(cls, world: str | World, constants: dict[str, Any]) -> World:
        """A world from what functions take: a name with constants, or a world."""
        if isinstance(world, World):
            if constants:
                raise ValueError("give constants to the World, not to this function")
            return world
        return cls(world, **constants)


def _entry(name: str, value: object) -> str:
    """A constant as an entry of an object of JSON."""
    if not name.isprintable():
        raise ValueError(f"there is no constant {shown(name)}")
    try:
        text = json.dumps({name: value}, default=_plain, allow_nan=False, ensure_ascii=False)
        if value is not None and text.encode():
            return text[1:-1]
    except (TypeError, ValueError, RecursionError, MemoryError):
        pass
    raise ValueError(f"{name} = {shown(value)} must be a finite number, text, or a list of them")


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{value!r}")


@dataclass(frozen=True)
class WorstCase:
    """The exact worst-case antagonist of a policy, as the opponent of an environment.

    It exists in finite worlds. It is the worst case of the policy's greedy version; where the
    protagonist takes another action it leaves chance alone, and it never exceeds the budget.

    Args:
        policy: Action probabilities, shape ``(states, actions)`` or ``(horizon, states, actions)``,
            or a trained run.
        gamma: Discount factor of the return that it minimises.
    """

    policy: Array | Run
    gamma: float = 1.0


Opponent = Union[None, str, "os.PathLike[str]", WorstCase, "Run"]
"""Who decides chance: ``None`` or ``"nominal"`` for chance itself, a :class:`WorstCase`, or a trained
run (its antagonist), by itself or by its folder."""


def is_nominal(opponent: Opponent) -> bool:
    """Whether it is chance itself."""
    return opponent is None or (isinstance(opponent, str) and opponent == "nominal")


def core_opponent(opponent: Opponent) -> _core.Opponent:
    """The opponent as the module's own."""
    from cvar_game.results import Run

    if is_nominal(opponent):
        return _core.Opponent.nominal()
    if isinstance(opponent, WorstCase):
        policy = opponent.policy
        table = policy.table() if isinstance(policy, Run) else policy
        return _core.Opponent.worst_case(as_table(table), number("gamma", opponent.gamma))
    if isinstance(opponent, Run):
        return _core.Opponent.trained(opponent.folder)
    if isinstance(opponent, (str, os.PathLike)):
        return _core.Opponent.trained(opponent)
    raise ValueError(
        f"opponent = {shown(opponent)}: use None, a WorstCase, or a finished run or its folder"
    )


def as_table(policy: object) -> npt.NDArray[np.float64]:
    """Action probabilities as an array of real numbers."""
    table = numbers("a policy table", policy)
    if table.ndim not in (2, 3):
        raise ValueError(
            f"a policy table must have shape (states, actions) or (horizon, states, actions), got "
            f"{table.shape}"
        )
    return table
