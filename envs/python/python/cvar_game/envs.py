"""The worlds as Gymnasium environments: one episode at a time, or a batch of them stepped natively.

Both are one implementation, so that a batch is what its slots are one by one.

An episode that reaches the time limit is ``terminated``, never ``truncated``: the limit is part of the
task (the policy's value ends there, and nothing is bootstrapped).

Chance is reproducible: the k-th episode after ``reset(seed=s)`` meets the same chance as episode k of
``cvar-game rollout RUN --seed s``, whatever the number of slots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from cvar_game import _core
from cvar_game._arguments import MOST_EPISODES, array_of, eta_of, require_room, seed_of, shown, whole
from cvar_game.policies import as_actions, features_of
from cvar_game.rendering import ansi
from cvar_game.worlds import Opponent, World, core_opponent, is_nominal

Array = npt.NDArray[Any]

RENDER_MODES = ("ansi", "rgb_array")
FRAMES_PER_SECOND = 10


def observation_space(world: World, observation: str, time: bool) -> gym.spaces.Box:
    """What a protagonist sees: numbers in [-1, 1], but for velocities, which have no bound."""
    features = features_of(observation)
    width = world._core.sight_width(features, time)
    low, high = np.full(width, -1.0, np.float32), np.full(width, 1.0, np.float32)
    if features and world.states is not None:
        low[: world.states] = 0.0
    else:
        unbounded = slice(world._positions, world._observation)
        low[unbounded], high[unbounded] = -np.inf, np.inf
    return gym.spaces.Box(low, high, dtype=np.float32)


def action_space(world: World) -> gym.spaces.Space[Any]:
    """Moves, or pushes: those beyond the unit disc are scaled onto it."""
    if world.actions is not None:
        return gym.spaces.Discrete(world.actions)
    return gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)


def check_render_mode(mode: str | None, modes: Sequence[str] = RENDER_MODES) -> str | None:
    """Refuses a render mode that there is not."""
    if mode is not None and not (isinstance(mode, str) and mode in modes):
        names = " or ".join(repr(of) for of in modes)
        raise ValueError(f"render_mode = {shown(mode)}: use None, {names}")
    return mode


def resolve_eta(eta: float | None, opponent: Opponent) -> float:
    """The budget: a trained run's own if none is given, and 1 for chance itself."""
    from cvar_game.results import Run, load

    if eta is not None:
        return eta_of(eta)
    if opponent is None or is_nominal(opponent):
        return 1.0
    if isinstance(opponent, Run):
        return opponent.eta
    if not hasattr(opponent, "policy"):
        return load(opponent).eta
    raise ValueError("the worst case of a policy needs its budget: eta=...")


