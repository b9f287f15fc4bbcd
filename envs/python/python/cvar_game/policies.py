"""Policies: what counts as one, and how it becomes a table."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cvar_game._arguments import MOST_NUMBERS, array_of, require_room, shown

if TYPE_CHECKING:
    from cvar_game.worlds import World

Array = npt.NDArray[Any]

VIEWS = ("coordinates", "features")


def features_of(observation: str) -> bool:
    """Whether an ``observation`` option means features."""
    if not isinstance(observation, str) or observation not in VIEWS:
        raise ValueError(f"observation = {shown(observation)}: use 'coordinates' or 'features'")
    return observation == "features"


def chooser(policy: Any, world: World) -> Callable[[Array], Array]:
    """A policy as a function from observations, shape ``(n, width)``, to an array of actions.

    A policy is such a function itself, or has a method ``predict(observations, deterministic=True)``
    that returns ``(actions, state)``, as those of Stable-Baselines3 do.
    """
    if hasattr(policy, "predict"):

        def ask(observations: Array) -> Any:
            answer = policy.predict(observations, deterministic=True)
            try:
                return answer[0]
            except (IndexError, KeyError, TypeError):
                raise ValueError("predict(observations) must return (actions, state)") from None

    elif callable(policy):
        ask = policy
    else:
        raise ValueError(
            "a policy must be a table, a function of observations, or have predict(observations)"
        )

    def choose(observations: Array) -> Array:
        return as_actions(ask(observations), world.actions, len(observations))

    return choose


def as_actions(actions: Any, count: int | None, slots: int) -> Array:
    """Actions as the array that the worlds take, for so many slots."""
    array = array_of("actions", actions)
    if not array.flags.aligned:
        array = array.copy()
    if array.dtype == np.int64 and array.shape == (slots,) and count is not None:
        return array
    shape = (slots,) if count is not None else (slots, 2)
    if count is not None and array.shape == (slots, 1):
        array = array[:, 0]
    if array.shape != shape:
        raise ValueError(f"actions must have shape {shape}, got {array.shape}")
    if count is None:
        if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise ValueError(f"actions must be real numbers, got {array.dtype}")
        return np.ascontiguousarray(array, dtype=np.float64)
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"actions must be integers, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=np.int64)


def tabulate(
    policy: Any,
    world: World | str,
    *,
    observation: str = "coordinates",
    time: bool = False,
    **constants: Any,
) -> npt.NDArray[np.float64]:
    """The table of a deterministic policy in a finite world, asked in every state.

    Args:
        policy: A function of observations, or an object with ``predict``.
        world: A world, or its name.
        observation: How the policy sees the world, as in the environments.
        time: Whether it sees the time; it is then asked at every time.
        constants: Constants of the world.

    Returns:
        Action probabilities, 0 or 1, shape ``(states, actions)``, or ``(horizon, states, actions)``
        with ``time``.
    """
    from cvar_game.worlds import World

    world = World.of(world, constants)
    if world.states is None or world.actions is None:
        raise ValueError(f"{world.name} has no finite number of states")
    choose = chooser(policy, world)
    times = world.horizon if time else 1
    if times * world.states * world.actions > MOST_NUMBERS:
        raise ValueError(f"the table is too large: {times} x {world.states} x {world.actions}")
    require_room(world.states, world._core.sight_width(features_of(observation), time))
    tables = []
    for at in range(times):
        seen = world._core.sights(features_of(observation), time, at)
        table = np.zeros((world.states, world.actions))
        chosen = choose(seen)
        wrong = chosen[(chosen < 0) | (chosen >= world.actions)]
        if len(wrong) > 0:
            raise ValueError(f"action {wrong[0]} does not exist; use 0 to {world.actions - 1}")
        table[np.arange(world.states), chosen] = 1.0
        tables.append(table)
    return np.stack(tables) if time else tables[0]
