"""FiniteMDP against answers that owe nothing to it: value iteration, closed forms, and the enumeration of all
policies of small MDPs."""

from __future__ import annotations

import copy
import itertools
import pickle
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cvar_game.mdp
from cvar_game.mdp import BudgetedAntagonist, FiniteMDP, Player, Stationary, admissible

Floats = npt.NDArray[np.float64]
Row = tuple[int, int, int, float, float]
Law = tuple[tuple[float, float], ...]
"""Pairs of return and probability."""

TOY = [
    ("FrozenLake", {}, None),
    ("FrozenLake8x8", {}, None),
    ("FrozenLake", {"is_slippery": False}, None),
    ("CliffWalking", {}, 60),
    ("CliffWalkingSlippery", {}, 100),
    ("Taxi", {}, 20),
    ("Taxi", {"is_rainy": True}, 20),
]


def toy(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """The newest version of an environment."""
    if name == "CliffWalkingSlippery":
        name, options = "CliffWalking", {**options, "is_slippery": True}
    versions = [spec.version or 0 for spec in gymnasium.registry.values() if spec.name == name]
    try:
        return gymnasium.make(f"{name}-v{max(versions)}", **options)
    except TypeError:
        pytest.skip(f"this Gymnasium has no {name} with {options}")


# Independent truth.


def value_iteration(env: Any, horizon: int, gamma: float) -> float:
    """The best mean return of an environment, averaged over its starts."""
    table = env.unwrapped.P
    value = np.zeros(len(table))
    for _ in range(horizon):
        value = np.array(
            [
                max(
                    sum(p * (r + gamma * value[s] * (not done)) for p, s, r, done in outcomes)
                    for outcomes in actions.values()
                )
                for actions in (table[state] for state in range(len(table)))
            ]
        )
    return float(env.unwrapped.initial_state_distrib @ value)


def cvar(law: Law, alpha: float) -> float:
    """The mean of the worst share alpha."""
    rest, total = alpha, 0.0
    for value, probability in sorted(law):
        share = min(probability, rest)
        total += share * value
        rest -= share
    return (total + rest * max(law)[0]) / alpha


def mixed(parts: list[tuple[float, Law]]) -> Law:
    atoms: dict[float, float] = {}
    for weight, law in parts:
        for value, probability in law:
            atoms[value] = atoms.get(value, 0.0) + weight * probability
    return tuple(sorted(atoms.items()))


class Small:
    """A small MDP as a plain tree."""

    def __init__(self, rows: list[Row], horizon: int, gamma: float, start: int | list[float]) -> None:
        self.rows, self.horizon, self.gamma, self.start = rows, horizon, gamma, start
        self.states = 1 + max(max(row[0], row[2]) for row in rows)
        if not isinstance(start, int):
            self.states = max(self.states, len(start))
        self.actions: dict[int, dict[int, list[Row]]] = {}
        for row in rows:
            self.actions.setdefault(row[0], {}).setdefault(row[1], []).append(row)

    def mdp(self) -> FiniteMDP:
        return FiniteMDP(self.rows, horizon=self.horizon, gamma=self.gamma, start=self.start)

    def starts(self) -> list[tuple[float, int]]:
        if isinstance(self.start, int):
            return [(1.0, self.start)]
        return [(p, state) for state, p in enumerate(self.start) if p > 0.0]

    def over(self, time: int, state: int) -> bool:
        return time == self.horizon or state not in self.actions

    def laws(self, time: int, state: int, so_far: float) -> set[Law]:
        """The laws of the return of all deterministic policies that know the history."""
        if self.over(time, state):
            return {((so_far, 1.0),)}
        found: set[Law] = set()
        for outcomes in self.actions[state].values():
            after = [
                self.laws(time + 1, row[2], so_far + self.gamma**time * row[4]) for row in outcomes
            ]
            for chosen in itertools.product(*after):
                found.add(mixed([(row[3], law) for row, law in zip(outcomes, chosen, strict=True)]))
        return found

    def best(self, alpha: float) -> float:
        per_start = [self.laws(0, state, 0.0) for _, state in self.starts()]
        weights = [p for p, _ in self.starts()]
        laws = (
            mixed(list(zip(weights, chosen, strict=True)))
            for chosen in itertools.product(*per_start)
        )
        return max(cvar(law, alpha) for law in laws)

    def law(
        self,
        policy: Callable[[int, float, int], Floats],
        ratios: Callable[[int, float, int], Floats] | None = None,
        start_ratios: Floats | None = None,
    ) -> tuple[Law, float]:
        """The law of the return of a policy against an antagonist, and the largest product of ratios.

        ``ratios`` are those of the action, in the order of next states (-1 first) and rewards.
        """
        atoms: dict[float, float] = {}
        largest = 0.0

        def walk(time: int, state: int, so_far: float, mass: float, product: float) -> None:
            nonlocal largest
            if self.over(time, state):
                atoms[so_far] = atoms.get(so_far, 0.0) + mass
                largest = max(largest, product)
                return
            for action, chance in enumerate(policy(time, so_far, state)):
                if chance == 0.0:
                    continue
                outcomes = self.actions[state][action]
                kinds = sorted({(row[2], row[4]) for row in outcomes})
                delta = np.ones(len(kinds)) if ratios is None else ratios(time, so_far, state)
                assert delta.shape == (len(kinds),)
                law = [sum(row[3] for row in outcomes if (row[2], row[4]) == of) for of in kinds]
                assert abs(law @ delta - 1.0) < 1e-9
                for (following, reward), p, ratio in zip(kinds, law, delta, strict=True):
                    if ratio > 0.0:
                        after = so_far + self.gamma**time * reward
                        walk(time + 1, following, after, mass * chance * p * ratio, product * ratio)

        for p, state in self.starts():
            ratio = 1.0 if start_ratios is None else float(start_ratios[state])
            if ratio > 0.0:
                walk(0, state, 0.0, p * ratio, ratio)
        return tuple(sorted(atoms.items())), largest


def chow(small: Small, alpha: float) -> float:
    """The budget-augmented programme, with convex functions y V(y) as sorted lists of (slope, length)."""

    Segments = list[tuple[float, float]]

    def value(segments: Segments, y: float) -> float:
        total = 0.0
        for slope, length in segments:
            step = min(length, y)
            total, y = total + slope * step, y - step
        return total

    def upper(one: Segments, other: Segments) -> Segments:
        ys = {0.0, 1.0}
        for segments in (one, other):
            ys |= set(np.minimum(np.cumsum([length for _, length in segments]), 1.0))
        points = sorted(ys)
        for left, right in itertools.pairwise(points):
            before = value(one, left) - value(other, left)
            after = value(one, right) - value(other, right)
            if before * after < 0.0:
                ys.add(left + (right - left) * before / (before - after))
        points = sorted(ys)
        highest = [max(value(one, y), value(other, y)) for y in points]
        return [
            ((highest[i + 1] - highest[i]) / (points[i + 1] - points[i]), points[i + 1] - points[i])
            for i in range(len(points) - 1)
            if points[i + 1] - points[i] > 1e-15
        ]

    def mixture(parts: list[tuple[float, Segments]]) -> Segments:
        return sorted((slope, p * length) for p, segments in parts for slope, length in segments)

    def solve(time: int, state: int, so_far: float) -> Segments:
        if small.over(time, state):
            return [(so_far, 1.0)]
        best: Segments | None = None
        for outcomes in small.actions[state].values():
            after = mixture(
                [
                    (row[3], solve(time + 1, row[2], so_far + small.gamma**time * row[4]))
                    for row in outcomes
                ]
            )
            best = after if best is None else upper(best, after)
        assert best is not None
        return best

    start = mixture([(p, solve(0, state, 0.0)) for p, state in small.starts()])
    return value(start, alpha) / alpha


def random_small(seed: int, *, distribution: bool) -> Small:
    """Three states with one to three actions each, and two outcomes per action."""
    random = np.random.default_rng(seed)
    rows: list[Row] = []
    for state in range(3):
        for action in range(int(random.integers(1, 3 if distribution else 4))):
            p = float(random.choice([0.1, 0.25, 0.5, random.random()]))
            for chance in (p, 1.0 - p):
                following = int(random.choice([-1, 0, 1, 2, 3], p=[0.1, 0.25, 0.3, 0.25, 0.1]))
                reward = float(random.choice([-1.0, 0.0, 0.5, 1.0, random.normal()]))
                rows.append((state, action, following, chance, reward))
    gamma = float(random.choice([1.0, 0.9, 0.5]))
    start: int | list[float] = 0
    if distribution:
        first = float(random.choice([0.5, 0.2, random.random()]))
        start = [first, 1.0 - first, 0.0, 0.0]
    return Small(rows, 3, gamma, start)


# The best CVaR.


@pytest.mark.parametrize(("name", "options", "horizon"), TOY)
@pytest.mark.parametrize("gamma", [1.0, 0.97])
def test_the_risk_neutral_optimum_is_that_of_value_iteration(
    name: str, options: dict[str, Any], horizon: int | None, gamma: float
) -> None:
    if gamma < 1.0 and horizon is not None:
        horizon = 8  # sums of discounted rewards hardly ever meet
    env = toy(name, **options)
    mdp = FiniteMDP.from_env(env, horizon, gamma)
    assert mdp.states == env.observation_space.n  # type: ignore[attr-defined]
    assert mdp.actions == env.action_space.n  # type: ignore[attr-defined]
    best = mdp.optimum(1.0)
    truth = value_iteration(env, mdp.horizon, gamma)
    assert best.cvar == pytest.approx(truth, abs=1e-9)
    assert best.mean == pytest.approx(truth, abs=1e-9)
    assert best.law.steps.max() <= mdp.horizon


@pytest.mark.parametrize("name", ["FrozenLake", "FrozenLake8x8", "CliffWalkingSlippery"])
def test_a_written_table_is_the_same_process(name: str, tmp_path: Path) -> None:
    mdp = FiniteMDP.from_env(toy(name), 100)
    mdp.to_csv(tmp_path / "mdp.csv")
    start = int(np.flatnonzero(mdp.start)[0])
    again = FiniteMDP.from_csv(tmp_path / "mdp.csv", horizon=100, start=start)
    for alpha in (1.0, 0.1):
        assert again.optimum(alpha).cvar == pytest.approx(mdp.optimum(alpha).cvar, abs=1e-12)


def test_the_lake_of_the_repository_is_that_of_gymnasium(tmp_path: Path) -> None:
    committed = Path(__file__).parents[3] / "tests" / "data" / "frozen-lake-8x8.csv"
    if not committed.exists():
        pytest.skip("not in the repository")
    FiniteMDP.from_env(toy("FrozenLake8x8"), 200).to_csv(tmp_path / "mdp.csv")
    read = [np.loadtxt(path, delimiter=",", skiprows=1) for path in (committed, tmp_path / "mdp.csv")]
    np.testing.assert_allclose(read[0], read[1], atol=1e-12)


def test_a_table_with_several_starts_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="start in 2 states"):
        rows = [(0, 0, -1, 1.0, 1.0), (1, 0, -1, 1.0, 0.0)]
        FiniteMDP(rows, horizon=1, start=[0.5, 0.5]).to_csv(tmp_path / "mdp.csv")
    assert not (tmp_path / "mdp.csv").exists()


