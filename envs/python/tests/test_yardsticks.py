"""Yardsticks, against the program, against closed forms and against one another."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import WORLDS, folder_of

import cvar_game
from cvar_game import WorstCase


def program(*arguments: str) -> str:
    return subprocess.run(
        ["cvar-game", *arguments], capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("eta", [1.0, 25.0, 100.0])
def test_the_optimum_is_that_of_the_program(world: str, eta: float) -> None:
    told = json.loads(program("exact", "--env", world, "--eta", str(eta), "--json"))
    exact = cvar_game.exact(world, eta)
    assert exact.details == told
    assert exact.upper_bound is not None and exact.upper_bound >= exact.cvar
    assert (exact.upper_bound == exact.cvar) == (world == "lava-grid")


@pytest.mark.parametrize("slip", [0.05, 0.2])
@pytest.mark.parametrize("eta", [1.0, 7.0, 100.0])
def test_the_optimal_policy_attains_the_optimum(eta: float, slip: float) -> None:
    best = cvar_game.exact("lava-grid", eta, slip=slip)
    found = cvar_game.evaluate(best.policy, "lava-grid", eta, slip=slip)
    assert found.cvar == pytest.approx(best.cvar, abs=1e-12)
    assert found.regret == pytest.approx(0.0, abs=1e-12)
    assert found.episodes is None and found.cvar_interval == (found.cvar, found.cvar)
    assert found.goal + found.lava + found.timeout == pytest.approx(1.0)
    # The law itself says the same.
    values, masses = found.law.values, found.law.probabilities
    assert masses.sum() == pytest.approx(1.0)
    assert found.mean == pytest.approx(values @ masses)
    tail = np.minimum(np.cumsum(masses), 1 / eta) - np.minimum(np.cumsum(masses) - masses, 1 / eta)
    assert found.cvar == pytest.approx(tail @ values * eta)


def test_a_played_policy_agrees_with_its_table() -> None:
    policy = cvar_game.exact("lava-grid", 25).policy
    assert policy is not None

    def choose(seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        cells = seen[:, :70].argmax(axis=1)
        times = np.rint((seen[:, 70] + 1) * 20).astype(int)
        return policy[np.minimum(times, 39), cells].argmax(axis=1)

    view = {"observation": "features", "time": True}
    table = cvar_game.tabulate(choose, "lava-grid", **view)
    np.testing.assert_array_equal(table.argmax(-1)[policy.any(-1)], policy.argmax(-1)[policy.any(-1)])
    exact = cvar_game.evaluate(policy, "lava-grid", 25, opponent=WorstCase(policy), episodes=50_000)
    played = cvar_game.evaluate(choose, "lava-grid", 25, episodes=50_000, **view)
    assert played.episodes == 50_000
    for name in ("mean", "cvar"):
        low, high = getattr(played, f"{name}_interval")
        middle, half = (low + high) / 2, (high - low) / 2
        assert abs(getattr(exact, name) - middle) < 2.5 * half, name
    assert exact.antagonist_gap is not None and abs(exact.antagonist_gap) < 0.02
    assert played.optimum == exact.optimum and played.regret_interval is not None
    assert played.regret_interval[0] < 0.0 < played.regret_interval[1]
    assert cvar_game.regret(table, "lava-grid", 25) == pytest.approx(0.0, abs=1e-12)


def test_the_same_seed_meets_the_same_chance() -> None:
    def right(seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.tile([0.3, 1.0], (len(seen), 1))

    one = cvar_game.evaluate(right, "lava-point", 2, episodes=500, num_envs=7)
    other = cvar_game.evaluate(right, "lava-point", 2, episodes=500, num_envs=500)
    np.testing.assert_array_equal(one.law.values, other.law.values)
    assert one.clearance == other.clearance
    different = cvar_game.evaluate(right, "lava-point", 2, episodes=500, seed=1)
    assert not np.array_equal(one.law.values, different.law.values)


@pytest.mark.parametrize("world", WORLDS)
def test_a_trained_run_is_measured_as_the_program_measures_it(runs: Path, world: str) -> None:
    folder = folder_of(runs, world)
    run = cvar_game.load(folder)
    found = cvar_game.evaluate(run, episodes=1_000)
    row = cvar_game.results(runs).set_index("env").loc[world]
    assert found.mean == pytest.approx(row["greedy_mean"], abs=1e-6)
    assert found.cvar == pytest.approx(row["greedy_cvar"], abs=1e-6)
    assert found.regret == pytest.approx(row["regret"], abs=1e-6)
    opposed = cvar_game.evaluate(run, opponent=run, episodes=1_000)
    assert opposed.game_value == pytest.approx(row["greedy_game_value"], abs=1e-6)


def test_exploitability_is_that_of_the_program(runs: Path) -> None:
    run = cvar_game.load(folder_of(runs, "lava-grid"))
    row = cvar_game.results(runs).set_index("env").loc["lava-grid"]
    found = cvar_game.exploitability(run, run)
    assert found.epsilon == pytest.approx(row["exploitability"], abs=1e-6)
    assert found.response_gain == pytest.approx(row["response_gain"], abs=1e-6)
    # At equilibrium nobody gains but by seeing the budget.
    best = cvar_game.exact("lava-grid", 25)
    pair = cvar_game.exploitability(best.policy, WorstCase(best.policy), "lava-grid", 25)
    assert pair.regret == pytest.approx(0.0, abs=1e-12)
    assert pair.epsilon == max(pair.regret, pair.response_gain)


def test_predictions_are_those_of_the_table_and_draw_from_it(runs: Path) -> None:
    run = cvar_game.load(folder_of(runs, "lava-grid"))
    table = run.table()
    assert table is not None
    greedy = cvar_game.tabulate(run, run.world, observation=run.observation, time=run.time)
    np.testing.assert_array_equal(greedy.argmax(-1), table.argmax(-1))
    seen, _ = cvar_game.LavaEnv(**run.env_options, world="lava-grid").reset(seed=1)
    run.seed(3)
    drawn, _ = run.predict(np.tile(seen, (40_000, 1)))
    shares = np.bincount(drawn, minlength=4) / 40_000
    np.testing.assert_allclose(shares, table.reshape(-1, 70, 4)[0, 0], atol=0.015)
    alone, _ = run.predict(seen, deterministic=True)
    assert np.ndim(alone) == 0


def test_recorded_policies_enter_the_table(runs: Path, tmp_path: Path) -> None:
    best = cvar_game.exact("lava-grid", 25)
    record = {"method": "optimal", "seed": 1, "steps": 12_345, "seconds": 6.5}
    cvar_game.record(best.policy, "lava-grid", 25, tmp_path, **record)

    def push(seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.tile([0.1, 1.0], (len(seen), 1))

    stationary = cvar_game.record(best.policy[0], "lava-grid", 25, tmp_path, **{**record, "seed": 2})
    with_variant = {**record, "method": "push/up", "episodes": 1_000}
    cvar_game.record(push, "lava-point", 25, tmp_path, noise=1.0, **with_variant)
    frame = cvar_game.results(tmp_path)
    assert list(frame["method"]) == ["optimal", "optimal", "push"] and list(frame["variant"])[2] == "up"
    assert frame["regret"][0] == pytest.approx(0.0, abs=1e-6)
    assert stationary.class_regret is not None
    assert frame["class_regret"][1] == pytest.approx(stationary.class_regret, abs=1e-6)
    assert list(frame["steps"]) == [12_345] * 3 and list(frame["seconds"]) == [6.5] * 3
    table = program("table", str(runs), "--compare", str(tmp_path))
    assert "optimal" in table and "push/up" in table


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: cvar_game.evaluate(np.ones((70, 4)), "lava-grid", 25), "no law"),
        (lambda: cvar_game.evaluate(np.ones((7, 4)), "lava-grid", 25), r"\(70, 4\)"),
        (lambda: cvar_game.evaluate(np.full((70, 4), np.nan), "lava-grid", 25), "no law"),
        (lambda: cvar_game.evaluate("go right", "lava-grid", 25), "policy"),
        (lambda: cvar_game.evaluate(None, "lava-grid", 25), "policy"),
        (lambda: cvar_game.evaluate(np.ones((70, 4)) / 4, "lava-point", 25), "finite"),
        (lambda: cvar_game.evaluate(np.ones((70, 4)) / 4, "lava-grid", 0.1), "eta|budget"),
        (lambda: cvar_game.evaluate(np.ones((70, 4)) / 4, "lava-grid", np.nan), "eta|budget"),
        (lambda: cvar_game.evaluate(np.ones((70, 4)) / 4, "lava-grid", 2, gamma=2.0), "gamma"),
        (lambda: cvar_game.evaluate(lambda s: s, "lava-grid", 25), "shape"),
        (lambda: cvar_game.evaluate(lambda s: np.full(len(s), 9), "lava-grid", 25), "action 9"),
        (lambda: cvar_game.evaluate(lambda s: s, "lava-grid", 25, episodes=10), "at least 250"),
        (lambda: cvar_game.regret(lambda s: np.zeros((len(s), 2)), "lava-point", 3.3), "known"),
        (lambda: cvar_game.worst_case(np.ones((70, 4)) / 4, "lava-point", 25), "finite"),
        (lambda: cvar_game.exploitability(np.ones((70, 4)) / 4, None, "lava-grid", 25), "antag"),
        (lambda: cvar_game.load("/no/such/run"), "no/such/run"),
        (lambda: cvar_game.results("/no/such/folder"), "no/such/folder"),
        (lambda: cvar_game.exact("lava-point", 3.3), "3.3|known"),
    ],
)
def test_bad_input_is_refused_in_one_line(ask: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        ask()
    assert "\n" not in str(caught.value)


def test_an_error_of_the_policy_is_its_own() -> None:
    def broken(_: object) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        cvar_game.evaluate(broken, "lava-grid", 25)
