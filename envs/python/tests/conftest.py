"""Trained runs for the tests: short ones, made once by the installed program."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

WORLDS = ("lava-grid", "lava-point")


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with a short run of each world at eta = 25."""
    folder = tmp_path_factory.mktemp("runs")
    program = shutil.which("cvar-game")
    assert program, "install the package first"
    for world in WORLDS:
        options = ["--set", "evaluation.episodes=1000", "--set", "evaluation.figure_episodes=1000"]
        command = [program, "train", "--env", world, "--eta", "25", "--seed", "1", "--steps", "100000"]
        done = subprocess.run(
            [*command, *options, "--out", str(folder)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    return folder


def folder_of(runs: Path, world: str) -> Path:
    """The run's own folder."""
    return runs / world / "game" / "eta-25" / "seed-1"
