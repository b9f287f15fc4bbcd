"""Worlds, games and exact yardsticks for risk-sensitive reinforcement learning.

    import cvar_game

    policy = cvar_game.exact("lava-grid", eta=25).policy      # or your own
    print(cvar_game.evaluate(policy, "lava-grid", eta=25))

Importing it registers ``cvar_game/LavaGrid-v0`` and ``cvar_game/LavaPoint-v0`` with Gymnasium.
"""

from cvar_game._registration import register
from cvar_game.envs import LavaEnv, LavaVectorEnv
from cvar_game.mdp import BudgetedAntagonist, FiniteMDP
from cvar_game.policies import tabulate
from cvar_game.results import Run, load, record, results
from cvar_game.worlds import World, WorstCase, scenes, worlds
from cvar_game.yardsticks import (
    Evaluation,
    Exact,
    Exploitability,
    evaluate,
    exact,
    exploitability,
    regret,
    worst_case,
)

register()

__all__ = [
    "BudgetedAntagonist",
    "Evaluation",
    "Exact",
    "Exploitability",
    "FiniteMDP",
    "LavaEnv",
    "LavaVectorEnv",
    "Run",
    "World",
    "WorstCase",
    "evaluate",
    "exact",
    "exploitability",
    "load",
    "record",
    "regret",
    "results",
    "scenes",
    "tabulate",
    "worlds",
    "worst_case",
]
