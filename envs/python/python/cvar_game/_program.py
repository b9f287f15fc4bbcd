"""The command `cvar-game`."""

from __future__ import annotations

import shutil
import sys

from cvar_game._core import program


def main() -> int:
    """Runs the program with the arguments of this process.

    Its workers are started by the same command.
    """
    path = shutil.which(sys.argv[0]) or sys.argv[0]
    return program([path, *sys.argv[1:]])
