"""A batch of cvar-game's episodes as a vectorised environment of Stable-Baselines3.

    env = LavaVecEnv("lava-point", num_envs=250)
    model = stable_baselines3.PPO("MlpPolicy", env)

Stable-Baselines3 steps a list of environments one after the other. This class hands it the native batch in
their place, whose slots take a step together in one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from cvar_game import LavaVectorEnv


class LavaVecEnv(VecEnv):
    """Episodes of a world; an ended one is followed by the next one in the same step.

    Args:
        world: Name of the world, or a ``cvar_game.World``.
        num_envs: Number of slots.
        options: Other arguments of ``cvar_game.LavaVectorEnv``, such as ``observation`` and ``opponent``.
    """

    def __init__(self, world: Any, num_envs: int = 250, **options: Any) -> None:
        # A learner needs no more of the infos than the last observation of an episode.
        self.batch = LavaVectorEnv(
            num_envs, world, autoreset_mode="SameStep", info=False, **options
        )
        self.render_mode = self.batch.render_mode
        super().__init__(
            num_envs, self.batch.single_observation_space, self.batch.single_action_space
        )

    def reset(self) -> Any:
        """Starts episodes in all slots, by the seeds of ``seed()`` if it was called."""
        observations, _ = self.batch.reset(seed=self._seeds)
        self._reset_seeds()
        return observations

    def step_async(self, actions: Any) -> None:
        """Takes the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Takes the step. The time limit is a true end: nothing is bootstrapped there."""
        observations, rewards, ended, _, batch_infos = self.batch.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for slot in np.flatnonzero(ended):
            infos[slot]["terminal_observation"] = batch_infos["final_obs"][slot]
        return observations, rewards.astype(np.float32), ended, infos

    def get_images(self) -> Sequence[Any]:
        """A frame per slot."""
        return self.batch.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, once for each of the slots."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """The slots share their attributes."""
        raise NotImplementedError("the slots of a native batch have no attributes of their own")

    def env_method(self, method_name: str, *_: Any, indices: Any = None, **__: Any) -> list[Any]:
        """The slots have no methods."""
        raise NotImplementedError("the slots of a native batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No slot is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def close(self) -> None:
        """Ends the use of the batch."""
        self.batch.close()
