"""The environments, by the official checkers and against one another."""

from __future__ import annotations

import csv
import io
import subprocess
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import WORLDS, folder_of
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import cvar_game
from cvar_game import LavaEnv, LavaVectorEnv, WorstCase

IDS = {"lava-grid": "cvar_game/LavaGrid-v0", "lava-point": "cvar_game/LavaPoint-v0"}
VIEWS = ({}, {"observation": "features"}, {"observation": "features", "time": True}, {"time": True})


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("options", VIEWS)
def test_gymnasium_finds_nothing_wrong(world: str, options: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Velocities have no bound, and the checker cannot see that this is meant.
        warnings.filterwarnings("ignore", message=".*observation space (minimum|maximum).*")
        env = gym.make(IDS[world], render_mode="rgb_array", **options)
        check_env(env.unwrapped)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_batch_is_what_its_slots_are_one_by_one(world: str, mode: AutoresetMode) -> None:
    slots = 5
    options = {"observation": "features", "time": True}
    one_by_one = SyncVectorEnv(
        [lambda: LavaEnv(world, **options) for _ in range(slots)], autoreset_mode=mode
    )
    batch = LavaVectorEnv(slots, world, autoreset_mode=mode, **options)
    assert batch.observation_space == one_by_one.observation_space
    assert batch.action_space == one_by_one.action_space
    batch.action_space.seed(7)
    same(batch.reset(seed=3), one_by_one.reset(seed=3))
    for step in range(10_000):
        actions = batch.action_space.sample()
        ours, theirs = batch.step(actions), one_by_one.step(actions)
        same(ours, theirs)
        ended = ours[2] | ours[3]
        if mode is AutoresetMode.DISABLED and ended.any():
            with pytest.raises(ValueError, match="reset it first"):
                batch.step(actions)
            one_by_one._autoreset_envs[:] = ended
            options_of_reset = [{"reset_mask": ended.copy()} for _ in range(2)]
            same(
                batch.reset(options=options_of_reset[0]),
                one_by_one.reset(options=options_of_reset[1]),
            )
        if step == 5_000 and mode is not AutoresetMode.DISABLED:
            seeds = [11, None, 13, None, 15]
            same(batch.reset(seed=seeds), one_by_one.reset(seed=seeds))


def same(ours: Any, theirs: Any) -> None:
    """Equal to the bit, with the same types; infos may leave out what nobody has."""
    if isinstance(ours, dict):
        assert set(ours) == set(theirs)
        for key in ours:
            same(ours[key], theirs[key])
    elif isinstance(ours, tuple):
        assert len(ours) == len(theirs)
        for pair in zip(ours, theirs, strict=True):
            same(*pair)
    elif ours is None:
        assert theirs is None
    elif ours.dtype == object:
        for pair in zip(ours, theirs, strict=True):
            same(*pair)
    else:
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("world", WORLDS)
def test_arrays_are_new_every_time(world: str) -> None:
    env = gym.make_vec(IDS[world], num_envs=4)
    assert isinstance(env, LavaVectorEnv)
    first, _ = env.reset(seed=1)
    kept = first.copy()
    second = env.step(env.action_space.sample())[0]
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("world", WORLDS)
def test_an_episode_continues_from_a_snapshot(world: str) -> None:
    env = LavaEnv(world, time=True)
    env.action_space.seed(1)
    env.reset(seed=5)
    for _ in range(3):
        env.step(env.action_space.sample())
    snapshot = env.snapshot()
    actions = [env.action_space.sample() for _ in range(4)]
    first = [env.step(action) for action in actions]
    other = LavaVectorEnv(2, world, time=True)
    other.restore(1, snapshot)
    for action, (observation, reward, terminated, _, info) in zip(actions, first, strict=True):
        ours = other.step(np.stack([action, action]))
        np.testing.assert_array_equal(ours[0][1], observation)
        assert (ours[1][1], ours[2][1]) == (reward, terminated)
        assert ours[4]["clearance"][1] == info["clearance"]
        if terminated:
            break
    with pytest.raises(ValueError, match="not a snapshot"):
        other.restore(0, snapshot[:-3])
    foreign = LavaEnv("lava-point" if world == "lava-grid" else "lava-grid", time=True)
    with pytest.raises(ValueError, match="not a snapshot"):
        foreign.restore(snapshot)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("antagonist", ["nominal", "learned"])
def test_a_rollout_is_that_of_the_program(runs: Path, world: str, antagonist: str) -> None:
    folder = folder_of(runs, world)
    command = ["cvar-game", "rollout", str(folder), "--episodes", "20", "--seed", "9"]
    done = subprocess.run(
        [*command, "--antagonist", antagonist], capture_output=True, text=True, check=True
    )
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    run = cvar_game.load(folder)
    opponent = run if antagonist == "learned" else None
    env = LavaEnv(run.world, observation=run.observation, time=run.time, opponent=opponent)
    observation, _ = env.reset(seed=9)
    names = {0: "", 1: "goal", 2: "lava", 3: "timeout"}
    for row in rows:
        action, _ = run.predict(observation, deterministic=True)
        observation, reward, terminated, _, info = env.step(action)
        assert reward == float(row["reward"])
        assert info["clearance"] == float(row["clearance"])
        assert info["likelihood_ratio"] == float(row["delta"])
        assert names[info["end"]] == row["end"]
        if terminated:
            observation, _ = env.reset()


def test_the_worst_case_brings_its_value_about() -> None:
    world, eta = cvar_game.World("lava-grid"), 25.0
    policy = cvar_game.exact(world, eta).policy
    assert policy is not None
    value, ratios = cvar_game.worst_case(policy, world, eta)
    assert ratios.shape == (40, 70, 4)
    env = LavaVectorEnv(
        500, world, observation="features", time=True, opponent=WorstCase(policy), eta=eta
    )
    observation, _ = env.reset(seed=0)
    returns, product = np.zeros(500), np.ones(500)
    ended: list[float] = []
    was_over = np.zeros(500, np.bool_)
    for _ in range(2_000):
        cells = observation[:, :70].argmax(axis=1)
        times = np.rint((observation[:, 70] + 1) * 20).astype(int)
        actions = policy[np.minimum(times, 39), cells].argmax(axis=1)
        observation, reward, terminated, _, info = env.step(actions)
        live = ~was_over
        returns[live] += reward[live]
        product[live] *= info["likelihood_ratio"][live]
        assert product.max() <= eta * (1 + 1e-9)
        ended.extend(returns[terminated])
        returns[terminated], product[terminated] = 0.0, 1.0
        was_over = terminated
    error = np.std(ended) / np.sqrt(len(ended))
    assert abs(np.mean(ended) - value) < 5 * error


@pytest.mark.parametrize("world", WORLDS)
def test_pictures_show_the_way(world: str) -> None:
    env = LavaEnv(world, render_mode="rgb_array")
    env.reset(seed=1)
    frame = env.render()
    assert frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3
    # Right, unless chance moves it elsewhere: off the wall in some step.
    right = 2 if world == "lava-grid" else np.array([1.0, 0.0])
    for _ in range(20):
        _, _, terminated, _, _ = env.step(right)
        if terminated or (env.render() != frame).any():
            break
    assert (env.render() != frame).any()
    text = LavaEnv(world, render_mode="ansi")
    text.reset(seed=1)
    assert "@" in text.render() and "G" in text.render()
    batch = LavaVectorEnv(2, world, render_mode="rgb_array")
    batch.reset(seed=1)
    frames = batch.render()
    assert frames is not None and len(frames) == 2
    np.testing.assert_array_equal(frames[0], frame)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: cvar_game.World("lava-sea"), "there are lava-grid and lava-point"),
        (lambda: cvar_game.World("lava-grid", slip=2), "slip"),
        (lambda: cvar_game.World("lava-grid", slipp=0.1), "slipp"),
        (lambda: cvar_game.World("lava-grid", slip=object()), "slip"),
        (lambda: LavaEnv("lava-grid", observation="pixels"), "'coordinates' or 'features'"),
        (lambda: LavaEnv("lava-grid", render_mode="human"), "render_mode"),
        (lambda: LavaEnv("lava-grid", opponent="/no/such/run"), "no/such/run"),
        (lambda: LavaEnv("lava-grid", opponent=WorstCase(np.ones((3, 4)) / 4), eta=9), "shape"),
        (lambda: LavaEnv("lava-grid", opponent=WorstCase(np.ones((70, 4)) / 4)), "eta"),
        (lambda: LavaEnv("lava-grid", eta=0.5), "eta"),
        (lambda: LavaVectorEnv(0, "lava-grid"), "num_envs"),
        (lambda: LavaVectorEnv(2, "lava-grid", autoreset_mode="later"), "autoreset_mode"),
        (lambda: LavaEnv("lava-grid").step(0), "reset"),
        (lambda: open_env().step(4), "action 4"),
        (lambda: open_env().step(-1), "action -1"),
        (lambda: open_env().step(1.5), "integers"),
        (lambda: open_env("lava-point").step([np.nan, 0.0]), "not finite"),
        (lambda: open_env("lava-point").step([0.0]), "shape"),
        (lambda: open_env("lava-point").step("up"), "shape"),
        (lambda: closed_env().step(0), "closed"),
        (lambda: LavaVectorEnv(2, "lava-grid").reset(seed=[1]), "2 seeds"),
        (lambda: LavaVectorEnv(2, "lava-grid").reset(seed=-1), "[Ss]eed"),
        (
            lambda: LavaVectorEnv(2, "lava-grid").reset(options={"reset_mask": [True, False]}),
            "reset_mask",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(make: Any, message: str) -> None:
    with pytest.raises((ValueError, gym.error.Error), match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def open_env(world: str = "lava-grid") -> LavaEnv:
    env = LavaEnv(world)
    env.reset(seed=1)
    return env


def closed_env() -> LavaEnv:
    env = open_env()
    env.close()
    return env
