"""Trains Stable-Baselines3's PPO in a world, measures it, and records it for the tables of cvar-game.

    python examples/python/sb3_ppo.py --seed 1 --out mine
    cvar-game table mine

PPO maximises the mean return. What it lacks in the worst cases shows as regret at a budget above 1. With
``--opponent RUN`` the antagonist of a finished run reweights chance in the second half of the steps: then the
mean that PPO maximises is that of the game. (In the first half PPO has to find the goal.)

It needs stable-baselines3.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch
from sb3_adapter import LavaVecEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import cvar_game

# An update every 10,000 steps, as in the paper; the networks are small.
SLOTS, ROLLOUT = 250, 40

COMMON: dict[str, Any] = {
    "n_steps": ROLLOUT,
    "batch_size": 2_500,
    "n_epochs": 4,
    "gamma": 1.0,
    "gae_lambda": 0.95,
}

# Options of PPO, first and last learning rate, how the policy sees the world, and steps. Whoever explores
# lava-grid learns first that lava ends the costs; the entropy bonus keeps it trying.
SETTINGS: dict[str, dict[str, Any]] = {
    "lava-grid": {
        "ppo": {"ent_coef": 0.01, "policy_kwargs": {"net_arch": [64]}},
        "rates": (5e-3, 1e-4),
        "observation": "features",
        "steps": 600_000,
    },
    "lava-point": {
        "ppo": {"ent_coef": 0.0, "policy_kwargs": {"net_arch": [64, 64]}},
        "rates": (2e-3, 1e-4),
        "observation": "coordinates",
        "steps": 2_000_000,
    },
}


def train(world: str, steps: int, seed: int, opponent: Any = None, verbose: int = 0) -> PPO:
    """PPO after so many steps in a world, rounded up to whole rollouts."""
    torch.set_num_threads(1)
    setting = SETTINGS[world]
    first, last = setting["rates"]

    def env(opponent: Any) -> VecMonitor:
        batch = LavaVecEnv(world, SLOTS, observation=setting["observation"], opponent=opponent)
        return VecMonitor(batch)

    model = PPO(
        "MlpPolicy",
        env(None),
        learning_rate=lambda left: last + (first - last) * left,
        seed=seed,
        device="cpu",
        verbose=verbose,
        **COMMON,
        **setting["ppo"],
    )
    if opponent is None:
        return model.learn(steps, log_interval=20)
    model.learn(steps // 2, log_interval=20)
    model.set_env(env(opponent))
    return model.learn(steps - steps // 2, log_interval=20, reset_num_timesteps=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--world", choices=sorted(SETTINGS), default="lava-point")
    parser.add_argument("--eta", type=float, default=25.0, help="budget at which it is measured")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, help="environment steps")
    parser.add_argument("--opponent", help="folder of a run whose antagonist decides chance")
    parser.add_argument("--out", default="mine", help="results folder")
    options = parser.parse_args()

    setting = SETTINGS[options.world]
    start = time.perf_counter()
    model = train(
        options.world, options.steps or setting["steps"], options.seed, options.opponent, verbose=1
    )
    seconds = time.perf_counter() - start
    print(f"seed {options.seed}: {model.num_timesteps:,} steps in {seconds:.1f} s")

    found = cvar_game.record(
        model,
        options.world,
        options.eta,
        options.out,
        method="sb3-ppo/opposed" if options.opponent else "sb3-ppo/plain",
        seed=options.seed,
        steps=model.num_timesteps,
        seconds=seconds,
        observation=setting["observation"],
    )
    print(found)


if __name__ == "__main__":
    main()
