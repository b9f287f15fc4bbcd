"""Trains TQC of sb3-contrib on lava-point, measures its policy, and records it for the tables of cvar-game.

    python examples/python/sb3_tqc.py --seed 1 --out mine
    cvar-game table mine

TQC (truncated quantile critics) learns quantiles of the return that follows each push, and leaves the highest
ones out against overestimation. ``--drop 20`` leaves out 20 of 25, so that the policy looks at the lowest fifth.
In each step it looks at the worst of the future alone, which is not the CVaR of the whole return; the regret
says what that costs.

It needs sb3-contrib.
"""

from __future__ import annotations

import argparse
import time

import torch
from sb3_adapter import LavaVecEnv
from sb3_contrib import TQC
from stable_baselines3.common.vec_env import VecMonitor

import cvar_game

SLOTS, STEPS, QUANTILES = 32, 100_000, 25


def train(seed: int, steps: int = STEPS, drop: int = 2, verbose: int = 0) -> TQC:
    """TQC after so many steps on lava-point; its critics drop so many of the highest quantiles each."""
    torch.set_num_threads(1)
    model = TQC(
        "MlpPolicy",
        VecMonitor(LavaVecEnv("lava-point", SLOTS)),
        learning_rate=1e-3,
        buffer_size=100_000,
        learning_starts=2_000,
        batch_size=256,
        # With 1 and without the time, waiting until the limit seems cheap.
        gamma=0.99,
        train_freq=1,
        gradient_steps=4,
        # Returns are as small as 1: the default bonus for entropy drowns them.
        ent_coef="auto_0.01",
        target_entropy=-4.0,
        top_quantiles_to_drop_per_net=drop,
        policy_kwargs={"net_arch": [64, 64], "n_quantiles": QUANTILES, "n_critics": 2},
        seed=seed,
        device="cpu",
        verbose=verbose,
    )
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
