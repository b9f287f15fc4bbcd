"""The two-player game as a PettingZoo environment, in which agents take turns (AEC).

In every step the protagonist chooses an action; the antagonist sees the world, that action and its remaining
budget, and reweights the law of what happens; then chance draws from the reweighted law:

1. ``protagonist``: a move or a push, as in :class:`cvar_game.LavaEnv`;
2. ``antagonist``: the parameters of a perturbation, real numbers of shape ``(k,)``. Any are admissible: the
   perturbation is mixed with chance itself so that its likelihood ratio delta_t stays within the budget
   eta_t (the paper's Eq. 5), which shrinks to eta_t / delta_t.

Rewards are the world's for the protagonist and their negatives for the antagonist.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from pettingzoo import AECEnv

from cvar_game import _core
from cvar_game._arguments import array_of, eta_of, numbers, seed_of, shown, whole
from cvar_game.envs import (
    FRAMES_PER_SECOND,
    RENDER_MODES,
    action_space,
    check_render_mode,
    observation_space,
)
from cvar_game.policies import as_actions, features_of
from cvar_game.rendering import ansi
from cvar_game.worlds import World

Array = npt.NDArray[Any]

PROTAGONIST, ANTAGONIST = "protagonist", "antagonist"

MODES = ("human", *RENDER_MODES)


class LavaGame(AECEnv[str, Array, Any]):  # type: ignore[misc]
    """The game of a world.

    Args:
        world: Name of the world, or a :class:`cvar_game.World`.
        eta: Budget of the antagonist over the whole episode, at least 1.
        observation: ``"coordinates"`` or ``"features"``, for both players.
        time: Whether both players see the time.
        family: What the antagonist's parameters mean: ``"softmax"`` on lava-grid (a logit per outcome),
            ``"bumps"`` or ``"probits"`` on lava-point; ``"auto"`` is the first that fits.
        components: Number of bumps or probits, 1 to 3.
        render_mode: ``None``, ``"ansi"``, ``"rgb_array"``, or ``"human"``, which prints the text.
        constants: Constants of the world.

    The antagonist's observation ends with log eta_t / log eta and, with ``time``, the time.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "cvar_game_v0",
        "render_modes": list(MODES),
        "render_fps": FRAMES_PER_SECOND,
        "is_parallelizable": False,
    }

    def __init__(
        self,
        world: str | World = "lava-grid",
        eta: float = 25.0,
        *,
        observation: str = "coordinates",
        time: bool = False,
        family: str = "auto",
        components: int = 1,
        render_mode: str | None = None,
        **constants: Any,
    ) -> None:
        super().__init__()
        self.render_mode = check_render_mode(render_mode, MODES)
        self.world = World.of(world, constants)
        self.possible_agents = [PROTAGONIST, ANTAGONIST]
        self._games = _core.Games(
            self.world._core,
            slots=1,
            features=features_of(observation),
            time=time,
            eta=eta_of(eta),
            opponent=_core.Opponent.played(family, whole("components", components, 1, 3), 4.0, 50.0),
            autoreset="disabled",
        )
        unbounded: dict[str, Any] = {"low": -np.inf, "high": np.inf, "dtype": np.float32}
        self.observation_spaces = {
            PROTAGONIST: observation_space(self.world, observation, time),
            ANTAGONIST: gym.spaces.Box(shape=(self._games.situation_size,), **unbounded),
        }
        self.action_spaces = {
            PROTAGONIST: action_space(self.world),
            ANTAGONIST: gym.spaces.Box(shape=(self._games.parameters,), **unbounded),
        }
        self._seeds = np.random.default_rng()
        self._seeded = False
        self._trail: list[Array] = []
        self.agents: list[str] = []
        self.agent_selection = PROTAGONIST

    def observation_space(self, agent: str) -> gym.spaces.Space[Any]:
        """What an agent sees."""
        return self.observation_spaces[_agent(agent)]

    def action_space(self, agent: str) -> gym.spaces.Space[Any]:
        """What an agent chooses from."""
        return self.action_spaces[_agent(agent)]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Starts the first episode of a seed, or the next one."""
        seed = None if seed is None else seed_of(seed)
        if seed is None and not self._seeded:
            seed = int(self._seeds.integers(2**63))
        self._seeded = True
        sight = self._games.reset([0], None if seed is None else [seed])
        self.agents = self.possible_agents[:]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        blind = np.zeros(self._games.situation_size, np.float32)
        self._sights: dict[str, Array] = {PROTAGONIST: sight[0], ANTAGONIST: blind}
        self._chosen: Array | None = None
        self.agent_selection = PROTAGONIST
        self._trail = [self._games.positions()[0]]

    def observe(self, agent: str) -> Array:
        """What an agent sees; for the antagonist, zeros before the protagonist's first action."""
        if not self._seeded:
            raise ValueError("reset() the game first")
        return self._sights[_agent(agent)].copy()

    def step(self, action: Any) -> None:
        """The turn of ``agent_selection``."""
        if not self.agents:
            raise ValueError("reset() the game first: no episode is running")
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        if agent == PROTAGONIST:
            self._chosen = as_actions(array_of("actions", action)[None], self.world.actions, 1)
            self._sights[ANTAGONIST] = self._games.situation(self._chosen)[0]
            self.rewards = dict.fromkeys(self.agents, 0.0)
            self.agent_selection = ANTAGONIST
            return
        assert self._chosen is not None  # it is the antagonist's turn
        parameters = numbers("the antagonist's action", action).astype(np.float32)
        if parameters.shape != (self._games.parameters,):
            raise ValueError(
                f"the antagonist's action must have shape ({self._games.parameters},), got "
                f"{parameters.shape}"
            )
        sight, reward, terminated, _, infos = self._games.step(self._chosen, parameters[None])
        self._sights[PROTAGONIST] = sight[0]
        self.rewards = {PROTAGONIST: float(reward[0]), ANTAGONIST: -float(reward[0])}
        self.terminations = dict.fromkeys(self.agents, bool(terminated[0]))
        info = {key: values[0] for key, values in infos.items() if key[0] != "_"}
        self.infos = {of: dict(info) for of in self.agents}
        self.agent_selection = PROTAGONIST
        self._trail.append(self._games.positions()[0])
        self._accumulate_rewards()

    def render(self) -> Any:
        """The scene with the way of the episode, as in :class:`cvar_game.LavaEnv`."""
        if self.render_mode == "human":
            print(ansi(self.world, self._trail))
        if self.render_mode == "ansi":
            return ansi(self.world, self._trail)
        if self.render_mode == "rgb_array":
            return self.world._core.picture(np.array(self._trail).reshape(-1, 2))
        return None

    def close(self) -> None:
        """Nothing is left open."""


def _agent(agent: str) -> str:
    if isinstance(agent, str) and agent in (PROTAGONIST, ANTAGONIST):
        return agent
    raise ValueError(f"there is no agent {shown(agent)}; there are {PROTAGONIST} and {ANTAGONIST}")


def env(**options: Any) -> LavaGame:
    """The game, as PettingZoo's modules name their constructors; see :class:`LavaGame`."""
    return LavaGame(**options)