@pytest.mark.parametrize("name", ["FrozenLake", "FrozenLake8x8"])
@pytest.mark.parametrize("alpha", [0.9, 0.3, 0.1, 0.05])
def test_a_return_of_success_or_failure_has_a_closed_form(name: str, alpha: float) -> None:
    env = toy(name)
    mdp = FiniteMDP.from_env(env)
    success = value_iteration(env, mdp.horizon, 1.0)
    truth = max(0.0, 1.0 - (1.0 - success) / alpha)
    best = mdp.optimum(alpha)
    assert best.cvar == pytest.approx(truth, abs=1e-9)
    assert mdp.chow(1.0 / alpha) == pytest.approx(truth, abs=1e-9)
    assert mdp.one_level
    law = mdp.evaluate(best.table())
    assert law.cvar(alpha) == pytest.approx(truth, abs=1e-9)
    assert law.mean() == pytest.approx(best.mean, abs=1e-12)


def test_slippery_cliff_is_that_of_a_programme_over_time_falls_and_state() -> None:
    horizon = 24
    env = toy("CliffWalkingSlippery")
    table: dict[int, dict[int, list[Any]]] = env.unwrapped.P  # type: ignore[attr-defined]
    # R = -(t + 99 falls)
    nexts = np.zeros((48, 4, 3), np.int64)
    p, falls, over = np.zeros((3, 48, 4, 3))
    for state, action, k in itertools.product(range(48), range(4), range(3)):
        p[state, action, k], nexts[state, action, k], reward, done = table[state][action][k]
        falls[state, action, k], over[state, action, k] = reward == -100, done
    counts = np.arange(horizon + 2)
    fallen = (counts[:-1, None, None, None] + falls).astype(int)

    def shortfall(w: float) -> float:
        """Least expectation of (w - J)^+, from the start."""
        after = np.repeat(np.maximum(w + horizon + 99 * counts, 0.0)[:, None], 48, axis=1)
        for time in reversed(range(horizon)):
            ended = np.maximum(w + time + 1 + 99 * fallen, 0.0)
            ahead = np.where(over == 1.0, ended, after[fallen, nexts])
            after[:-1] = (p * ahead).sum(-1).min(-1)
        return float(after[0, 36])

    returns = {-(t + 99 * k) for t in range(1, horizon + 1) for k in range(t + 1)}
    shortfalls = {w: shortfall(w) for w in returns}
    mdp = FiniteMDP.from_env(env, horizon)
    for alpha in (1.0, 0.6, 0.2, 0.03):
        truth = max(w - least / alpha for w, least in shortfalls.items())
        assert mdp.optimum(alpha).cvar == pytest.approx(truth, abs=1e-9)


