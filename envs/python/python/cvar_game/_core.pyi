"""The native module: what ``envs/python/src`` exports, checked by ``python -m mypy.stubtest cvar_game._core``.

Arrays must have the given type exactly; ``SupportsFloat`` and the like are not asked here.
"""

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

__all__ = [
    "Games",
    "Judged",
    "Law",
    "Mdp",
    "MdpWorstCase",
    "Opponent",
    "Optimum",
    "Run",
    "World",
    "program",
    "read_results",
    "scenes_of",
    "worlds_of",
    "write_run",
]

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]
_Sights = npt.NDArray[np.float32]
_Actions = _Integers | _Floats
_Folder = str | PathLike[str]

@final
class World:
    """A world with constants."""

    def __new__(cls, name: str, changes: str) -> World: ...
    def describe(self) -> str: ...
    def picture(self, trail: _Floats) -> npt.NDArray[np.uint8]: ...
    def exact(self, eta: float, gamma: float, compute: bool) -> str: ...
    def judge_table(
        self, table: _Floats, eta: float, gamma: float, opponent: Opponent | None = None
    ) -> Judged: ...
    def judge_law(self, law: Law, eta: float, gamma: float) -> Judged: ...
    def optimal_policy(self, eta: float, gamma: float) -> _Floats | None: ...
    def sights(self, features: bool, time_aware: bool, time: int) -> _Sights: ...
    def sight_width(self, features: bool, time: bool) -> int: ...
    def worst_case(self, table: _Floats, eta: float, gamma: float) -> _Floats: ...
    def play(
        self,
        policy: Callable[[_Sights], _Actions],
        *,
        eta: float,
        gamma: float,
        episodes: int,
        slots: int,
        seed: int,
        features: bool,
        time: bool,
        opponent: Opponent | None = None,
    ) -> tuple[Law, _Floats, _Floats]: ...

@final
class Opponent:
    """Who decides chance."""

    @staticmethod
    def nominal() -> Opponent: ...
    @staticmethod
    def worst_case(table: _Floats, gamma: float) -> Opponent: ...
    @staticmethod
    def trained(folder: _Folder) -> Opponent: ...
    @staticmethod
    def played(kind: str, count: int, center: float, curvature: float) -> Opponent: ...

@final
class Games:
    """A batch of games."""

    def __new__(
        cls,
        world: World,
        *,
        slots: int,
        features: bool,
        time: bool,
        eta: float,
        opponent: Opponent,
        autoreset: str,
        tells: bool = True,
    ) -> Games: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def situation_size(self) -> int: ...
    @property
    def parameters(self) -> int: ...
    def reset(self, slots: Sequence[int], seeds: Sequence[int] | None) -> _Sights: ...
    def step(
        self, actions: _Actions, parameters: npt.NDArray[np.float32] | None = None
    ) -> tuple[_Sights, _Floats, _Flags, _Flags, dict[str, Any]]: ...
    def situation(self, actions: _Actions) -> _Sights: ...
    def clearance(self) -> _Floats: ...
    def positions(self) -> _Floats: ...
    def times(self) -> _Integers: ...
    def states(self) -> _Integers | None: ...
    def snapshot(self, slot: int) -> bytes: ...
    def restore(self, slot: int, snapshot: bytes) -> None: ...

@final
class Run:
    """The players of a finished run."""

    def __new__(cls, folder: _Folder) -> Run: ...
    def configuration(self) -> str: ...
    @property
    def actions(self) -> int | None: ...
    @property
    def observation_size(self) -> int: ...
    def act(self, observations: _Sights, seed: int | None) -> _Actions: ...
    def table(self) -> _Floats | None: ...

@final
class Judged:
    """A policy compared with the best."""

    @property
    def law(self) -> Law: ...
    @property
    def sampled(self) -> Law | None: ...
    @property
    def optimum(self) -> float | None: ...
    @property
    def regret(self) -> float | None: ...
    @property
    def regret_standard_error(self) -> float | None: ...
    @property
    def class_regret(self) -> float | None: ...
    @property
    def exploitability(self) -> float | None: ...
    @property
    def response_gain(self) -> float | None: ...
    @property
    def response_error(self) -> float | None: ...

