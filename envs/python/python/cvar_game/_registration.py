"""The environments' names in Gymnasium."""

from __future__ import annotations

import gymnasium

ENVIRONMENTS = {"lava-grid": "cvar_game/LavaGrid-v0", "lava-point": "cvar_game/LavaPoint-v0"}


def register() -> None:
    """Registers an environment, and its native vector form, for each world."""
    for world, name in ENVIRONMENTS.items():
        gymnasium.register(
            id=name,
            entry_point="cvar_game.envs:LavaEnv",
            vector_entry_point="cvar_game.envs:LavaVectorEnv",
            kwargs={"world": world},
            # The time limit is a true end of the episode, and the world's own.
            max_episode_steps=None,
        )
