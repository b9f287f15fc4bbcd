"""Trains QR-DQN of sb3-contrib on lava-grid, and judges its policy exactly.

    python examples/python/sb3_qrdqn.py --seed 1 --out mine
    cvar-game table mine

QR-DQN learns quantiles of the return that follows each action. Its own policy takes the action whose mean
is the best. A risk-averse one takes the action whose lowest quantiles have the best mean: ``--tails 1 0.2``
measures both, from one training. In each step it looks at the worst of the future alone, which is not the CVaR
of the whole return; the regret says what that costs.

It needs sb3-contrib.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch
from sb3_adapter import LavaVecEnv
from sb3_contrib import QRDQN
from stable_baselines3.common.vec_env import VecMonitor

import cvar_game

SLOTS, STEPS, QUANTILES = 32, 200_000, 25


def train(seed: int, steps: int = STEPS, verbose: int = 0) -> QRDQN:
    """QR-DQN after so many steps on lava-grid."""
    torch.set_num_threads(1)
    model = QRDQN(
        "MlpPolicy",
        VecMonitor(LavaVecEnv("lava-grid", SLOTS, observation="features")),
        learning_rate=1e-3,
        buffer_size=50_000,
        learning_starts=2_000,
        batch_size=256,
        # With 1 and without the time, waiting until the limit seems cheap.
        gamma=0.99,
        train_freq=1,
        target_update_interval=2_000,
        exploration_fraction=0.9,
        exploration_final_eps=0.02,
        policy_kwargs={"net_arch": [64], "n_quantiles": QUANTILES},
        seed=seed,
        device="cpu",
        verbose=verbose,
    )
    return model.learn(steps, log_interval=2_000)


def table(model: QRDQN, tail: float = 1.0) -> Any:
    """A policy as a table: the action whose lowest quantiles, a share of all, have the best mean."""
    lowest = max(1, round(tail * QUANTILES))

    def choose(observations: Any) -> Any:
        with torch.no_grad():
            quantiles = model.quantile_net(torch.as_tensor(observations)).sort(dim=1).values
        return quantiles[:, :lowest].mean(dim=1).argmax(dim=1).numpy()

    return cvar_game.tabulate(choose, "lava-grid", observation="features")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--eta", type=float, default=25.0, help="budget at which it is measured")
    parser.add_argument(
        "--tails", type=float, nargs="+", default=[1.0, 0.2], help="shares of the quantiles, 1 for all"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=STEPS, help="environment steps")
    parser.add_argument("--out", default="mine", help="results folder")
    options = parser.parse_args()

    start = time.perf_counter()
    model = train(options.seed, options.steps, verbose=1)
    seconds = time.perf_counter() - start
    print(f"seed {options.seed}: {model.num_timesteps:,} steps in {seconds:.1f} s")
    for tail in options.tails:
        found = cvar_game.record(
            table(model, tail),
            "lava-grid",
            options.eta,
            options.out,
            method=f"sb3-qrdqn/tail-{tail:g}",
            seed=options.seed,
            steps=model.num_timesteps,
            seconds=seconds,
        )
        print(f"the lowest {tail:.0%} of the quantiles: {found}")


if __name__ == "__main__":
    main()
