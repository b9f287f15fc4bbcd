"""Results: finished runs as policies and opponents, your own as rows of the table, and all as data frames."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cvar_game import _core
from cvar_game._arguments import eta_of, number, numbers, seed_of, whole
from cvar_game.worlds import World, as_table

if TYPE_CHECKING:
    import pandas as pd

    from cvar_game.yardsticks import Evaluation

Array = npt.NDArray[Any]


class Run:
    """A finished run of ``cvar-game bench`` or ``train``: its players.

    Args:
        folder: The run's folder, with ``config.toml`` and ``final.safetensors``; of a packed run, the folder that it
            had.

    Raises:
        ValueError: If it is no folder of a finished run.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._core = _core.Run(self.folder)
        self.configuration: dict[str, Any] = json.loads(self._core.configuration())
        """The run's configuration: the content of its ``config.toml``."""
        (name, constants), *_ = self.configuration["env"].items()
        self.world = World(name, **constants)
        """Its world."""
        self.eta = float(self.configuration["eta"])
        """Its budget."""
        train = self.configuration["train"]
        self.observation: str = train["observation"]
        """How its players see the world: ``"coordinates"`` or ``"features"``."""
        self.time: bool = train["protagonist"]["time_aware"]
        """Whether its protagonist sees the time."""
        self._random = np.random.default_rng(0)

    def __repr__(self) -> str:
        return f"Run({os.fspath(self.folder)!r})"

    @property
    def env_options(self) -> dict[str, Any]:
        """The arguments of an environment in which its protagonist can act:
        ``gym.make("cvar_game/LavaGrid-v0", **run.env_options)``.
        """
        return {"observation": self.observation, "time": self.time, **self.world.changes}

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """The protagonist's actions, as Stable-Baselines3's policies give them.

        Args:
            observation: One observation, shape ``(width,)``, or a batch, shape ``(n, width)``, of an
                environment with :attr:`env_options`.
            state, episode_start: Ignored: the protagonist has no memory.
            deterministic: Whether to take the mode of the policy; else the action is drawn.

        Returns:
            The action, or the batch of them, and ``state``.
        """
        seen = numbers("observations", observation).astype(np.float32)
        if seen.ndim not in (1, 2):
            raise ValueError(f"observations must have one or two dimensions, got {seen.ndim}")
        seed = None if deterministic else int(self._random.integers(2**63))
        actions = self._core.act(np.atleast_2d(seen), seed)
        return (actions[0] if seen.ndim == 1 else actions), state

    def seed(self, seed: int) -> None:
        """Seeds the actions that are drawn."""
        self._random = np.random.default_rng(seed_of(seed))

    def table(self) -> npt.NDArray[np.float64] | None:
        """The protagonist's action probabilities, shape ``(states, actions)``, or
        ``(horizon, states, actions)`` if it sees the time; ``None`` where states are not finitely many.
        """
        return self._core.table()


def load(folder: str | os.PathLike[str]) -> Run:
    """The players of a finished run; see :class:`Run`."""
    return Run(folder)


def record(
    policy: Any,
    world: World | str,
    eta: float,
    out: str | os.PathLike[str],
    *,
    method: str,
    seed: int,
    steps: int,
    seconds: float,
    gamma: float = 1.0,
    **options: Any,
) -> Evaluation:
    """Evaluates a policy and writes it as a run, for ``cvar-game table RESULTS --compare OUT``.

    Args:
        policy, world, eta, gamma, options: As those of :func:`cvar_game.evaluate`.
        out: The results folder; the run goes to ``OUT/WORLD/METHOD/eta-E/seed-N``.
        method: Name of the method that trained it, ``METHOD`` or ``METHOD/VARIANT``.
        seed: Seed of its training.
        steps: Environment steps of its training.
        seconds: Wall-clock seconds of its training.

    Returns:
        What was measured.

    Raises:
        ValueError: As :func:`cvar_game.evaluate`, or if the folder cannot be written.
    """
    from cvar_game.yardsticks import evaluate

    steps, seed = whole("steps", steps, 0, 2**63 - 1), seed_of(seed)
    seconds, eta, gamma = number("seconds", seconds), eta_of(eta), number("gamma", gamma)
    if not 0.0 <= seconds < np.inf:
        raise ValueError(f"seconds = {seconds} must be a finite number of at least 0")
    for name in ("observation", "time", "opponent", "episodes", "num_envs"):
        options.setdefault(name, _DEFAULTS[name])
    known = {name: options.pop(name) for name in _DEFAULTS}
    world = World.of(world, options)
    found = evaluate(policy, world, eta, gamma=gamma, **known)
    _core.write_run(
        Path(out),
        world._core,
        found._judged,
        method=method,
        eta=eta,
        gamma=gamma,
        seed=seed,
        steps=steps,
        seconds=seconds,
        clearance=found.clearance,
    )
    return found


_DEFAULTS: dict[str, Any] = {
    "observation": "coordinates",
    "time": False,
    "opponent": None,
    "episodes": 100_000,
    "num_envs": 1_000,
}


def results(folder: str | os.PathLike[str]) -> pd.DataFrame:
    """All runs of a results folder, a row each: the columns of its ``runs.csv``. Needs pandas.

    Raises:
        ValueError: If it has no runs.
    """
    import warnings

    import pandas as pd

    text, notes = _core.read_results(Path(folder))
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return pd.read_csv(io.StringIO(text))