@pytest.mark.parametrize("alpha", [1.0, 0.5, 0.1, 0.013, 0.001])
def test_a_start_distribution_is_chance(alpha: float) -> None:
    # Without rain nothing but the start is random, and one policy is best from all starts.
    env = toy("Taxi")
    horizon = 20
    mdp = FiniteMDP.from_env(env, horizon)
    table, first = env.unwrapped.P, env.unwrapped.initial_state_distrib  # type: ignore[attr-defined]
    value = np.zeros(500)
    for _ in range(horizon):
        value = np.array(
            [
                max(r + value[s] * (not done) for [(_, s, r, done)] in table[state].values())
                for state in range(500)
            ]
        )
    law = tuple((float(v), float(p)) for v, p in zip(value, first, strict=True) if p > 0.0)
    best = mdp.optimum(alpha)
    assert best.cvar == pytest.approx(cvar(law, alpha), abs=1e-9)
    assert best.mean == pytest.approx(float(first @ value), abs=1e-9)
    assert mdp.chow(1.0 / alpha) == pytest.approx(cvar(law, alpha), abs=1e-9)
    assert mdp.start == pytest.approx(first)


@pytest.mark.parametrize("distribution", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_no_policy_with_memory_is_better(seed: int, distribution: bool) -> None:
    small = random_small(seed, distribution=distribution)
    mdp = small.mdp()
    for alpha in (1.0, 0.7, 0.3, 0.11, 0.02):
        best = mdp.optimum(alpha)
        assert best.cvar == pytest.approx(small.best(alpha), abs=1e-9)
        law, _ = small.law(lambda *node: np.eye(4)[best.action(*node)])  # noqa: B023
        assert cvar(law, alpha) == pytest.approx(best.cvar, abs=1e-9)
        assert best.law.cvar(alpha) == pytest.approx(best.cvar, abs=1e-12)
        assert best.law.var(alpha) == best.var
        assert best.mean == pytest.approx(sum(v * p for v, p in law), abs=1e-9)


@pytest.mark.parametrize("distribution", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_budget_augmented_programme(seed: int, distribution: bool) -> None:
    small = random_small(seed, distribution=distribution)
    mdp = small.mdp()
    for eta in (1.0, 1.5, 4.0, 30.0):
        assert mdp.chow(eta) == pytest.approx(chow(small, 1.0 / eta), abs=1e-9)
        assert mdp.chow(eta) >= mdp.optimum(1.0 / eta).cvar - 1e-9


def test_the_budget_augmented_programme_overestimates() -> None:
    # A start leads to two states. In one the policy chooses between a sure and an uncertain reward.
    rows = [
        (0, 0, 1, 0.5, 0.0), (0, 0, 2, 0.5, 0.0),
        (1, 0, -1, 1.0, 0.0), (1, 1, -1, 0.5, 1.0), (1, 1, -1, 0.5, -0.5),
        (2, 0, -1, 1.0, 0.5),
    ]  # fmt: skip
    small = Small(rows, 2, 1.0, 0)
    mdp = small.mdp()
    gaps = [mdp.chow(1.0 / alpha) - mdp.optimum(alpha).cvar for alpha in (0.3, 0.5, 0.6, 0.8)]
    assert max(gaps) > 0.01
    for alpha in (0.3, 0.5, 0.6, 0.8):
        assert mdp.chow(1.0 / alpha) == pytest.approx(chow(small, alpha), abs=1e-12)


# Policies.


def random_policy(small: Small, mdp: FiniteMDP, random: np.random.Generator, timed: bool) -> Floats:
    policy = np.zeros((small.horizon, mdp.states, mdp.actions))
    for time, state in itertools.product(range(small.horizon), range(mdp.states)):
        count = mdp.action_count(state)
        policy[time, state, :count] = random.dirichlet(np.ones(count)) if count else 0.0
    return policy if timed else policy[0]


@pytest.mark.parametrize("distribution", [False, True])
@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_policies_are_evaluated_exactly(seed: int, timed: bool, distribution: bool) -> None:
    small = random_small(seed, distribution=distribution)
    mdp = small.mdp()
    policy = random_policy(small, mdp, np.random.default_rng(seed), timed)
    law = mdp.evaluate(policy)
    rows = policy if timed else np.broadcast_to(policy, (small.horizon, *policy.shape))
    truth, _ = small.law(lambda time, _, state: rows[time, state])
    assert law.mean() == pytest.approx(sum(v * p for v, p in truth), abs=1e-9)
    for alpha in (0.5, 0.1):
        assert law.cvar(alpha) == pytest.approx(cvar(truth, alpha), abs=1e-9)
    assert law.probabilities.sum() == pytest.approx(1.0)
    assert law.steps.min() >= 1 and law.steps.max() <= small.horizon
    chosen = policy.argmax(-1)
    greedy = np.eye(mdp.actions)[chosen]
    assert mdp.evaluate(chosen).cvar(0.3) == mdp.evaluate(greedy).cvar(0.3)


@pytest.mark.parametrize("distribution", [False, True])
@pytest.mark.parametrize("kind", ["stationary", "timed", "optimum"])
@pytest.mark.parametrize("seed", range(8))
def test_the_worst_case_attains_the_cvar_within_the_budget(
    seed: int, kind: str, distribution: bool
) -> None:
    small = random_small(seed, distribution=distribution)
    mdp = small.mdp()
    for eta in (1.0, 1.7, 6.0, 100.0):
        policy: Any = mdp.optimum(0.3)
        if kind != "optimum":
            policy = random_policy(small, mdp, np.random.default_rng(seed), kind == "timed")
        worst = mdp.worst_case(policy, eta)
        nominal = policy.law if kind == "optimum" else mdp.evaluate(policy.argmax(-1))
        assert worst.value == pytest.approx(nominal.cvar(1.0 / eta), abs=1e-9)
        assert worst.threshold == pytest.approx(nominal.var(1.0 / eta), abs=1e-12)
        assert worst.law.mean() == pytest.approx(worst.value, abs=1e-9)
        law, largest = small.law(
            lambda *node: np.eye(mdp.actions)[worst.action(*node)],  # noqa: B023
            worst.ratios,
            worst.start_ratios(),
        )
        assert sum(p for _, p in law) == pytest.approx(1.0, abs=1e-9)
        assert sum(v * p for v, p in law) == pytest.approx(worst.value, abs=1e-9)
        assert largest <= eta * (1.0 + 1e-9)


def test_sums_that_differ_by_rounding_are_one_level() -> None:
    # 0.1 + 0.2 + 0.3 has two values, by the order, and so had J = 0.6: where the tail ends there, the antagonist
    # was that of one of them and met the other.
    rows = [(s, a, s, 1.0 / 3.0, r) for s in range(2) for a in range(2) for r in (0.1, 0.2, 0.3)]
    starts: list[int | list[float]] = [0, [0.5, 0.5]]
    for start in starts:
        small = Small(rows, 3, 1.0, start)
        mdp = small.mdp()
        assert np.diff(mdp.levels(2)).min() > 0.05 and len(mdp.levels(2)) == 5
        for eta in (1.2, 1.7, 2.0, 5.0):
            best = mdp.optimum(1.0 / eta)
            worst = mdp.worst_case(best, eta)
            law, largest = small.law(
                lambda *node: np.eye(2)[worst.action(*node)],  # noqa: B023
                worst.ratios,
                worst.start_ratios(),
            )
            assert sum(v * p for v, p in law) == pytest.approx(best.cvar, abs=1e-9)
            assert largest <= eta * (1.0 + 1e-9)


def test_a_tail_that_is_almost_impossible() -> None:
    # Its probability has no finite reciprocal.
    rows = [(0, 0, -1, 2.3e-309, -1.0), (0, 0, -1, 1.0, 0.0), (1, 0, -1, 1.0, -1.0)]
    mdp = FiniteMDP(rows, horizon=1, start=[0.5, 0.5])
    worst = mdp.worst_case([0, 0], 2.0)
    assert worst.value == worst.law.mean() == -1.0
    assert np.isfinite(worst.ratios(0, 0.0, 0)).all()


def test_tables_of_one_level() -> None:
    env = toy("FrozenLake")
    mdp = FiniteMDP.from_env(env, 15)
    best = mdp.optimum(0.4)
    table = best.table()
    assert table.shape == (15, 16) and table.min() >= 0
    worst = mdp.worst_case(table, 2.0)
    ratios = worst.table()
    assert ratios.shape == (15, 16, 3)
    for time, state in itertools.product((0, 3, 14), range(16)):
        assert table[time, state] == best.action(time, 0.0, state)
        _, law, _ = mdp.outcomes(state, int(table[time, state]))
        assert ratios[time, state, : len(law)] == pytest.approx(worst.ratios(time, 0.0, state))
        assert ratios[time, state, : len(law)] @ law == pytest.approx(1.0)
        assert worst.ratios(time, 0.0, state).max() <= worst.budget(time, 0.0, state) * (1 + 1e-12)


def test_levels_are_those_that_can_be_reached() -> None:
    mdp = FiniteMDP.from_env(toy("Taxi"), 6)
    assert mdp.levels(0).tolist() == [0.0]
    assert mdp.levels(2).tolist() == [-20.0, -11.0, -2.0]
    assert not mdp.one_level
    best = mdp.optimum(0.1)
    assert best.action(2, -11.0 + 1e-9, 0) == best.action(2, -11.0, 0)
    with pytest.raises(ValueError, match="no episode has accumulated -10"):
        best.action(2, -10.0, 0)
    with pytest.raises(ValueError, match="no table by time and state"):
        best.table()


def test_a_start_distribution_keeps_one_level() -> None:
    rows = [(s, a, (s + 1 + a) % 3, 1.0, -0.1) for s in range(3) for a in range(2)]
    rows += [(3, 0, -1, 1.0, 1.0), (0, 2, 3, 0.5, -0.1), (0, 2, 1, 0.5, -0.1)]
    mdp = FiniteMDP(rows, horizon=5, gamma=0.9, start=[0.2, 0.3, 0.5, 0.0])
    assert mdp.one_level
    best = mdp.optimum(0.2)
    assert best.table().shape == (5, 4)
    assert mdp.evaluate(best.table()).cvar(0.2) == pytest.approx(best.cvar, abs=1e-12)


@pytest.mark.parametrize("seed", range(10))
def test_the_stationary_policy_is_a_local_optimum(seed: int) -> None:
    small = random_small(seed, distribution=seed % 2 == 1)
    mdp = small.mdp()
    for alpha in (1.0, 0.4, 0.1):
        found = mdp.best_stationary(alpha)
        assert isinstance(found, Stationary) and found.local_optimum
        assert found.actions[3] == -1 if mdp.states > 3 else True
        assert mdp.evaluate(found).cvar(alpha) == pytest.approx(found.cvar, abs=1e-12)
        assert found.cvar == found.law.cvar(alpha) <= mdp.optimum(alpha).cvar + 1e-12
        counts = [max(1, mdp.action_count(state)) for state in range(mdp.states)]
        all_of = {
            chosen: mdp.evaluate(np.array(chosen)).cvar(alpha)
            for chosen in itertools.product(*map(range, counts))
        }
        near = [c for c in all_of if (np.array(c) != np.maximum(found.actions, 0)).sum() <= 1]
        assert max(all_of[c] for c in near) <= found.cvar + 2e-9
        # Of so few policies the search finds the best.
        assert found.cvar == pytest.approx(max(all_of.values()), abs=1e-8)


def test_a_player_plays_the_optimum() -> None:
    env = toy("CliffWalkingSlippery", max_episode_steps=25)
    best = FiniteMDP.from_env(env).optimum(0.5)
    player, returns = Player(best), []
    state, _ = env.reset(seed=1)
    for _ in range(400):
        player.reset()
        total, over = 0.0, False
        while not over:
            state, reward, terminated, truncated, _ = env.step(player.act(state))
            player.observe(float(reward))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
        state, _ = env.reset()
    error = np.std(returns) / np.sqrt(len(returns))
    assert abs(np.mean(returns) - best.mean) <= 4.0 * error
    with pytest.raises(ValueError, match="time = 25"):
        best.action(25, -25.0, 36)


# Random MDPs.


@st.composite
def smalls(draw: st.DrawFn) -> Small:
    states = draw(st.integers(1, 3))
    reward = st.sampled_from([-1.0, 0.0, 0.25, 1.0]) | st.floats(-100.0, 100.0)
    rows: list[Row] = []
    for state in range(states):
        for action in range(draw(st.integers(1, 2))):
            p = draw(st.sampled_from([0.0, 0.5, 1.0 / 3.0]) | st.floats(0.0, 1.0))
            for chance in (p, 1.0 - p):
                following = draw(st.integers(-1, states))
                rows.append((state, action, following, chance, draw(reward)))
    horizon = draw(st.integers(1, 3))
    start: int | list[float] = draw(st.integers(0, states - 1))
    if states > 1 and draw(st.booleans()):
        p = draw(st.sampled_from([0.5, 0.1]) | st.floats(0.01, 0.99))
        start = [p, 1.0 - p] + [0.0] * (states - 1)
    return Small(rows, horizon, draw(st.sampled_from([1.0, 0.5, 0.9]) | st.floats(0.1, 1.0)), start)


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(small=smalls(), alpha=st.sampled_from([1.0, 0.5, 0.1]) | st.floats(0.01, 1.0))
def test_random_mdps(small: Small, alpha: float) -> None:
    mdp = small.mdp()
    best = mdp.optimum(alpha)
    # Returns are at most 300, and errors of CVaR those of J over alpha.
    assert best.cvar == pytest.approx(small.best(alpha), abs=1e-9)
    assert mdp.chow(1.0 / alpha) == pytest.approx(chow(small, alpha), abs=1e-8)
    worst = mdp.worst_case(best, 1.0 / alpha)
    assert worst.value == pytest.approx(best.cvar, abs=1e-9)
    assert worst.law.mean() == pytest.approx(best.cvar, abs=1e-9)
    found = mdp.best_stationary(alpha)
    assert found.cvar <= best.cvar + 1e-9
    assert mdp.evaluate(found).cvar(alpha) == pytest.approx(found.cvar, abs=1e-9)


# Input.


def test_rows_in_any_order_and_repeated_ones_make_the_same() -> None:
    rows = [(0, 1, 1, 0.25, 1.0), (0, 0, -1, 1.0, 0.3), (0, 1, 1, 0.25, 1.0), (0, 1, 0, 0.5, 0.0)]
    one = FiniteMDP(rows, horizon=3)
    other = FiniteMDP(np.array(rows)[::-1], horizon=np.int64(3))  # type: ignore[arg-type]
    third = FiniteMDP((row for row in rows), horizon=3, states=2)
    for mdp in (one, other, third):
        following, probabilities, rewards = mdp.outcomes(0, 1)
        assert following.tolist() == [0, 1] and rewards.tolist() == [0.0, 1.0]
        assert probabilities.tolist() == [0.5, 0.5]
        assert (mdp.states, mdp.actions, mdp.action_count(1)) == (2, 2, 0)
        assert mdp.optimum(0.4).cvar == one.optimum(0.4).cvar


def test_rounded_decimals_are_normalised() -> None:
    mdp = FiniteMDP([(0, 0, -1, 0.3333333, float(k)) for k in range(3)], horizon=1)
    assert mdp.optimum(1.0).cvar == pytest.approx(1.0, abs=1e-15)


def test_an_mdp_without_a_second_step() -> None:
    mdp = FiniteMDP([(0, 0, -1, 1.0, 2.0)], horizon=4)
    assert mdp.levels(1).tolist() == []
    assert mdp.optimum(0.5).table().tolist() == [[0]] * 4
    assert mdp.worst_case([0], 2.0).table().shape == (4, 1, 1)
    assert mdp.chow(2.0) == mdp.best_stationary(0.5).cvar == 2.0
    with pytest.raises(ValueError, match="no episode lasts until time 1"):
        mdp.optimum(0.5).action(1, 2.0, 0)


def test_copies_and_pickles() -> None:
    mdp = random_small(3, distribution=True).mdp()
    again = pickle.loads(pickle.dumps(mdp))
    assert copy.deepcopy(mdp) is mdp
    assert again.optimum(0.2).cvar == mdp.optimum(0.2).cvar
    assert repr(again) == repr(mdp)


OK = [(0, 0, 1, 1.0, 0.0), (0, 1, -1, 1.0, 1.0), (1, 0, 0, 0.5, -1.0), (1, 0, -1, 0.5, 0.0)]


def changed(row: int, column: int, value: float) -> list[list[float]]:
    rows = [list(map(float, of)) for of in OK]
    rows[row][column] = value
    return rows


BAD_MDPS: list[tuple[str, Callable[[], object]]] = [
    ("no transitions", lambda: FiniteMDP([], horizon=1)),
    ("shape", lambda: FiniteMDP([(0, 0, 1, 1.0)], horizon=1)),
    ("five numbers", lambda: FiniteMDP([(0, 0, 1, 1.0, 0.0), (0, 1)], horizon=1)),
    ("five numbers", lambda: FiniteMDP("nonsense", horizon=1)),
    ("five numbers", lambda: FiniteMDP(3.0, horizon=1)),
    ("transition 1: state", lambda: FiniteMDP(changed(1, 0, 0.5), horizon=1)),
    ("transition 0: state = -1", lambda: FiniteMDP(changed(0, 0, -1), horizon=1)),
    ("transition 0: next = -2", lambda: FiniteMDP(changed(0, 2, -2), horizon=1)),
    ("transition 0: next", lambda: FiniteMDP(changed(0, 2, 1e300), horizon=1)),
    ("transition 0: next", lambda: FiniteMDP(changed(0, 2, np.nan), horizon=1)),
    ("transition 0: next = 2", lambda: FiniteMDP(changed(0, 2, 2), horizon=1, states=2)),
    ("transition 3: probability = NaN", lambda: FiniteMDP(changed(3, 3, np.nan), horizon=1)),
    ("transition 3: probability = -0.5", lambda: FiniteMDP(changed(3, 3, -0.5), horizon=1)),
    ("transition 3: reward = inf", lambda: FiniteMDP(changed(3, 4, np.inf), horizon=1)),
    ("transition 3: reward", lambda: FiniteMDP(changed(3, 4, 1e200), horizon=1)),
    ("action 0 in state 1 sum to 0.9", lambda: FiniteMDP(changed(3, 3, 0.4), horizon=1)),
    ("no action 1", lambda: FiniteMDP(changed(1, 1, 2), horizon=1)),
    ("action 9 but no action 1", lambda: FiniteMDP(changed(1, 1, 9), horizon=1)),
    ("transition 1: action = -1", lambda: FiniteMDP(changed(1, 1, -1), horizon=1)),
    ("horizon = 0", lambda: FiniteMDP(OK, horizon=0)),
    ("horizon = 2.5", lambda: FiniteMDP(OK, horizon=2.5)),  # type: ignore[arg-type]
    ("horizon", lambda: FiniteMDP(OK, horizon=10**30)),
    ("too large", lambda: FiniteMDP(OK, horizon=5_000_000)),
    ("gamma = 0", lambda: FiniteMDP(OK, horizon=1, gamma=0.0)),
    ("gamma = 1.5", lambda: FiniteMDP(OK, horizon=1, gamma=1.5)),
    ("gamma = NaN", lambda: FiniteMDP(OK, horizon=1, gamma=np.nan)),
    ("gamma = 'x'", lambda: FiniteMDP(OK, horizon=1, gamma="x")),  # type: ignore[arg-type]
    ("gamma = 1e-200 is too small|gamma = .* is too small", lambda: FiniteMDP(
        OK, horizon=1, gamma=1e-200, start=[0.5, 0.5])),
    ("start = 7", lambda: FiniteMDP(OK, horizon=1, start=7, states=2)),
    ("start in state 7: it has no transitions", lambda: FiniteMDP(OK, horizon=1, start=7)),
    ("start = -1", lambda: FiniteMDP(OK, horizon=1, start=-1)),
    ("start = 0.5", lambda: FiniteMDP(OK, horizon=1, start=0.5)),
    ("start", lambda: FiniteMDP(OK, horizon=1, start="here")),
    ("start", lambda: FiniteMDP(OK, horizon=1, start=[1.0])),
    ("start sum to 0.75", lambda: FiniteMDP(OK, horizon=1, start=[0.5, 0.25])),
    ("start must be in", lambda: FiniteMDP(OK, horizon=1, start=[1.5, -0.5])),
    ("start sum to NaN", lambda: FiniteMDP(OK, horizon=1, start=[np.nan, 1.0])),
    ("got 3 numbers", lambda: FiniteMDP(OK, horizon=1, start=[0.5, 0.5, 0.0], states=2)),
    ("start", lambda: FiniteMDP(OK, horizon=1, start=[[0.5, 0.5]])),
    ("states = 0", lambda: FiniteMDP(OK, horizon=1, states=0)),
    ("states = 9", lambda: FiniteMDP(OK, horizon=1, states=999_999_999)),
]  # fmt: skip


@pytest.mark.parametrize(("message", "make"), BAD_MDPS)
def test_bad_mdps_are_refused(message: str, make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


BAD_QUESTIONS: list[tuple[str, Callable[[FiniteMDP], object]]] = [
    ("alpha", lambda mdp: mdp.optimum(0.0)),
    ("alpha", lambda mdp: mdp.optimum(1.1)),
    ("alpha", lambda mdp: mdp.optimum(np.nan)),
    ("alpha", lambda mdp: mdp.optimum("x")),  # type: ignore[arg-type]
    ("alpha", lambda mdp: mdp.best_stationary(-1.0)),
    ("eta", lambda mdp: mdp.chow(0.5)),
    ("eta", lambda mdp: mdp.chow(np.inf)),
    ("eta = 1e301", lambda mdp: mdp.worst_case([0, 0], 1e301)),
    ("eta", lambda mdp: mdp.worst_case([0, 0], np.nan)),
    ("shape", lambda mdp: mdp.evaluate(np.ones((3, 2)) / 2)),
    ("shape", lambda mdp: mdp.evaluate(np.ones((3, 2, 2)) / 2)),
    ("shape", lambda mdp: mdp.evaluate(np.zeros(3, np.int64))),
    ("shape", lambda mdp: mdp.evaluate(np.array([[1, 0], [1, 0]]))),
    ("rows differ in length", lambda mdp: mdp.evaluate([[1.0], [1.0, 0.0]])),
    ("real numbers", lambda mdp: mdp.evaluate([["a", "b"], ["c", "d"]])),
    (r"policy\[0\] must have no negative", lambda mdp: mdp.evaluate([[1.5, -0.5], [1.0, 0.0]])),
    (r"policy\[0\] must .* sum to 1", lambda mdp: mdp.evaluate([[0.5, 0.4], [1.0, 0.0]])),
    (r"policy\[0\]", lambda mdp: mdp.evaluate([[np.nan, 1.0], [1.0, 0.0]])),
    (r"policy\[1\] must be 0 from action 1", lambda mdp: mdp.evaluate([[0.5, 0.5], [0.5, 0.5]])),
    (r"policy\[1, 1\]", lambda mdp: mdp.evaluate(
        [[[0.5, 0.5], [1.0, 0.0]], [[0.5, 0.5], [0.0, 0.0]]] * 2)),
    (r"policy\[1\] = 1 is no action: state 1 has 1", lambda mdp: mdp.evaluate([0, 1])),
    (r"policy\[0\] = -1", lambda mdp: mdp.worst_case([-1, 0], 2.0)),
    ("another MDP", lambda mdp: mdp.evaluate(FiniteMDP(OK, horizon=4).optimum(0.5))),
    ("another MDP", lambda mdp: mdp.worst_case(FiniteMDP(OK, horizon=4).optimum(0.5), 2.0)),
    ("time = 4", lambda mdp: mdp.levels(4)),
    ("time = -1", lambda mdp: mdp.optimum(0.5).action(-1, 0.0, 0)),
    ("state = 2", lambda mdp: mdp.optimum(0.5).action(0, 0.0, 2)),
    ("accumulated", lambda mdp: mdp.optimum(0.5).action(0, 0.5, 0)),
    ("accumulated", lambda mdp: mdp.optimum(0.5).action(2, np.nan, 0)),
    ("accumulated", lambda mdp: mdp.optimum(0.5).action(2, np.inf, 0)),
    ("state = 5", lambda mdp: mdp.outcomes(5, 0)),
    ("action = 1", lambda mdp: mdp.outcomes(1, 1)),
    ("state = -1", lambda mdp: mdp.action_count(-1)),
]  # fmt: skip


@pytest.mark.parametrize(("message", "ask"), BAD_QUESTIONS)
def test_bad_questions_are_refused(message: str, ask: Callable[[FiniteMDP], object]) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        ask(FiniteMDP(OK, horizon=4))
    assert "\n" not in str(caught.value)


def test_what_would_fill_the_memory_is_refused() -> None:
    # A thousand actions at each of ten thousand accumulated rewards.
    rows = [(0, action, 0, 1.0, float(action % 50)) for action in range(1000)]
    with pytest.raises(ValueError, match="too large"):
        FiniteMDP(rows, horizon=100)
    random = np.random.default_rng(0)
    rows = [(s, a, (s + a) % 8, 1.0, float(random.random())) for s in range(8) for a in range(2)]
    with pytest.raises(ValueError, match="budget-augmented"):
        FiniteMDP(rows, horizon=5).chow(2.0)


def test_environments_that_are_no_tables_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no table env\.unwrapped\.P"):
        FiniteMDP.from_env(toy("CartPole"))
    with pytest.raises(ValueError, match="max_episode_steps"):
        FiniteMDP.from_env(toy("CliffWalking"))

    class Bare:
        P: Any = {0: {0: [(1.0, 0, 1.0, True)]}}

    with pytest.raises(ValueError, match="where it starts"):
        FiniteMDP.from_env(Bare(), 5)
    assert FiniteMDP.from_env(Bare(), 5, start=0).optimum(0.5).cvar == 1.0
    tables: list[Any] = [{1: {0: [(1.0, 0, 1.0, True)]}}, {0: {0: [(1.0, 0, 1.0)]}}, [3], {0: {1: []}}]
    for table in tables:
        Bare.P = table
        with pytest.raises(ValueError, match=r"env\.unwrapped\.P\[0\]"):
            FiniteMDP.from_env(Bare(), 5, start=0)


def test_a_table_that_leaves_something_out_is_refused() -> None:
    with pytest.raises(ValueError, match="fickle"):
        FiniteMDP.from_env(toy("Taxi", fickle_passenger=True), 5)


# CSV files.


def write_csv(path: Path, rows: list[Row], first_state: int = 0, first_action: int = 0) -> Path:
    lines = ["idstatefrom,idaction,idstateto,probability,reward"]
    for state, action, following, probability, reward in rows:
        ids = f"{state + first_state},{action + first_action},{following + first_state}"
        lines.append(f"{ids},{probability!r},{reward!r}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(("first_state", "first_action"), [(0, 0), (1, 1), (0, 1)])
@pytest.mark.parametrize("seed", range(3))
def test_csv_files_come_back(tmp_path: Path, seed: int, first_state: int, first_action: int) -> None:
    small = random_small(seed, distribution=True)
    rows = [(s, a, 3 if n < 0 else n, p, r) for s, a, n, p, r in small.rows]
    path = write_csv(tmp_path / "mdp.csv", rows, first_state, first_action)
    read = FiniteMDP.from_csv(path, horizon=3, gamma=small.gamma, start=small.start)
    mdp = small.mdp()
    for alpha in (1.0, 0.3, 0.05):
        assert read.optimum(alpha).cvar == pytest.approx(mdp.optimum(alpha).cvar, abs=1e-12)
    for state in range(3):
        for action in range(mdp.action_count(state)):
            assert read.outcomes(state, action)[2].sum() == pytest.approx(
                sum({(r[2], r[4]): r[4] for r in rows if r[:2] == (state, action)}.values())
            )


def test_csv_columns_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "mdp.csv"
    path.write_text(
        "\ufeffReward, probability,idstateto,note,idaction,idstatefrom\r\n"
        '1.5,1,2,"a, b",1,1\r\n\r\n0,1.0,1,,1,2\r\n',
        encoding="utf-8",
    )
    mdp = FiniteMDP.from_csv(path, horizon=3)
    assert mdp.states == 2
    assert mdp.optimum(0.5).cvar == 3.0


HEADER = "idstatefrom,idaction,idstateto,probability,reward\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the header must have"),
        ("0,0,0,1.0,0.0\n", "line 1: the header must have"),
        ("idstatefrom,idaction,idstateto,probability\n0,0,0,1\n", "line 1: the header"),
        (HEADER, "no transitions"),
        (HEADER + "0,0,1,1.0\n", "line 2: there is no reward"),
        (HEADER + "0,0,1,1.0,0\n0,1,one,1.0,0\n", "line 3: idstateto = 'one' is no number"),
        (HEADER + "0,0,1,1.0,0\n\n0,1.5,1,1.0,0\n", "line 4: idaction = 1.5 must be a whole number"),
        (HEADER + "0,0,-1,1.0,0\n", "line 2: idstateto = -1 must be a whole number"),
        (HEADER + "0,0,0,1.2,0\n", "line 2: probability = 1.2 must be in"),
        (HEADER + "0,0,0,nan,0\n", "line 2: probability = nan must be in"),
        (HEADER + "0,0,0,1.0,inf\n", "line 2: reward = inf must be a finite number"),
        (HEADER + "0,0,0,0.5,0\n0,0,1,0.4,0\n", "line 2: the probabilities of action 0 in state 0 sum to 0.9"),
        (HEADER + "2,0,2,1.0,0\n", "ids of states must start at 0 or 1, got 2"),
        (HEADER + "0,3,0,1.0,0\n", "ids of actions must start at 0 or 1, got 3"),
        (HEADER + "0,0,0,1.0,0\n0,2,0,1.0,0\n", "line 3: state 0 has an action 2 but no action 1"),
        (HEADER + '0,0,0,1.0,"0\n', "line"),
    ],
)
def test_bad_csv_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mdp.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        FiniteMDP.from_csv(path, horizon=2)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "mdp.csv"
    path.write_bytes(HEADER.encode() + b"\xff\xfe\x00\n")
    with pytest.raises(ValueError, match="line"):
        FiniteMDP.from_csv(path, horizon=2)
    with pytest.raises(FileNotFoundError):
        FiniteMDP.from_csv(tmp_path / "none.csv", horizon=2)


# The antagonist between environment and agent.


def episodes(
    env: gymnasium.Env[Any, Any],
    count: int,
    act: Callable[[int, int], int],
    observe: Callable[[float], None] = lambda _: None,
) -> Iterator[tuple[float, float, list[float], float]]:
    """Return, product of the ratios, ratios and last budget; ``act(time, state)``."""
    for episode in range(count):
        state, info = env.reset(seed=1 if episode == 0 else None)
        ratios, total = [info["likelihood_ratio"]], 0.0
        for time in itertools.count():
            state, reward, terminated, truncated, info = env.step(act(time, state))
            observe(float(reward))
            ratios.append(info["likelihood_ratio"])
            total += float(reward)
            if terminated or truncated:
                break
        yield total, float(np.prod(ratios)), ratios, info["budget"]


@pytest.mark.parametrize("eta", [2.0, 20.0])
def test_the_antagonist_stays_within_its_budget_and_attains_the_cvar(eta: float) -> None:
    inner = toy("FrozenLake", max_episode_steps=30)
    mdp = FiniteMDP.from_env(inner)
    table = mdp.optimum(1.0).table()
    env = BudgetedAntagonist(inner, mdp, eta, table)
    nominal = mdp.evaluate(table)
    returns = []
    for total, product, ratios, budget in episodes(env, 2000, lambda t, s: int(table[t, s])):
        assert product <= eta * (1.0 + 1e-12)
        assert min(ratios) > 0.0
        assert budget == pytest.approx(eta / product)
        returns.append(total)
    error = np.std(returns) / np.sqrt(len(returns))
    assert abs(np.mean(returns) - nominal.cvar(1.0 / eta)) <= 4.0 * error + 1e-12


@pytest.mark.parametrize(
    ("name", "horizon"), [("FrozenLake8x8", 40), ("CliffWalkingSlippery", 15), ("Taxi", 12)]
)
def test_no_agent_lets_it_exceed_its_budget(name: str, horizon: int) -> None:
    # The time limit of the MDP is shorter than the environment's.
    inner = toy(name, max_episode_steps=horizon + 5)
    mdp = FiniteMDP.from_env(inner, horizon, 0.9 if name.startswith("Frozen") else 1.0)
    best = mdp.optimum(0.2)
    env = BudgetedAntagonist(inner, mdp, 5.0, best)
    random = np.random.default_rng(0)
    player = Player(best)

    def act(time: int, state: int) -> int:
        if time == 0:
            player.reset()
        if time < horizon and random.random() < 0.8:
            return player.act(state)
        return int(random.integers(mdp.actions))

    for _, product, ratios, budget in episodes(env, 700, act, player.observe):
        assert product <= 5.0 * (1.0 + 1e-12)
        assert budget >= 1.0
        assert ratios[horizon + 1 :] == [1.0] * len(ratios[horizon + 1 :])


def test_a_drawn_start_is_chance_for_the_antagonist() -> None:
    inner = toy("Taxi", max_episode_steps=20)
    mdp = FiniteMDP.from_env(inner)
    best = mdp.optimum(1.0)
    env = BudgetedAntagonist(inner, mdp, 10.0, best)
    player = Player(best)

    def act(time: int, state: int) -> int:
        if time == 0:
            player.reset()
        return player.act(state)

    returns = []
    for total, product, _, _ in episodes(env, 400, act, player.observe):
        assert product <= 10.0 * (1.0 + 1e-12)
        returns.append(total)
    error = np.std(returns) / np.sqrt(len(returns))
    assert abs(np.mean(returns) - best.law.cvar(0.1)) <= 4.0 * error
    assert best.law.cvar(0.1) < best.mean - 3.0


def worst_outcome(_: int, __: int, law: Floats, budget: float) -> Floats:
    """Everything on the first outcome."""
    ratios = np.zeros(len(law))
    ratios[0] = 1e6
    assert budget >= 1.0
    return ratios


@pytest.mark.parametrize("kind", ["policy", "ratios", "none"])
@pytest.mark.parametrize("name", ["FrozenLake", "CliffWalkingSlippery", "Taxi"])
def test_with_a_budget_of_one_it_is_chance_itself(name: str, kind: str) -> None:
    plain = toy(name, max_episode_steps=15)
    inner = toy(name, max_episode_steps=15)
    mdp = FiniteMDP.from_env(inner)
    policy = mdp.optimum(0.1)
    env: gymnasium.Env[Any, Any] = BudgetedAntagonist(inner, mdp, 1.0, policy)
    if kind == "ratios":
        env = BudgetedAntagonist(inner, None, 1.0, ratios=worst_outcome)
    if kind == "none":
        env = BudgetedAntagonist(inner, None, 50.0, ratios=lambda _, __, law, ___: np.ones_like(law))
    random = np.random.default_rng(0)
    for episode in range(100):
        seed = 11 if episode == 0 else None
        assert env.reset(seed=seed)[0] == plain.reset(seed=seed)[0]
        over = False
        while not over:
            action = int(random.integers(mdp.actions))
            one, other = plain.step(action), env.step(action)
            assert one[:4] == other[:4]
            assert other[4]["likelihood_ratio"] == 1.0
            assert other[4]["prob"] == one[4]["prob"]
            over = one[2] or one[3]


def test_an_antagonist_of_python_is_made_admissible() -> None:
    env = BudgetedAntagonist(
        toy("FrozenLake"), None, 4.0, ratios=worst_outcome
    )
    env.reset(seed=0)
    assert env.budget == 4.0
    ratios = []
    for _, product, of, _ in episodes(env, 300, lambda t, s: 2):
        assert product <= 4.0 * (1.0 + 1e-12)
        ratios += of[1:2]
    # The first outcome with ratio 3, as far as chance allows; the others are out of reach.
    assert set(np.round(ratios, 12)) == {3.0}


def test_it_leaves_chance_alone_off_the_policy() -> None:
    inner = toy("FrozenLake", max_episode_steps=20)
    mdp = FiniteMDP.from_env(inner)
    table = mdp.optimum(1.0).table()
    env = BudgetedAntagonist(inner, mdp, 8.0, table)
    for _, product, _, budget in episodes(env, 50, lambda t, s: int((table[t, s] + 1) % 4)):
        assert product == 1.0 and budget == 8.0


def test_the_table_of_the_environment_is_as_it_was() -> None:
    inner = toy("Taxi", is_rainy=True, max_episode_steps=10)
    before = copy.deepcopy(inner.unwrapped.P)  # type: ignore[attr-defined]
    start = inner.unwrapped.initial_state_distrib  # type: ignore[attr-defined]
    mdp = FiniteMDP.from_env(inner)
    env = BudgetedAntagonist(inner, mdp, 3.0, mdp.optimum(0.3))
    for _ in episodes(env, 20, lambda t, s: t % 6):
        pass
    assert before == inner.unwrapped.P  # type: ignore[attr-defined]
    assert start is inner.unwrapped.initial_state_distrib  # type: ignore[attr-defined]


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version.*")
@pytest.mark.parametrize("kind", ["policy", "ratios"])
@pytest.mark.parametrize("name", ["FrozenLake", "CliffWalkingSlippery", "Taxi"])
def test_the_wrapper_passes_the_environment_checker(name: str, kind: str) -> None:
    inner = toy(name, max_episode_steps=20)
    check_env(inner, skip_render_check=True)
    if kind == "policy":
        mdp = FiniteMDP.from_env(inner)
        env = BudgetedAntagonist(inner, mdp, 3.0, mdp.optimum(0.2))
    else:
        env = BudgetedAntagonist(inner, None, 3.0, ratios=worst_outcome)
    check_env(env, skip_render_check=True)
    assert env.spec is not None
    again = env.spec.make()
    assert isinstance(again, BudgetedAntagonist) and again.eta == 3.0


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("either a policy or ratios", {"eta": 2.0}),
        ("either a policy or ratios", {"eta": 2.0, "policy": [0] * 16, "ratios": worst_outcome}),
        ("eta", {"eta": 0.5, "policy": [0] * 16}),
        ("eta", {"eta": np.nan, "ratios": worst_outcome}),
        ("eta", {"eta": np.inf, "ratios": worst_outcome}),
        ("function", {"eta": 2.0, "ratios": 3}),
        ("not that of the environment", {"eta": 2.0, "policy": [0, 0], "mdp": FiniteMDP(OK, horizon=2)}),
        ("not that of the environment", {
            "eta": 2.0, "policy": [0] * 16,
            "mdp": FiniteMDP.from_env(toy("FrozenLake", is_slippery=False)),
        }),
        ("shape", {"eta": 2.0, "policy": [0] * 3}),
    ],
)  # fmt: skip
def test_bad_antagonists_are_refused(message: str, arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        BudgetedAntagonist(toy("FrozenLake"), **{"mdp": None, **arguments})
    assert "\n" not in str(caught.value)
    if "not that" not in message and "shape" not in message:
        with pytest.raises(ValueError):
            BudgetedAntagonist(toy("CartPole"), **{"mdp": None, **arguments})


@pytest.mark.parametrize(
    ("ratios", "message"),
    [([1.0], "shape"), ([1.0, -1.0, 1.0], "negative"), ([np.inf, 1.0, 1.0], "finite"),
     ([0.0, 0.0, 0.0], "all be 0"), ("abc", "real numbers")],
)  # fmt: skip
def test_bad_ratios_are_refused(ratios: Any, message: str) -> None:
    env = BudgetedAntagonist(
        toy("FrozenLake"), None, 2.0, ratios=lambda *_: ratios
    )
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(0)
    assert len(env.unwrapped.P[0][0]) == 3  # type: ignore[attr-defined]


@given(
    law=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5),
    weights=st.lists(st.floats(0.0, 1e300), min_size=5, max_size=5),
    budget=st.floats(1.0, 1e6),
)
@settings(deadline=None)
def test_admissible_ratios(law: list[float], weights: list[float], budget: float) -> None:
    p = np.array(law)
    if p.sum() < 1e-3:
        p = np.ones(len(law))
    p = p / p.sum()
    ratios = np.array(weights[: len(p)])
    if ratios[p > 0.0].max() == 0.0 or float(p @ (ratios / ratios[p > 0.0].max())) < 1e-200:
        return
    found = admissible(ratios, p, budget)
    assert found.min() >= 0.0 and found[p > 0.0].max() <= budget
    assert found @ p == pytest.approx(1.0, abs=1e-9)


def test_all_else_works_without_gymnasium() -> None:
    folder = Path(cvar_game.mdp.__file__).parent
    code = f"""
        import sys, types
        sys.modules["gymnasium"] = None
        package = types.ModuleType("cvar_game")
        package.__path__ = [{str(folder)!r}]
        sys.modules["cvar_game"] = package
        import cvar_game.mdp as mdp
        assert mdp.FiniteMDP([(0, 0, -1, 1.0, 2.0)], horizon=1).optimum(0.5).cvar == 2.0
        try:
            mdp.BudgetedAntagonist
        except ImportError:
            print("refused")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=False
    )
    assert done.stdout == "refused\n", done.stderr
    with pytest.raises(AttributeError):
        _ = cvar_game.mdp.nothing  # type: ignore[attr-defined]