class LavaEnv(gym.Env[Array, Any]):
    """A world as an environment, ``gym.make("cvar_game/LavaGrid-v0")`` or ``"cvar_game/LavaPoint-v0"``.

    Args:
        world: Name of the world, or a :class:`World`.
        observation: ``"coordinates"``, the paper's few numbers, or ``"features"``: the state one-hot on
            lava-grid, a Fourier basis of the position besides on lava-point.
        time: Whether an observation shows the time.
        opponent: Who decides chance: ``None`` for chance itself, a :class:`WorstCase`, or a trained
            run, whose antagonist it is then.
        eta: Budget of the opponent, at least 1. By default that of the trained run.
        render_mode: ``None``, ``"ansi"`` or ``"rgb_array"``.
        constants: Constants of the world, such as ``slip=0.1``.

    Observations have shape ``(width,)`` and type float32. Actions are 0 up, 1 down, 2 right, 3 left on
    lava-grid, and pushes of shape ``(2,)`` on lava-point, 1 being the largest one.

    ``info`` has, after a reset, ``clearance``: the distance to lava (cells or metres). After a step it has
    besides ``outcome``: what chance decided (the executed move; the noise in standard deviations),
    ``nominal``: the nominal probabilities of all outcomes, shape ``(4,)``, on lava-grid (the noise of
    lava-point is standard normal), ``likelihood_ratio``: delta of the outcome, 1 under chance itself,
    ``budget``: what is left of eta, and ``end``: 0 not yet, 1 goal, 2 lava, 3 time limit.
    """

    metadata: dict[str, Any] = {
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        world: str | World = "lava-grid",
        *,
        observation: str = "coordinates",
        time: bool = False,
        opponent: Opponent = None,
        eta: float | None = None,
        render_mode: str | None = None,
        **constants: Any,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.world = World.of(world, constants)
        self.observation_space = observation_space(self.world, observation, time)
        self.action_space = action_space(self.world)
        self._games = _core.Games(
            self.world._core,
            slots=1,
            features=features_of(observation),
            time=time,
            eta=resolve_eta(eta, opponent),
            opponent=core_opponent(opponent),
            autoreset="disabled",
        )
        self._trail: list[Array] = []
        self._seeded = self._open = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Starts the first episode of a seed, or the next one."""
        seed = None if seed is None else seed_of(seed)
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(2**63))
        self._seeded = self._open = True
        observation = self._games.reset([0], None if seed is None else [seed])
        self._trail.clear()
        self._follow()
        return observation[0], {"clearance": float(self._games.clearance()[0])}

    def step(self, action: Any) -> tuple[Array, SupportsFloat, bool, bool, dict[str, Any]]:
        """One step; see the class for ``info``."""
        if not self._open:
            raise ValueError("reset() the environment first; a closed one cannot be stepped")
        actions = as_actions(array_of("actions", action)[None], self.world.actions, 1)
        observation, reward, terminated, _, infos = self._games.step(actions)
        self._follow()
        info = {key: values[0] for key, values in infos.items() if key[0] != "_"}
        info |= {key: info[key].item() for key in ("clearance", "likelihood_ratio", "budget", "end")}
        return observation[0], float(reward[0]), bool(terminated[0]), False, info

    def render(self) -> Any:
        """The scene with the way of the episode: text, or pixels of shape ``(height, width, 3)``."""
        if self.render_mode == "ansi":
            return ansi(self.world, self._trail)
        if self.render_mode == "rgb_array":
            return self.world._core.picture(np.array(self._trail).reshape(-1, 2))
        return None

    def close(self) -> None:
        """Ends the use of the environment."""
        self._open = False

    def snapshot(self) -> bytes:
        """All that the rest of the episode depends on."""
        return bytes(self._games.snapshot(0))

    def restore(self, snapshot: bytes) -> None:
        """Continues where a snapshot was taken, in an environment with the same arguments.

        Raises:
            ValueError: If it is none of this world.
        """
        self._games.restore(0, snapshot)
        self._seeded = self._open = True
        self._trail.clear()
        self._follow()

    def _follow(self) -> None:
        if self.render_mode is not None:
            self._trail.append(self._games.positions()[0])


class LavaVectorEnv(gym.vector.VectorEnv[Array, Any, Array]):
    """A batch of episodes of a world, stepped natively: ``gym.make_vec("cvar_game/LavaGrid-v0", num_envs=1024)``.

    Args:
        num_envs: Number of slots.
        world, observation, time, opponent, eta, constants: As those of :class:`LavaEnv`.
        autoreset_mode: When an ended episode is followed by the next one: Gymnasium's ``NEXT_STEP``,
            ``SAME_STEP`` or ``DISABLED``.
        render_mode: As that of :class:`LavaEnv`; ``render()`` returns a frame per slot.
        info: Whether a step tells more than the clearance, which takes a sixth of the time on lava-grid.

    Every array that it returns is a new one. The interpreter is released while the batch is stepped.
    """

    metadata: dict[str, Any] = {
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        num_envs: int = 1,
        world: str | World = "lava-grid",
        *,
        observation: str = "coordinates",
        time: bool = False,
        opponent: Opponent = None,
        eta: float | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        info: bool = True,
        **constants: Any,
    ) -> None:
        super().__init__()
        num_envs = whole("num_envs", num_envs, 1, MOST_EPISODES)
        self.render_mode = check_render_mode(render_mode)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.world = World.of(world, constants)
        self.num_envs = num_envs
        self.single_observation_space = observation_space(self.world, observation, time)
        require_room(num_envs, self.single_observation_space.shape[0])
        self.single_action_space = action_space(self.world)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._games = _core.Games(
            self.world._core,
            slots=self.num_envs,
            features=features_of(observation),
            time=time,
            eta=resolve_eta(eta, opponent),
            opponent=core_opponent(opponent),
            autoreset={
                AutoresetMode.NEXT_STEP: "next-step",
                AutoresetMode.SAME_STEP: "same-step",
                AutoresetMode.DISABLED: "disabled",
            }[self.autoreset_mode],
            tells=info or self.render_mode is not None,
        )
        self._trails: list[list[Array]] = [[] for _ in range(self.num_envs)]
        self._seeded = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Starts episodes in all slots, or in those of ``options["reset_mask"]``.

        An integer ``seed`` seeds slot i with ``seed + i``; a sequence has a seed per slot, and ``None``
        starts the slot's next episode.
        """
        seeds = self._seeds(seed)
        mask = np.ones(self.num_envs, np.bool_)
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(f"options = {shown(options)} must be a dictionary")
        if options is not None and "reset_mask" in options:
            mask = _reset_mask(options["reset_mask"], self.num_envs)
        if not self._seeded:
            # The first episodes of slots without a seed follow from np_random.
            fresh = self.np_random.integers(2**63, size=self.num_envs)
            missing = zip(seeds, fresh, strict=True)
            seeds = [int(new) if old is None else old for old, new in missing]
            self._seeded = True
        slots = np.flatnonzero(mask)
        seeded = [int(slot) for slot in slots if seeds[slot] is not None]
        others = [int(slot) for slot in slots if seeds[slot] is None]
        if others:
            self._games.reset(others, None)
        observation = self._games.reset(seeded, [s for s in map(seeds.__getitem__, seeded) if s is not None])
        clearance = np.where(mask, self._games.clearance(), 0.0)
        self._follow(restarted=mask, moved=False)
        return observation, {"clearance": clearance, "_clearance": mask}

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One step of every slot; ``info`` has the arrays of :class:`LavaEnv` with their masks."""
        if self.closed or not self._seeded:
            raise ValueError("reset() the environment first; a closed one cannot be stepped")
        chosen = as_actions(actions, self.world.actions, self.num_envs)
        stepped = self._games.step(chosen)
        observation, reward, terminated, truncated, infos = stepped
        if "final_obs" in infos:
            infos["final_obs"] = _each(infos["final_obs"], terminated)
        if self.render_mode is not None:
            self._follow(restarted=~infos.get("_end", np.zeros(self.num_envs, np.bool_)), moved=True)
        return observation, reward, terminated, truncated, infos

    def render(self) -> tuple[Any, ...] | None:
        """A frame per slot, as that of :class:`LavaEnv`."""
        if self.render_mode is None:
            return None
        if self.render_mode == "ansi":
            return tuple(ansi(self.world, trail) for trail in self._trails)
        picture = self.world._core.picture
        return tuple(picture(np.array(trail).reshape(-1, 2)) for trail in self._trails)

    def snapshot(self, slot: int) -> bytes:
        """All that the rest of a slot's episode depends on."""
        return bytes(self._games.snapshot(whole("slot", slot, 0, self.num_envs - 1)))

    def restore(self, slot: int, snapshot: bytes) -> None:
        """Continues where a snapshot was taken, in an environment with the same arguments."""
        slot = whole("slot", slot, 0, self.num_envs - 1)
        self._games.restore(slot, snapshot)
        self._seeded = True
        mask = np.zeros(self.num_envs, np.bool_)
        mask[slot] = True
        self._follow(restarted=mask, moved=False)

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            seeds = [seed_of(int(seed) + slot) for slot in range(self.num_envs)]
            self._np_random, self._np_random_seed = gym.utils.seeding.np_random(int(seed))
            return [*seeds]
        if len(seed) != self.num_envs:
            raise ValueError(f"there must be {self.num_envs} seeds, got {len(seed)}")
        return [None if of is None else seed_of(of) for of in seed]

    def _follow(self, restarted: Array, moved: bool) -> None:
        if self.render_mode is None:
            return
        for slot, position in enumerate(self._games.positions()):
            if restarted[slot]:
                self._trails[slot].clear()
            if restarted[slot] or moved:
                self._trails[slot].append(position)


def _each(rows: Array, ended: Array) -> Array:
    """The rows of some slots, each an array of its own; ``None`` in the others."""
    each = np.full(len(rows), None, dtype=object)
    for slot in np.flatnonzero(ended):
        each[slot] = rows[slot].copy()
    return each


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    modes = {of.value: of for of in AutoresetMode}
    if isinstance(mode, AutoresetMode):
        return mode
    if isinstance(mode, str) and mode in modes:
        return modes[mode]
    names = ", ".join(map(repr, modes))
    raise ValueError(f"autoreset_mode = {shown(mode)}: use one of {names}")


def _reset_mask(mask: Any, slots: int) -> Array:
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (slots,):
        raise ValueError(f"options['reset_mask'] must be an array of bool of shape ({slots},)")
    if not mask.any():
        raise ValueError("options['reset_mask'] must select at least one slot")
    return mask
