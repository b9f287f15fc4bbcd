"""The game, by PettingZoo's checkers and by its own rules."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from conftest import WORLDS

pytest.importorskip("pettingzoo")
from pettingzoo.test import api_test, render_test, seed_test

from cvar_game.game import ANTAGONIST, PROTAGONIST, LavaGame, env

FAMILIES = [("lava-grid", "softmax", 1), ("lava-point", "bumps", 1), ("lava-point", "probits", 3)]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("view", ["coordinates", "features"])
def test_pettingzoo_finds_nothing_wrong(world: str, view: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Velocities and log-budgets have no bound, and a perturbation's parameters neither.
        warnings.filterwarnings("ignore", message=".*(minimum|maximum|infinity|inf).*")
        # The players have names and no numbers, and differ in what they see and do.
        warnings.filterwarnings("ignore", message="We recommend agents to be named.*")
        warnings.filterwarnings("ignore", message="Agents have different .* space sizes")
        warnings.filterwarnings("ignore", message="Observations are different shapes")
        api_test(LavaGame(world, observation=view, time=True), num_cycles=500)
    seed_test(lambda: LavaGame(world, observation=view), num_cycles=200)


@pytest.mark.parametrize("world", WORLDS)
def test_pettingzoo_can_render(world: str) -> None:
    checks = {"rgb_array": lambda frame: isinstance(frame, np.ndarray) and frame.ndim == 3}
    render_test(lambda render_mode: env(world=world, render_mode=render_mode), checks)


@pytest.mark.parametrize(("world", "family", "components"), FAMILIES)
def test_the_budget_is_never_exceeded(world: str, family: str, components: int) -> None:
    eta = 9.0
    game = LavaGame(world, eta, family=family, components=components)
    random = np.random.default_rng(5)
    for episode in range(200):
        game.reset(seed=7 if episode == 0 else None)
        product, total = 1.0, {PROTAGONIST: 0.0, ANTAGONIST: 0.0}
        for agent in game.agent_iter():
            _, _, terminated, truncated, info = game.last()
            assert not truncated
            if terminated:
                game.step(None)
                continue
            if agent == PROTAGONIST:
                game.step(random.integers(4) if world == "lava-grid" else random.normal(size=2))
                continue
            game.step(random.normal(scale=5.0, size=game.action_space(agent).shape))
            for player, reward in game.rewards.items():
                total[player] += reward
            product *= game.infos[PROTAGONIST]["likelihood_ratio"]
            assert product <= eta * (1 + 1e-9)
            assert game.infos[PROTAGONIST]["budget"] == pytest.approx(eta / product, rel=1e-9)
        assert total[PROTAGONIST] == -total[ANTAGONIST]


def test_at_eta_1_the_antagonist_changes_nothing() -> None:
    def returns(action: Any) -> list[float]:
        game, rewards = LavaGame("lava-grid", 1.0), []
        game.reset(seed=3)
        for agent in game.agent_iter(200):
            if game.last()[2]:
                break
            game.step(1 if agent == PROTAGONIST else action)
            rewards.append(game.rewards[PROTAGONIST])
        return rewards

    assert returns(np.zeros(4)) == returns(np.array([50.0, -50.0, 9.0, 0.0]))


def test_bad_actions_are_refused() -> None:
    game = LavaGame("lava-grid")
    game.reset(seed=1)
    with pytest.raises(ValueError, match="action 4"):
        game.step(4)
    game.step(1)
    with pytest.raises(ValueError, match="shape"):
        game.step(np.zeros(3))
    with pytest.raises(ValueError, match="finite"):
        game.step(np.full(4, np.nan))
    with pytest.raises(ValueError, match="components"):
        LavaGame("lava-point", components=4)
    with pytest.raises(ValueError, match="softmax"):
        LavaGame("lava-grid", family="bumps")
    # No budget can pay for it.
    with pytest.raises(ValueError, match="without a bound"):
        LavaGame("lava-point", family="shift")
