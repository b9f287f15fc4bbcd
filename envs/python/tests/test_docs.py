"""The documents say what happens: their blocks are run, and what they show is what was printed.

A block ``python`` is run in the namespace of those before it. A block ``text`` that follows it is its output. A block
``sh`` is run if each of its lines is a command of ``cvar-game``. These, and blocks that begin with ``# slow``, need
minutes or another library: they are run by ``pytest -m slow``, and what they print may differ between machines.
"""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[3]
DOCUMENTS = ("docs/python.md", "envs/python/README.md")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A block of a document."""

    language: str
    text: str
    line: int
    shown: str | None

    @property
    def slow(self) -> bool:
        return self.language == "sh" or self.text.startswith("# slow")


def blocks(text: str) -> Iterator[Block]:
    """The blocks of a document with the outputs that it shows."""
    found = list(FENCE.finditer(text))
    for at, match in enumerate(found):
        language, content = match.groups()
        following = found[at + 1] if at + 1 < len(found) else None
        shown = following[2] if following is not None and following[1] == "text" else None
        yield Block(language, content, text.count("\n", 0, match.start()) + 2, shown)


def run(block: Block, names: dict[str, Any], document: str) -> str:
    """What a block prints. Its line numbers are those of the document."""
    if block.language == "sh":
        commands = block.text.splitlines()
        if all(command.startswith("cvar-game ") for command in commands):
            for command in commands:
                subprocess.run(command, shell=True, check=True, capture_output=True)
        return ""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile("\n" * (block.line - 1) + block.text, document, "exec"), names)
    return printed.getvalue()


def run_all(document: str, slow: bool) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks((REPOSITORY / document).read_text(encoding="utf-8")):
        if block.language not in ("python", "sh") or (block.slow and not slow):
            continue
        printed = run(block, names, document)
        if block.language == "python" and not block.slow:
            assert printed == (block.shown or ""), f"{document}, line {block.line}"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_the_blocks_print_what_the_document_shows(
    document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pettingzoo")
    pytest.importorskip("gymnasium", "1.2.2")
    monkeypatch.chdir(tmp_path)
    run_all(document, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS)
def test_the_slow_blocks_run(
    document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3", exc_type=ImportError)
    # More threads than free cores wait for one another.
    pytest.importorskip("torch").set_num_threads(1)
    monkeypatch.chdir(tmp_path)
    run_all(document, slow=True)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document: str) -> None:
    path = REPOSITORY / document
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (path.parent / target).exists(), target
