"""Libraries of learners take the environments as they are, and learn in them.

Each test needs its library and is skipped without it. Those that train are marked ``slow``.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import WORLDS

import cvar_game

IDS = {"lava-grid": "cvar_game/LavaGrid-v0", "lava-point": "cvar_game/LavaPoint-v0"}
VIEWS: tuple[dict[str, Any], ...] = (
    {},
    {"observation": "features"},
    {"observation": "features", "time": True},
    {"time": True},
)
EXAMPLES = Path(__file__).parents[3] / "examples" / "python"


def library(name: str) -> ModuleType:
    """A library, or a reason to skip: also where it is installed and cannot be loaded."""
    module: ModuleType = pytest.importorskip(name, exc_type=ImportError)
    return module


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A module of ``examples/python``."""
    monkeypatch.syspath_prepend(EXAMPLES)
    for module in ("sb3_adapter", name):
        sys.modules.pop(module, None)
    return library(name)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("options", VIEWS)
def test_stable_baselines_finds_nothing_wrong(world: str, options: dict[str, Any]) -> None:
    check_env = library("stable_baselines3.common.env_checker").check_env
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(IDS[world], **options).unwrapped)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("options", VIEWS)
def test_torchrl_finds_nothing_wrong(world: str, options: dict[str, Any]) -> None:
    library("tensordict")
    envs = library("torchrl.envs")
    env = envs.GymWrapper(gym.make(IDS[world], **options))
    envs.check_env_specs(env)
    # The time limit is an end of the episode.
    ends = env.rollout(1_000, break_when_any_done=False)["next"]
    assert ends["terminated"].any() and not ends["truncated"].any()


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrl_finds_nothing_wrong_with_a_batch(world: str, mode: str) -> None:
    library("tensordict")
    envs = library("torchrl.envs")
    batch = envs.GymWrapper(gym.make_vec(IDS[world], num_envs=3, autoreset_mode=mode))
    envs.check_env_specs(batch)
    ends = batch.rollout(200, break_when_any_done=False)["next"]
    assert ends["terminated"].any(1).all() and not ends["truncated"].any()


@pytest.mark.parametrize("world", WORLDS)
def test_the_adapter_is_what_stable_baselines_makes_of_single_environments(
    world: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapter = example("sb3_adapter", monkeypatch)
    dummy = library("stable_baselines3.common.vec_env").DummyVecEnv
    slots = 3
    batch = adapter.LavaVecEnv(world, slots)
    one_by_one = dummy([lambda: cvar_game.LavaEnv(world) for _ in range(slots)])
    batch.seed(5)
    one_by_one.seed(5)
    np.testing.assert_array_equal(batch.reset(), one_by_one.reset())
    batch.action_space.seed(1)
    ends = 0
    for _ in range(1_000):
        actions = np.stack([batch.action_space.sample() for _ in range(slots)])
        ours, theirs = batch.step(actions), one_by_one.step(actions)
        for mine, other in zip(ours[:3], theirs[:3], strict=True):
            assert mine.dtype == other.dtype
            np.testing.assert_array_equal(mine, other)
        for mine, other in zip(ours[3], theirs[3], strict=True):
            assert ("terminal_observation" in mine) == ("terminal_observation" in other)
            assert not other["TimeLimit.truncated"]
            if "terminal_observation" in mine:
                ends += 1
                np.testing.assert_array_equal(
                    mine["terminal_observation"], other["terminal_observation"]
                )
    assert ends > 50


@pytest.mark.slow
@pytest.mark.parametrize(("world", "steps"), [("lava-grid", 600_000), ("lava-point", 1_000_000)])
def test_ppo_learns_to_reach_the_goal(
    world: str, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sb3_ppo = example("sb3_ppo", monkeypatch)
    model = sb3_ppo.train(world, steps, seed=1)
    view = sb3_ppo.SETTINGS[world]["observation"]
    found = cvar_game.evaluate(model, world, 1.0, observation=view, episodes=10_000)
    assert found.goal > 0.9, str(found)
    assert found.mean > 0.2, str(found)


@pytest.mark.slow
def test_qrdqn_learns_to_reach_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    library("sb3_contrib")
    sb3_qrdqn = example("sb3_qrdqn", monkeypatch)
    model = sb3_qrdqn.train(seed=1)
    found = cvar_game.evaluate(sb3_qrdqn.table(model), "lava-grid", 1.0)
    assert found.goal > 0.9, str(found)
    assert found.regret is not None and found.regret < 0.1, str(found)


@pytest.mark.slow
def test_tqc_learns_to_reach_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    library("sb3_contrib")
    sb3_tqc = example("sb3_tqc", monkeypatch)
    model = sb3_tqc.train(seed=1)
    found = cvar_game.evaluate(model, "lava-point", 1.0, episodes=10_000)
    assert found.goal > 0.9, str(found)
    assert found.mean > 0.2, str(found)
