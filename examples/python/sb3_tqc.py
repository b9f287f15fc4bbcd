"""Trains TQC of sb3-contrib on lava-point, measures its policy, and records it for the tables of cvar-game.

    python examples/python/sb3_tqc.py --seed 1 --out mine
    cvar-game table mine

TQC (truncated quantile critics) learns quantiles of the return that follows each push, and leaves the highest
ones out against overestimation. ``--drop 20`` leaves out 20 of 25, so that the policy looks at the lowest fifth.
In each step it looks at the worst of the future alone, which is not the CVaR of the whole return; the regret
says what that costs.

Random pushes do not meet the goal often enough for it, so that its replay begins with the steps of a script.

It needs sb3-contrib.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from sb3_adapter import LavaVecEnv
from sb3_contrib import TQC
from stable_baselines3.common.vec_env import VecMonitor

import cvar_game

SLOTS, STEPS, QUANTILES = 32, 50_000, 25

# Steps of the script in the replay, and the standard deviation of what is added to its pushes.
SCRIPTED, NOISE = 20_000, 0.5


def script(observations: Any) -> Any:
    """Up, right above the lava, down: pushes for observations of shape ``(slots, 4)``."""
    x, y = observations[:, 0], observations[:, 1]  # in [-1, 1]
    across = (y > 0.2) & (x < 0.75)
    down = x >= 0.75
    up = np.where(down, -1.0, np.where(across, 0.0, 1.0))
    return np.stack([np.where(across | down, 1.0, 0.0), up], axis=1)


def demonstrate(model: TQC, seed: int) -> None:
    """Fills the replay with steps of the script."""
    env, random = model.get_env(), np.random.default_rng(seed)
    assert env is not None and model.replay_buffer is not None
    seen = env.reset()
    for _ in range(SCRIPTED // SLOTS):
        pushes = np.clip(script(seen) + NOISE * random.normal(size=(SLOTS, 2)), -1.0, 1.0)
        new, rewards, ended, infos = env.step(pushes)
        after = np.array(new)
        for slot in np.flatnonzero(ended):
            after[slot] = infos[slot]["terminal_observation"]
        model.replay_buffer.add(seen, after, pushes, rewards, ended, infos)
        seen = new


def train(seed: int, steps: int = STEPS, drop: int = 2, verbose: int = 0) -> TQC:
    """TQC after so many steps on lava-point; its critics drop so many of the highest quantiles each."""
    torch.set_num_threads(1)
    model = TQC(
        "MlpPolicy",
        VecMonitor(LavaVecEnv("lava-point", SLOTS)),
        learning_rate=1e-3,
        buffer_size=steps + SCRIPTED,
        learning_starts=0,
        batch_size=256,
        # With 1 and without the time, waiting until the limit seems cheap.
        gamma=0.99,
        train_freq=1,
        gradient_steps=4,
        # Returns are as small as 1: a larger bonus for entropy drowns them.
        ent_coef=0.002,
        top_quantiles_to_drop_per_net=drop,
        policy_kwargs={"net_arch": [64, 64], "n_quantiles": QUANTILES, "n_critics": 2},
        seed=seed,
        device="cpu",
        verbose=verbose,
    )
    demonstrate(model, seed)
    return model.learn(steps, log_interval=1_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--eta", type=float, default=25.0, help="budget at which it is measured")
    parser.add_argument("--drop", type=int, default=2, help="highest quantiles to leave out, of 25")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=STEPS, help="environment steps")
    parser.add_argument("--out", default="mine", help="results folder")
    options = parser.parse_args()

    start = time.perf_counter()
    model = train(options.seed, options.steps, options.drop, verbose=1)
    seconds = time.perf_counter() - start
    print(f"seed {options.seed}: {model.num_timesteps:,} steps in {seconds:.1f} s")
    found = cvar_game.record(
        model,
        "lava-point",
        options.eta,
        options.out,
        method=f"sb3-tqc/drop-{options.drop}",
        seed=options.seed,
        steps=model.num_timesteps,
        seconds=seconds,
    )
    print(found)


if __name__ == "__main__":
    main()
