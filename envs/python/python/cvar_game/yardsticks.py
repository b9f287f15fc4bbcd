"""How good a policy is, measured against the best there is.

A yardstick takes any policy: a table of action probabilities in a finite world, which is judged exactly; or a
function of observations, which is played.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cvar_game import _core
from cvar_game._arguments import MOST_EPISODES, eta_of, number, require_room, seed_of, whole
from cvar_game.policies import chooser, features_of
from cvar_game.worlds import Opponent, World, WorstCase, as_table, core_opponent, is_nominal

if TYPE_CHECKING:
    from cvar_game.results import Run

Array = npt.NDArray[Any]

# Of the normal law, for intervals of 95 %.
QUANTILE = 1.959963984540054

# A CVaR of fewer recorded episodes in its tail is no estimate.
LEAST_TAIL = 10


@dataclass(frozen=True)
class Exact:
    """What is best in a world at a budget."""

    world: str
    """Name of the world."""
    eta: float
    """Budget."""
    alpha: float
    """Risk level 1/eta."""
    cvar: float
    """The best CVaR_alpha of the return: exact on lava-grid, that of the oracle's certified controller on
    lava-point, a lower bound of the best."""
    upper_bound: float | None
    """No policy has a CVaR_alpha above this: :attr:`cvar` on lava-grid, a bound by a relaxation on lava-point;
    ``None`` where none is known."""
    policy: npt.NDArray[np.float64] | None = field(repr=False)
    """A policy that attains it, action probabilities of shape ``(horizon, states, actions)``; ``None`` on
    lava-point."""
    details: dict[str, Any] = field(repr=False)
    """All that ``cvar-game exact --json`` says."""


@dataclass(frozen=True)
class Evaluation:
    """A policy, measured. Intervals are of 95 %; those of exact numbers have no width."""

    world: str
    """Name of the world."""
    eta: float
    """Budget."""
    alpha: float
    """Risk level 1/eta."""
    episodes: int | None
    """Played episodes; ``None`` where the law of the return is exact."""
    mean: float
    """Mean return of the greedy policy under chance itself."""
    mean_interval: tuple[float, float]
    """Its interval."""
    cvar: float
    """CVaR_alpha of its return."""
    cvar_interval: tuple[float, float]
    """Its interval."""
    var: float
    """VaR_alpha, the lower alpha-quantile of its return."""
    goal: float
    """Share of episodes that end in a goal."""
    lava: float
    """Share that ends in lava."""
    timeout: float
    """Share that reaches the time limit."""
    optimum: float | None
    """The best CVaR_alpha, see :attr:`Exact.cvar`; ``None`` where it is not known."""
    regret: float | None
    """``optimum - cvar``. Below 0 where a policy is better than lava-point's oracle."""
    regret_interval: tuple[float, float] | None
    """Its interval, of the sampling errors on both sides."""
    class_regret: float | None
    """CVaR of the best stationary policy that was found, minus ``cvar``; for tables that do not see the
    time."""
    game_value: float | None
    """Mean return against the opponent, where there is one."""
    antagonist_gap: float | None
    """``game_value - cvar``: what the opponent leaves to the worst case."""
    law: _core.Law = field(repr=False)
    """The law of the return: values, probabilities, CVaR at any level."""
    clearance: float | None
    """Mean over the played episodes of the least distance to lava (cells or metres); ``None`` where none were
    played."""
    _judged: _core.Judged = field(repr=False, compare=False)

    def __str__(self) -> str:
        kind = "exact" if self.episodes is None else f"{self.episodes:,} episodes"
        lines = [
            f"{self.world}, eta = {self.eta:g} ({kind})",
            f"  mean return      {_shown(self.mean, self.mean_interval)}",
            f"  CVaR_{self.alpha:<10.4g}  {_shown(self.cvar, self.cvar_interval)}",
        ]
        if self.regret is not None and self.regret_interval is not None:
            lines.append(f"  regret           {_shown(self.regret, self.regret_interval)}")
        if self.antagonist_gap is not None:
            lines.append(f"  antagonist's gap {self.antagonist_gap:.4f}")
        ends = f"goal {self.goal:.2%}, lava {self.lava:.2%}, time limit {self.timeout:.2%}"
        return "\n".join([*lines, f"  ends             {ends}"])


@dataclass(frozen=True)
class Exploitability:
    """How much the better deviation of one player improves on the value of the game (the paper's Definition 2)."""

    epsilon: float
    """The larger one of ``regret`` and ``response_gain``."""
    regret: float
    """What the protagonist loses to its exact worst case, against the best policy."""
    response_gain: float
    """What the best response to the antagonist gains over the optimum; an upper bound, since the response may
    see the remaining budget."""
    response_error: float
    """Estimate of the numerical error of ``response_gain``."""


