"""Arguments: what is wrong with them is said in one line."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import numpy.typing as npt

MOST_EPISODES = 10_000_000
"""The most slots of a batch, and episodes of a play."""

MOST_NUMBERS = 2**30
"""The most numbers of an array."""

LONGEST = 100


def shown(value: object) -> str:
    """A value in the message of an error: in one line, and not too long."""
    try:
        text = repr(value)
    except Exception:
        text = f"<{type(value).__name__}>"
    text = " ".join(text.split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def number(name: str, value: object) -> float:
    """A real number, which may be infinite or none."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} = {shown(value)} must be a number") from None


def whole(name: str, value: object, least: int, most: int) -> int:
    """A whole number in a range, both ends included."""
    try:
        found = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise ValueError(f"{name} = {shown(value)} must be a whole number") from None
    if not least <= found <= most:
        raise ValueError(f"{name} = {shown(found)} must be in [{least}, {most}]")
    return found


def seed_of(value: object) -> int:
    """A seed of chance."""
    return whole("seed", value, 0, 2**64 - 1)


def eta_of(value: object) -> float:
    """A budget."""
    eta = number("eta", value)
    if not 1.0 <= eta < np.inf:
        raise ValueError(f"eta must be a finite number of at least 1, got {eta:g}")
    return eta


def require_room(rows: int, width: int) -> None:
    """Refuses more observations than memory should hold."""
    if rows * width > MOST_NUMBERS:
        raise ValueError(f"{rows} observations of {width} numbers are too many to be held; use fewer")


def array_of(name: str, values: object) -> npt.NDArray[Any]:
    """An array of any type."""
    try:
        return np.asarray(values)
    except ValueError:
        raise ValueError(f"{name} must be an array, but its rows differ in length") from None
    except (OverflowError, MemoryError, RecursionError):
        raise ValueError(f"{name} must be an array") from None


def numbers(name: str, values: object) -> npt.NDArray[np.float64]:
    """A new array of real numbers."""
    array = array_of(name, values)
    if array.size > MOST_NUMBERS:
        raise ValueError(f"{name} must have at most {MOST_NUMBERS} numbers, got {array.size}")
    try:
        if array.dtype.kind in "biufO":
            return np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name} must be an array of real numbers")
