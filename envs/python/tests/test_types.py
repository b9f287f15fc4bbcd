"""The types: the stubs of the native module say what it is, and the package passes the strict checks of mypy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy")

PACKAGE = Path(__file__).parents[1]


def check(*arguments: str) -> None:
    """Runs a module of Python in the package's folder, where mypy finds its settings."""
    command = [sys.executable, "-m", *arguments]
    done = subprocess.run(command, cwd=PACKAGE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_stubs_say_what_the_native_module_is() -> None:
    check("mypy.stubtest", "cvar_game._core", "--mypy-config-file", "pyproject.toml")


def test_the_package_is_strictly_typed() -> None:
    check("mypy", "--strict", "python/cvar_game")