@final
class Law:
    """The law of a return: exact, or of recorded episodes."""

    @property
    def episodes(self) -> int | None:
        """Number of recorded episodes; ``None`` for an exact law."""

    @property
    def values(self) -> _Floats:
        """Values of the return, ascending."""

    @property
    def probabilities(self) -> _Floats:
        """Their probabilities."""

    @property
    def steps(self) -> _Floats:
        """The lengths of their episodes."""

    @property
    def ends(self) -> _Floats:
        """How their episodes end, as 1 goal, 2 lava, 3 time limit."""

    def mean(self) -> float:
        """The mean."""

    def var(self, alpha: float) -> float:
        """The lower alpha-quantile."""

    def cvar(self, alpha: float) -> float:
        """The mean of the worst alpha of the outcomes."""

    def mean_standard_error(self) -> float:
        """Standard error of the mean; 0 for an exact law."""

    def cvar_standard_error(self, alpha: float) -> float:
        """Standard error of the CVaR; 0 for an exact law."""

@final
class Mdp:
    """A finite MDP with a time limit."""

    def __new__(
        cls,
        state: _Integers,
        action: _Integers,
        next: _Integers,
        probability: _Floats,
        reward: _Floats,
        *,
        states: int,
        start: _Floats,
        horizon: int,
        gamma: float,
    ) -> Mdp: ...
    @property
    def states(self) -> int: ...
    @property
    def actions(self) -> int: ...
    @property
    def horizon(self) -> int: ...
    @property
    def gamma(self) -> float: ...
    @property
    def start(self) -> _Floats: ...
    @property
    def one_level(self) -> bool: ...
    def action_count(self, state: int) -> int: ...
    def outcomes(self, state: int, action: int) -> tuple[_Integers, _Floats, _Floats]: ...
    def levels(self, time: int) -> _Floats: ...
    def has_solved(self, optimum: Optimum) -> bool: ...
    def optimum(self, alpha: float) -> Optimum: ...
    def evaluate(self, policy: _Floats) -> Law: ...
    def worst_case(self, policy: _Floats, eta: float) -> MdpWorstCase: ...
    def chow(self, eta: float) -> float: ...
    def best_stationary(self, alpha: float) -> tuple[Law, _Integers, bool, int]: ...

@final
class Optimum:
    """The best attainable CVaR, and a policy over time, accumulated reward and state that attains it."""

    @property
    def alpha(self) -> float:
        """Risk level."""

    @property
    def cvar(self) -> float:
        """The best CVaR."""

    @property
    def var(self) -> float:
        """The lower alpha-quantile of the return under the policy."""

    @property
    def mean(self) -> float:
        """The mean return of the policy."""

    @property
    def law(self) -> Law:
        """The law of the return under the policy."""

    @property
    def gamma(self) -> float:
        """Discount per step."""

    @property
    def horizon(self) -> int:
        """Time limit T in steps."""

    @property
    def one_level(self) -> bool:
        """Whether the policy needs time and state only."""

    def action(self, time: int, accumulated: float, state: int) -> int:
        """The policy's action at a time, with a discounted reward accumulated before it, in a state."""

    def table(self) -> _Integers:
        """The actions by time and state, shape ``(T, S)``; -1 where the episode has ended."""

    def __deepcopy__(self, _memo: object) -> Optimum: ...
    def worst_case(self, eta: float) -> MdpWorstCase:
        """The worst case of the policy."""

@final
class MdpWorstCase:
    """The worst that chance can do to a deterministic policy within a budget."""

    @property
    def eta(self) -> float:
        """Budget."""

    @property
    def value(self) -> float:
        """The value of the game: the CVaR of the policy at ``alpha = 1 / eta``."""

    @property
    def threshold(self) -> float:
        """The return at which the tail ends: the VaR of the policy at ``alpha = 1 / eta``."""

    @property
    def law(self) -> Law:
        """The law of the return if chance does its worst."""

    def start_ratios(self) -> _Floats:
        """The likelihood ratios of the states in which an episode may start, shape ``(S,)``; 1 in others."""

    def action(self, time: int, accumulated: float, state: int) -> int:
        """The policy's action."""

    def ratios(self, time: int, accumulated: float, state: int) -> _Floats:
        """The likelihood ratios of the outcomes of the policy's action, shape ``(K,)``."""

    def budget(self, time: int, accumulated: float, state: int) -> float:
        """The budget that is left there; infinite where the tail is out of reach."""

    def table(self) -> _Floats:
        """The likelihood ratios by time, state and outcome, shape ``(T, S, K)``."""

def program(command: Sequence[str]) -> int: ...
def scenes_of() -> list[tuple[str, str, str]]: ...
def worlds_of() -> list[str]: ...
def write_run(
    out: _Folder,
    world: World,
    judged: Judged,
    *,
    method: str,
    eta: float,
    gamma: float,
    seed: int,
    steps: int,
    seconds: float,
    clearance: float | None,
) -> Path: ...
def read_results(folder: _Folder) -> tuple[str, list[str]]: ...