def _shown(value: float, interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{value:.4f}" if low == high else f"{value:.4f} [{low:.4f}, {high:.4f}]"


def exact(
    world: World | str, eta: float, *, gamma: float = 1.0, compute: bool = False, **constants: Any
) -> Exact:
    """What is best in a world at a budget.

    Args:
        world: A world, or its name.
        eta: Budget, at least 1; alpha = 1/eta.
        gamma: Discount factor of the return.
        compute: Whether a certificate of lava-point that does not come with the package is computed: that
            takes minutes and up to 3 GB.
        constants: Constants of the world.

    Raises:
        ValueError: If nothing is known, or an argument is out of range.
    """
    world = World.of(world, constants)
    eta, gamma = eta_of(eta), number("gamma", gamma)
    details = json.loads(world._core.exact(eta, gamma, compute))
    best = details.get("optimal_cvar", details.get("certified_cvar"))
    upper_bound = details.get("upper_bound", details.get("optimal_cvar"))
    policy = world._core.optimal_policy(eta, gamma)
    return Exact(world.name, eta, 1.0 / eta, float(best), upper_bound, policy, details)


def evaluate(
    policy: Any,
    world: World | str | None = None,
    eta: float | None = None,
    *,
    gamma: float = 1.0,
    observation: str = "coordinates",
    time: bool = False,
    opponent: Opponent = None,
    episodes: int = 100_000,
    seed: int = 0,
    num_envs: int = 1_000,
    **constants: Any,
) -> Evaluation:
    """Measures a policy.

    Args:
        policy: Action probabilities in a finite world, shape ``(states, actions)`` or
            ``(horizon, states, actions)``: judged exactly, by its greedy version, which takes the likeliest
            action. Or a function from observations, shape ``(n, width)``, to actions, or an object with
            ``predict``: played. Or a trained run.
        world: A world, or its name; that of a trained run by default.
        eta: Budget, at least 1; alpha = 1/eta. That of a trained run by default.
        gamma: Discount factor of the return.
        observation, time: How a played policy sees the world, as in the environments.
        opponent: Plays against it as well, see :class:`WorstCase`.
        episodes: Episodes of each play. A CVaR needs ten in its tail: at least ``10 * eta``.
        seed: Seed of the chance that the episodes meet: policies that are played with the same seed meet
            the same.
        num_envs: Episodes that are played side by side; it matters for speed only.
        constants: Constants of the world.

    Raises:
        ValueError: If the policy does not fit the world, or an argument is out of range.
    """
    from cvar_game.results import Run

    if isinstance(policy, Run):
        run = policy
        world = World.of(run.world if world is None else world, constants)
        eta = run.eta if eta is None else eta
        observation, time = run.observation, run.time
        table = run.table()
        policy = run if table is None else table
    elif world is None or eta is None:
        raise ValueError("evaluate(policy, world, eta): give the world and the budget")
    else:
        world = World.of(world, constants)
    eta, gamma = eta_of(eta), number("gamma", gamma)
    episodes = whole("episodes", episodes, 1, MOST_EPISODES)
    is_table = not callable(policy) and not hasattr(policy, "predict")
    setting: dict[str, Any] = {
        "eta": eta,
        "gamma": gamma,
        "episodes": episodes,
        "slots": whole("num_envs", num_envs, 1, MOST_EPISODES),
        "seed": seed_of(seed),
        "features": features_of(observation),
        "time": time,
    }
    if is_table:
        setting["features"], setting["time"] = world.actions is not None and world.states is not None, True
    if not is_table or opponent is not None:
        _require_tail(eta, episodes)
        width = world._core.sight_width(setting["features"], setting["time"])
        require_room(min(setting["slots"], episodes), width)
    clearance = None
    if is_table:
        judged = world._core.judge_table(as_table(policy), eta, gamma, None)
        played = _of_table(as_table(policy), world)
    else:
        played = chooser(policy, world)
        law, _, least = world._core.play(played, opponent=None, **setting)
        clearance = float(least.mean()) if np.isfinite(least).all() else None
        judged = world._core.judge_law(law, eta, gamma)
    game_value = None
    if opponent is not None:
        law, _, _ = world._core.play(played, opponent=core_opponent(opponent), **setting)
        game_value = law.mean()
    return _evaluation(world, eta, judged, game_value, clearance)


def _of_table(table: Array, world: World) -> Any:
    """The greedy version of a table, as a function of features with the time."""

    def choose(observations: Array) -> npt.NDArray[np.int64]:
        states = world.states or 0
        cells = observations[:, :states].argmax(axis=1)
        if table.ndim == 2:
            return np.asarray(table[cells].argmax(axis=1), dtype=np.int64)
        share = (observations[:, states] + 1.0) / 2.0
        times = np.rint(share * world.horizon).astype(np.int64).clip(0, world.horizon - 1)
        return np.asarray(table[times, cells].argmax(axis=1), dtype=np.int64)

    return choose


def _require_tail(eta: float, episodes: int) -> None:
    least = math.ceil(LEAST_TAIL * min(eta, 1e300))
    if episodes < least:
        raise ValueError(
            f"episodes = {episodes} leaves fewer than {LEAST_TAIL} in the tail of CVaR at eta = {eta:g}; "
            f"use at least {least}"
        )


def _evaluation(
    world: World,
    eta: float,
    judged: _core.Judged,
    game_value: float | None,
    clearance: float | None,
) -> Evaluation:
    law, alpha = judged.law, 1.0 / eta
    mean, cvar = law.mean(), law.cvar(alpha)
    ends = [float(law.probabilities[law.ends == end].sum()) for end in (1, 2, 3)]
    regret, error = judged.regret, judged.regret_standard_error
    interval = None if regret is None or error is None else _interval(regret, error)
    return Evaluation(
        world=world.name,
        eta=eta,
        alpha=alpha,
        episodes=law.episodes,
        mean=mean,
        mean_interval=_interval(mean, law.mean_standard_error()),
        cvar=cvar,
        cvar_interval=_interval(cvar, law.cvar_standard_error(alpha)),
        var=law.var(alpha),
        goal=ends[0],
        lava=ends[1],
        timeout=ends[2],
        optimum=judged.optimum,
        regret=regret,
        regret_interval=interval,
        class_regret=judged.class_regret,
        game_value=game_value,
        antagonist_gap=None if game_value is None else game_value - cvar,
        law=law,
        clearance=clearance,
        _judged=judged,
    )


def _interval(value: float, error: float) -> tuple[float, float]:
    return value - QUANTILE * error, value + QUANTILE * error


def regret(policy: Any, world: World | str, eta: float, **options: Any) -> float:
    """The best CVaR_{1/eta} there is, or is certified, minus that of the policy; see :func:`evaluate`.

    Raises:
        ValueError: If no optimum is known at this budget.
    """
    found = evaluate(policy, world, eta, **options).regret
    if found is None:
        name = world if isinstance(world, str) else world.name
        raise ValueError(f"no optimum of {name} is known at eta = {eta:g} with these constants")
    return found


def worst_case(
    policy: Any, world: World | str, eta: float, *, gamma: float = 1.0, **constants: Any
) -> tuple[float, npt.NDArray[np.float64]]:
    """The exact worst case of a policy in a finite world.

    Args:
        policy: Action probabilities; its greedy version is meant.

    Returns:
        The least mean return that any antagonist within the budget can bring about, which is the greedy
        policy's CVaR_{1/eta}; and the likelihood ratios that do so, by time, state and outcome, after the
        policy's action, shape ``(horizon, states, outcomes)``. Their mean under the nominal law is 1.
    """
    world = World.of(world, constants)
    table, eta, gamma = as_table(policy), eta_of(eta), number("gamma", gamma)
    ratios = world._core.worst_case(table, eta, gamma)
    return world._core.judge_table(table, eta, gamma, None).law.cvar(1.0 / eta), ratios


def exploitability(
    protagonist: Any,
    antagonist: Opponent,
    world: World | str | None = None,
    eta: float | None = None,
    *,
    gamma: float = 1.0,
    **constants: Any,
) -> Exploitability:
    """How far a pair is from an equilibrium, in a finite world.

    Args:
        protagonist: Action probabilities, or a trained run.
        antagonist: A trained run, or the worst case of a policy.
        world, eta: By default those of a trained protagonist.
    """
    from cvar_game.results import Run

    if isinstance(protagonist, Run):
        world = World.of(protagonist.world if world is None else world, constants)
        eta = protagonist.eta if eta is None else eta
        protagonist = protagonist.table()
    elif world is None or eta is None:
        raise ValueError("exploitability(protagonist, antagonist, world, eta): give world and budget")
    else:
        world = World.of(world, constants)
    if protagonist is None:
        raise ValueError(f"the exploitability in {world.name} is not known: it has no finite states")
    if is_nominal(antagonist):
        raise ValueError("give an antagonist: a trained run, or the worst case of a policy")
    eta, gamma = eta_of(eta), number("gamma", gamma)
    opponent = core_opponent(antagonist)
    judged = world._core.judge_table(as_table(protagonist), eta, gamma, opponent)
    if judged.regret is None or judged.exploitability is None:
        raise ValueError("the best response to this antagonist is not known")
    gain, error = judged.response_gain, judged.response_error
    assert gain is not None and error is not None
    return Exploitability(judged.exploitability, judged.regret, gain, error)


__all__ = [
    "Evaluation",
    "Exact",
    "Exploitability",
    "WorstCase",
    "evaluate",
    "exact",
    "exploitability",
    "regret",
    "worst_case",
]
