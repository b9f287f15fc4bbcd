"""Scenes: every one is a world, and Minigrid's are Minigrid's."""

from __future__ import annotations

import gymnasium as gym
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from minigrid.core.actions import Actions

import cvar_game
from cvar_game.envs import LavaEnv

# Our scene, Minigrid's environment, and the seed that draws it.
MINIGRID = [
    ("lava-gap-s7", "MiniGrid-LavaGapS7-v0", 1),
    ("lava-crossing-s9n1", "MiniGrid-LavaCrossingS9N1-v0", 1),
    ("lava-crossing-s9n2", "MiniGrid-LavaCrossingS9N2-v0", 1),
    ("dist-shift-1", "MiniGrid-DistShift1-v0", 1),
    ("dist-shift-2", "MiniGrid-DistShift2-v0", 1),
]


class Moves(gym.Wrapper):  # type: ignore[type-arg]
    """Minigrid with our four moves: the agent turns to the side of the move and steps forward.

    Its turns count as steps of its own time limit, which is therefore lifted; its reward, 1 less a share of
    that limit, is replaced by ours.
    """

    # up, down, right, left as Minigrid's directions.
    DIRECTIONS = (3, 1, 0, 2)

    def __init__(self, name: str) -> None:
        super().__init__(gym.make(name))
        self.unwrapped.max_steps = 10**9

    def step(self, action: int) -> tuple[object, float, bool, bool, dict[str, object]]:
        world = self.unwrapped
        while world.agent_dir != self.DIRECTIONS[action]:
            self.env.step(Actions.right)
        observation, _, terminated, truncated, info = self.env.step(Actions.forward)
        kind = world.grid.get(*world.agent_pos)
        reward = -0.035 if kind is None else {"goal": 1.0, "lava": -1.0}[kind.type]
        return observation, reward, terminated, truncated, info


def drawn(name: str, seed: int) -> str:
    """Minigrid's grid as our map, without its ring of walls: beyond the edge of ours there is none to see."""
    env = gym.make(name)
    env.reset(seed=seed)
    world = env.unwrapped
    marks = {"lava": "L", "goal": "G", "wall": "#"}
    rows = [
        [
            marks[cell.type] if (cell := world.grid.get(x, y)) is not None else "."
            for x in range(1, world.width - 1)
        ]
        for y in range(1, world.height - 1)
    ]
    x, y = world.agent_pos
    rows[y - 1][x - 1] = "S"
    return "".join("".join(row) + "\n" for row in rows)


@pytest.mark.parametrize(("scene", "name", "seed"), MINIGRID)
def test_minigrid_draws_our_map(scene: str, name: str, seed: int) -> None:
    assert drawn(name, seed) == cvar_game.scenes()[scene]


@pytest.mark.parametrize(("scene", "name", "seed"), MINIGRID)
def test_an_agent_sees_in_minigrid_what_it_sees_here(scene: str, name: str, seed: int) -> None:
    """The same moves lead to the same cells, rewards and ends where no move slips."""
    ours, theirs = LavaEnv(f"lava-grid/{scene}", slip=0.0, horizon=1000), Moves(name)
    random = np.random.default_rng(1)
    ends = {"goal": 0, "lava": 0}
    width, height = (int(side) for side in ours.world.scene["size"])
    best = cvar_game.exact(f"lava-grid/{scene}", eta=1).policy
    assert best is not None
    for episode in range(100):
        observation, _ = ours.reset(seed=1)
        theirs.reset(seed=seed)
        x, y = theirs.unwrapped.agent_pos
        for time in range(200):
            # On the best way, with more or fewer random moves.
            action = int(random.integers(4))
            if time < len(best) and random.random() > episode / 200:
                action = int(best[time, (y - 1) * width + x - 1].argmax())
            observation, reward, terminated, truncated, _ = ours.step(action)
            _, same_reward, same_end, _, _ = theirs.step(action)
            assert (reward, terminated) == (same_reward, same_end) and not truncated
            x, y = theirs.unwrapped.agent_pos
            place = [2 * (x - 1) / (width - 1) - 1, 2 * (y - 1) / (height - 1) - 1]
            np.testing.assert_allclose(observation[:2], place, atol=1e-6)
            if terminated:
                ends["goal" if reward > 0 else "lava"] += 1
                break
    assert min(ends.values()) >= 3, ends


@pytest.mark.parametrize("scene", cvar_game.scenes())
@pytest.mark.parametrize("world", cvar_game.worlds())
def test_every_scene_is_an_environment(world: str, scene: str) -> None:
    name = f"{world}/{scene}"
    env = gym.make("cvar_game/LavaGrid-v0", world=name)
    check_env(env.unwrapped, skip_render_check=True)
    described = cvar_game.World(name)
    assert described.name == name and described.changes == {}
    picture = cvar_game.scenes()[scene]
    assert described.scene["size"] == [len(picture.split()[0]), len(picture.split())]
    if world == "lava-grid":
        assert -2 < cvar_game.exact(name, eta=25).cvar < 1


def test_a_scene_can_be_written_here() -> None:
    walls = [[2.0, 2.0, 3.0, 4.0]]
    world = cvar_game.World("lava-point", walls=walls, more_goals=[[0.0, 6.0, 1.0, 7.0]])
    assert world.constants["walls"] == walls
    assert [area["kind"] for area in world.scene["areas"]] == ["lava", "goal", "goal", "wall"]
    with pytest.raises(ValueError, match="there is no scene"):
        cvar_game.World("lava-grid/nowhere")
