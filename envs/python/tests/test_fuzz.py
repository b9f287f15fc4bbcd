"""Hostile arguments: whatever is wrong with them, every public entry answers with a ``ValueError`` of one line,
or with a ``TypeError`` where a type is wrong; never with a panic, a crash or a hang.

A case is a good call of which some arguments are replaced by bad ones, or a file of which some bytes are. It takes
some 20 seconds and is always the same. With the environment variable FUZZ_MINUTES=10 it takes 10 minutes in
total, for cases that are new each time. FUZZ_LOG=FILE has the current call written to a file: the last one says
what ended the process.
"""

from __future__ import annotations

import datetime
import decimal
import faulthandler
import fractions
import os
import pickle
import resource
import shutil
import signal
import time
import types
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import folder_of
from gymnasium.vector import AutoresetMode

import cvar_game
from cvar_game import FiniteMDP, World, WorstCase, _core
from cvar_game.game import LavaGame
from cvar_game.mdp import Player, admissible

hypothesis = pytest.importorskip("hypothesis")
st = pytest.importorskip("hypothesis.strategies")

MINUTES = float(os.environ.get("FUZZ_MINUTES", "0"))
LOG = os.environ.get("FUZZ_LOG")

# Of a test without FUZZ_MINUTES, in seconds of the processor and of the clock: what takes longer hangs.
SECONDS, PATIENCE = 120, 1800
# Memory beyond this is refused, so that what asks for it fails.
BYTES = 16 << 30


class Hostile(Exception):  # noqa: N818
    """What hostile objects raise: it is theirs, and may cross."""


@pytest.fixture(scope="module")
def limits(request: pytest.FixtureRequest) -> Iterator[Callable[[], None]]:
    """Limits memory; the function that it gives limits the time from now on, beyond which the process ends and
    shows where it was.
    """
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        screen = os.dup(2)
    kinds = (resource.RLIMIT_AS, resource.RLIMIT_CPU)
    before = {kind: resource.getrlimit(kind) for kind in kinds}
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, before[resource.RLIMIT_AS][1]))
    faulthandler.register(signal.SIGXCPU, file=screen, chain=True)

    def start() -> None:
        faulthandler.dump_traceback_later(PATIENCE, exit=True, file=screen)
        limit = int(time.process_time()) + SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (limit, before[resource.RLIMIT_CPU][1]))

    yield start
    faulthandler.cancel_dump_traceback_later()
    for kind in kinds:
        resource.setrlimit(kind, before[kind])
    faulthandler.unregister(signal.SIGXCPU)
    os.close(screen)


@pytest.fixture
def repeat(request: pytest.FixtureRequest, limits: Callable[[], None]) -> Callable[[Callable[[], None]], None]:
    """Runs a test of Hypothesis once, or for its share of FUZZ_MINUTES."""
    ours = [item for item in request.session.items if item.fspath == request.node.fspath]
    share = 60.0 * MINUTES / len(ours)

    def run(test: Callable[[], None]) -> None:
        begun = time.monotonic()
        while True:
            limits()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                test()
            if time.monotonic() - begun >= share:
                break

    return run


def fuzzed(examples: int) -> Any:
    """The settings of a test of Hypothesis."""
    return hypothesis.settings(
        max_examples=100 if MINUTES else examples,
        derandomize=not MINUTES,
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate] if MINUTES else [hypothesis.Phase.generate, hypothesis.Phase.shrink],
        print_blob=False,
    )


def attempt(what: str, function: Callable[..., Any], *args: Any, allowed: Any = (), **options: Any) -> bool:
    """Calls a function; says whether it refused, and checks how it did."""
    if LOG:
        Path(LOG).write_text(f"{what}\n{shown(args)}\n{shown(options)}\n")
    try:
        function(*args, **options)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        fault = fault_of(error, allowed)
        if fault:
            blame(what, args, options, error, fault)
        return True
    return False


def fault_of(error: BaseException, allowed: Any = ()) -> str | None:
    """What is wrong with an exception, if anything is."""
    # It is no Exception, so that a careless test might not see it.
    if type(error).__name__ == "PanicException":
        return "it panicked"
    if isinstance(error, (TypeError, Hostile, allowed)):
        return None
    if not isinstance(error, ValueError):
        return "it is no ValueError"
    message = str(error)
    if "\n" in message or not message.strip():
        return "its message is not one line"
    return None


def blame(what: str, args: Any, options: Any, error: BaseException, fault: str) -> None:
    raise AssertionError(f"{what}, {shown(args)}, {shown(options)}: {fault}: {error!r}") from error


def shown(value: Any) -> str:
    try:
        return repr(value)[:2000]
    except BaseException:
        return f"<{type(value).__name__}>"


# Values.


def raises(*_: Any, **__: Any) -> Any:
    raise Hostile


def duck(**methods: Any) -> Any:
    """An object with these methods. Hypothesis shows it without asking them."""
    own: dict[str, Any] = {f"__{name}__": method for name, method in methods.items()}
    return type("Duck", (), own | {"_repr_pretty_": lambda self, printer, cycle: printer.text("duck")})()


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


CIRCLE: list[Any] = []
CIRCLE.append(CIRCLE)

NUMBERS = [
    -1, 0, 1, 2, 3, 39, 40, 70, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1, 2**64, -(2**63), -(2**70), 2**70,
    10**30, 10**400, -(10**400), 10**5000, 0.0, -0.0, 0.5, 0.999, 1.0, 1.5, 25.0, 1e-300, 5e-324, 1e15, 1e300, 1.7e308,
    -1.0, float("nan"), float("inf"), -float("inf"), True, False, np.int8(-1), np.int64(5), np.uint64(2**64 - 1),
    np.float16("nan"), np.float32(0.5), np.float64(1e308), np.longdouble("1e4000"), np.bool_(True), 1 + 2j, np.complex64(1),
    decimal.Decimal("0.5"), decimal.Decimal("1e999999"), decimal.Decimal("sNaN"), fractions.Fraction(1, 3),
]  # fmt: skip
TEXTS = [
    "", "x", "lava-grid", "lava-point", "nominal", "coordinates", "features", "ansi", "rgb_array", "NextStep", "SameStep",
    "a\nb", "a\r\nb", "\0", "a\0b", "\ud800", "é\u2028b", "../..", "/", "/nowhere", "/dev/null", "1", "nan", "0x10", " 1 ",
    "{}", "[]", "null", '"', "x" * 100_000, np.str_("lava-grid"), b"", b"x", b"\xff\0", bytearray(b"x"), memoryview(b"x"),
]  # fmt: skip
OTHERS = [
    None, ..., NotImplemented, (), [], {}, set(), [None], [[]], [[1], [1, 2]], [1, "x"], {"a": np.ones((2, 2))},
    {1: 2}, {"a\nb": 1}, [np.ones((3, 3)), "x"], object(), int, float, np, raises, lambda *_: None, lambda *_: 0,
    range(10**18), (i for i in range(3)), iter([]), CIRCLE, nested(100), nested(5_000), datetime.datetime(2020, 1, 1),
    np.datetime64("2020"), types.SimpleNamespace(), types.SimpleNamespace(predict=None),
    types.SimpleNamespace(predict=raises), types.SimpleNamespace(predict=lambda *_, **__: 1), Path("/nowhere"), Path("a\nb"),
    WorstCase(np.full((70, 4), 0.25)), WorstCase(np.full((70, 4), np.nan)), WorstCase(None), WorstCase(np.ones((70, 4)), 7.0),
    duck(array=raises), duck(array=lambda *_, **__: 3), duck(len=lambda _: -1), duck(len=lambda _: 2**62, getitem=raises),
    duck(len=lambda _: 3, getitem=lambda _, k: [1.0, 0.5][k]), duck(index=raises), duck(index=lambda _: "x"), duck(index=lambda _: 2**80),
    duck(float=raises), duck(float=lambda _: "x"), duck(eq=raises, hash=lambda _: 1), duck(bool=raises), duck(iter=raises),
    duck(repr=raises), duck(repr=lambda _: "a\nb"), duck(fspath=lambda _: 3), duck(fspath=raises), duck(fspath=lambda _: "a\nb"),
    duck(array_interface={"shape": (2**62,), "typestr": "<f8", "version": 3}), duck(getattr=raises), duck(**{"class": 3}),
]  # fmt: skip
TYPES = [
    "f8", "f4", "f2", ">f8", "i8", ">i8", "i4", "u8", "u1", "?", "c16", "O", "U3", "S3", "M8[s]", "m8[s]", "V8",
    np.longdouble, [("a", "f8"), ("b", "i4")],
]  # fmt: skip
SHAPES = [
    (), (0,), (1,), (2,), (3,), (4,), (5,), (70,), (0, 0), (0, 2), (0, 4), (1, 1), (1, 2), (2, 1), (1, 5), (2, 2), (3, 1),
    (3, 2), (3, 5), (2, 3), (4, 70), (70, 0), (70, 1), (70, 3), (70, 4), (70, 5), (71, 4), (40, 70), (1, 70, 4), (40, 70, 4),
    (41, 70, 4), (0, 70, 4), (40, 70, 4, 1), (2, 2, 2), (1,) * 10,
]  # fmt: skip
FILLS = [0.0, 0.25, 0.5, 1.0, -1.0, 3.0, float("nan"), float("inf"), -float("inf"), 1e308, 1e-308, 2.0**63, None]


def laid_out(array: Any, layout: str) -> Any:
    """The same numbers elsewhere in memory."""
    if layout == "reversed":
        return array[..., ::-1] if array.ndim else array
    if layout == "strided" and array.ndim:
        return np.repeat(array, 2, axis=-1)[..., ::2]
    if layout == "fortran":
        return np.asfortranarray(array)
    if layout == "misaligned" and array.dtype.kind != "O":
        memory = np.zeros(array.nbytes + 1, np.uint8)
        other = memory[1:].view(array.dtype).reshape(array.shape) if array.size else array
        other[...] = array
        return other
    if layout == "constant" and array.ndim:
        return np.broadcast_to(array.ravel()[0] if array.size else 0.0, array.shape)
    if layout == "huge":
        return np.broadcast_to(np.zeros((), array.dtype), (2**40, *array.shape[1:]))
    if layout == "list":
        return array.tolist()
    if layout == "fixed" and array.ndim:
        array.flags.writeable = False
    return array


LAYOUTS = ["plain", "reversed", "strided", "fortran", "misaligned", "constant", "huge", "list", "fixed"]


@st.composite
def arrays(draw: Any, shapes: Any = SHAPES) -> Any:
    shape = draw(st.sampled_from([*shapes, *SHAPES]))
    fill = draw(st.sampled_from(FILLS))
    numbers = np.full(shape, fill) if fill is not None else np.arange(np.prod(shape, dtype=int)).reshape(shape) % 5.0
    if numbers.size and draw(st.booleans()):
        places = draw(st.lists(st.integers(0, numbers.size - 1), max_size=3))
        for place in places:
            numbers.ravel()[place] = draw(st.sampled_from([0.0, 1.0, -1.0, 0.5, float("nan"), float("inf"), 1e300]))
    kind = draw(st.sampled_from(TYPES))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            numbers = numbers.astype(kind)
    except (TypeError, ValueError):
        numbers = np.zeros(shape, kind)
    return laid_out(numbers, draw(st.sampled_from(LAYOUTS)))


def bad(*shapes: tuple[int, ...], instead: Any = None) -> Any:
    """Anything; half of it of the kind of what it is in place of."""
    if isinstance(instead, (str, os.PathLike)):
        like = st.sampled_from(TEXTS)
    elif isinstance(instead, (int, float)):
        like = st.sampled_from(NUMBERS)
    elif isinstance(instead, (list, np.ndarray)):
        like = arrays([*shapes, np.shape(instead)])
    else:
        like = st.sampled_from(OTHERS)
    return st.one_of(like, anything(*shapes))


def anything(*shapes: tuple[int, ...]) -> Any:
    return st.one_of(
        st.sampled_from(NUMBERS),
        st.sampled_from(TEXTS),
        st.sampled_from(OTHERS),
        arrays(list(shapes)),
        st.integers(),
        st.floats(),
        st.text(max_size=5),
        st.binary(max_size=9),
    )


@st.composite
def mutations(draw: Any, original: bytes) -> bytes:
    """The bytes of a file, changed in some places."""
    mutant = bytearray(original)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, max(len(mutant) - 1, 0)))
        kind = draw(st.sampled_from(["flip", "cut", "insert", "end", "copy", "number", "number"]))
        if kind == "flip" and mutant:
            mutant[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del mutant[place : place + draw(st.sampled_from([1, 8, 100]))]
        elif kind == "insert":
            mutant[place:place] = draw(st.binary(max_size=9))
        elif kind == "end":
            del mutant[place:]
        elif kind == "copy":
            mutant[place:place] = mutant[place : place + 50]
        else:
            # Digits from here on become another number.
            digits = b"0123456789.-"
            while place < len(mutant) and mutant[place] not in digits:
                place += 1
            end = place
            while end < len(mutant) and mutant[end] in digits:
                end += 1
            numbers = [
                b"0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e308", b"1e-308", b"9007199254740993", b"4294967296",
                b"18446744073709551615", b"99999999999999999999999", b"true", b'"x"', b"[]", b"{}", b"null", b"\n",
            ]  # fmt: skip
            mutant[place:end] = draw(st.sampled_from(numbers))
    return bytes(mutant)


# Calls: a good one of each entry, whose arguments are replaced.

TABLE = np.full((70, 4), 0.25)
TIMED = np.full((40, 70, 4), 0.25)
COIN = [(0, 0, -1, 0.5, 1.0), (0, 0, 1, 0.5, 0.0), (0, 1, -1, 1.0, 0.25), (1, 0, 0, 1.0, -1.0), (1, 1, -1, 0.5, 2.0), (1, 1, 0, 0.5, 0.25)]


def up(observations: Any) -> Any:
    return np.zeros(len(observations), np.int64)


def east(observations: Any) -> Any:
    return np.tile([1.0, 0.0], (len(observations), 1))


class Calls:
    """Functions and their good arguments."""

    def __init__(self, runs: Path, folder: Path) -> None:
        self.grid, self.point = World("lava-grid"), World("lava-point")
        self.folder = folder
        self.runs = runs
        self.run = cvar_game.load(folder_of(runs, "lava-grid"))
        self.mdp = FiniteMDP(COIN, horizon=3)
        self.best = self.mdp.optimum(0.5)
        self.worst = self.mdp.worst_case(self.best, 2.0)
        self.law = self.mdp.evaluate(self.best)
        self.lake = gymnasium.make("FrozenLake-v1", max_episode_steps=5)

    def world(self) -> Any:
        return cvar_game.World, {"name": "lava-grid", "slip": 0.1, "horizon": 30, "map": "S.G", "step_cost": 0.1}

    def world_of_points(self) -> Any:
        return cvar_game.World, {"name": "lava-point", "noise": 1.0, "horizon": 30, "arena": [10.0, 10.0]}

    def env(self) -> Any:
        good = {"world": "lava-grid", "observation": "features", "time": True, "opponent": None, "eta": 2.0}
        return cvar_game.LavaEnv, {**good, "render_mode": "ansi", "slip": 0.1}

    def env_of_points(self) -> Any:
        good = {"world": "lava-point", "observation": "features", "time": True, "opponent": None, "eta": 2.0}
        return cvar_game.LavaEnv, {**good, "render_mode": "rgb_array", "noise": 1.0}

    def vector_env(self) -> Any:
        good = {"num_envs": 3, "world": "lava-grid", "observation": "coordinates", "time": False, "eta": 2.0}
        options = {"opponent": WorstCase(TABLE), "autoreset_mode": "SameStep", "render_mode": None, "info": True}
        return cvar_game.LavaVectorEnv, {**good, **options, "slip": 0.1}

    def game(self) -> Any:
        good = {"world": "lava-point", "eta": 2.0, "observation": "features", "time": True, "family": "bumps"}
        return LavaGame, {**good, "components": 2, "render_mode": "ansi"}

    def evaluate_table(self) -> Any:
        return cvar_game.evaluate, {"policy": TABLE, "world": self.grid, "eta": 2.0, "gamma": 0.9}

    def evaluate_function(self) -> Any:
        good = {"policy": up, "world": "lava-grid", "eta": 2.0, "gamma": 0.9, "observation": "features", "time": True}
        return cvar_game.evaluate, {**good, "episodes": 40, "seed": 3, "num_envs": 7, "opponent": None, "slip": 0.1}

    def evaluate_points(self) -> Any:
        good = {"policy": east, "world": "lava-point", "eta": 2.0, "gamma": 1.0, "episodes": 30, "seed": 3}
        return cvar_game.evaluate, {**good, "num_envs": 7}

    def evaluate_against(self) -> Any:
        good = {"policy": TIMED, "world": self.grid, "eta": 2.0, "opponent": WorstCase(TIMED), "episodes": 40}
        return cvar_game.evaluate, {**good, "seed": 1, "num_envs": 5}

    def evaluate_run(self) -> Any:
        return cvar_game.evaluate, {"policy": self.run, "world": None, "eta": None, "gamma": 1.0}

    def exact(self) -> Any:
        return cvar_game.exact, {"world": "lava-grid", "eta": 2.0, "gamma": 0.9, "compute": False, "slip": 0.1}

    def exact_points(self) -> Any:
        return cvar_game.exact, {"world": "lava-point", "eta": 25.0, "gamma": 1.0}

    def regret(self) -> Any:
        return cvar_game.regret, {"policy": TABLE, "world": "lava-grid", "eta": 2.0, "slip": 0.1}

    def worst_case(self) -> Any:
        return cvar_game.worst_case, {"policy": TIMED, "world": "lava-grid", "eta": 2.0, "gamma": 0.9}

    def exploitability(self) -> Any:
        good = {"protagonist": TABLE, "antagonist": WorstCase(TABLE), "world": self.grid, "eta": 2.0}
        return cvar_game.exploitability, {**good, "gamma": 1.0}

    def exploitability_of_runs(self) -> Any:
        return cvar_game.exploitability, {"protagonist": self.run, "antagonist": self.run, "world": None, "eta": None}

    def tabulate(self) -> Any:
        return cvar_game.tabulate, {"policy": up, "world": "lava-grid", "observation": "features", "time": False}

    def opponent(self) -> Any:
        def against(policy: Any, gamma: Any, eta: Any) -> None:
            cvar_game.LavaEnv(opponent=WorstCase(policy, gamma), eta=eta)

        return against, {"policy": TABLE, "gamma": 1.0, "eta": 2.0}

    def mdp_of_rows(self) -> Any:
        good = {"transitions": np.array(COIN), "horizon": 3, "gamma": 0.9, "start": np.array([0.5, 0.5]), "states": 2}
        return FiniteMDP, good

    def mdp_of_env(self) -> Any:
        return FiniteMDP.from_env, {"env": self.lake, "horizon": 3, "gamma": 1.0, "start": 0}

    def mdp_of_csv(self) -> Any:
        path = self.folder / "good.csv"
        path.write_text("idstatefrom,idaction,idstateto,probability,reward\n0,0,0,1,1\n")
        return FiniteMDP.from_csv, {"path": path, "horizon": 3, "gamma": 1.0, "start": 0}

    def mdp_action_count(self) -> Any:
        return self.mdp.action_count, {"state": 0}

    def mdp_outcomes(self) -> Any:
        return self.mdp.outcomes, {"state": 0, "action": 0}

    def mdp_levels(self) -> Any:
        return self.mdp.levels, {"time": 0}

    def mdp_optimum(self) -> Any:
        return self.mdp.optimum, {"alpha": 0.5}

    def mdp_evaluate(self) -> Any:
        return self.mdp.evaluate, {"policy": np.full((2, 2), 0.5)}

    def mdp_worst_case(self) -> Any:
        return self.mdp.worst_case, {"policy": self.best, "eta": 2.0}

    def mdp_chow(self) -> Any:
        return self.mdp.chow, {"eta": 2.0}

    def mdp_best_stationary(self) -> Any:
        return self.mdp.best_stationary, {"alpha": 0.5}

    def optimum_action(self) -> Any:
        return self.best.action, {"time": 0, "accumulated": 0.0, "state": 0}

    def optimum_worst_case(self) -> Any:
        return self.best.worst_case, {"eta": 2.0}

    def worst_action(self) -> Any:
        return self.worst.action, {"time": 0, "accumulated": 0.0, "state": 0}

    def worst_ratios(self) -> Any:
        return self.worst.ratios, {"time": 0, "accumulated": 0.0, "state": 0}

    def worst_budget(self) -> Any:
        return self.worst.budget, {"time": 0, "accumulated": 0.0, "state": 0}

    def law_cvar(self) -> Any:
        return self.law.cvar, {"alpha": 0.5}

    def law_var(self) -> Any:
        return self.law.var, {"alpha": 0.5}

    def law_error(self) -> Any:
        return self.law.cvar_standard_error, {"alpha": 0.5}

    def player(self) -> Any:
        def play(state: Any, reward: Any) -> None:
            player = Player(self.best)
            player.act(state)
            player.observe(reward)
            player.act(0)

        return play, {"state": 0, "reward": 0.0}

    def admissible(self) -> Any:
        return admissible, {"ratios": [0.5, 1.5], "probabilities": [0.5, 0.5], "budget": 2.0}

    def antagonist(self) -> Any:
        good = {"env": self.lake, "mdp": FiniteMDP.from_env(self.lake), "eta": 2.0, "policy": np.zeros(16, int)}
        return cvar_game.BudgetedAntagonist, {**good, "ratios": None}

    def antagonist_of_ratios(self) -> Any:
        def play(eta: Any, answer: Any) -> None:
            def ratios(*_: Any) -> Any:
                return answer

            env = cvar_game.BudgetedAntagonist(self.lake, None, eta, ratios=ratios)
            env.reset(seed=1)
            env.step(2)

        return play, {"eta": 2.0, "answer": np.array([0.5, 1.0, 1.5])}

    def load(self) -> Any:
        return cvar_game.load, {"folder": self.run.folder}

    def predict(self) -> Any:
        width = self.run._core.observation_size
        seen = cvar_game.LavaEnv(**self.run.env_options).reset(seed=1)[0]
        assert len(seen) == width
        return self.run.predict, {"observation": seen, "deterministic": False}

    def seed(self) -> Any:
        return self.run.seed, {"seed": 1}

    def record(self) -> Any:
        good = {"policy": TABLE, "world": "lava-grid", "eta": 2.0, "out": self.folder / "out", "method": "m"}
        return cvar_game.record, {**good, "seed": 1, "steps": 3, "seconds": 1.0, "gamma": 1.0}

    def record_function(self) -> Any:
        good = {"policy": up, "world": "lava-grid", "eta": 2.0, "out": self.folder / "out", "method": "m/v"}
        return cvar_game.record, {**good, "seed": 1, "steps": 3, "seconds": 1.0, "episodes": 40, "num_envs": 7}

    def results(self) -> Any:
        return cvar_game.results, {"folder": self.runs}


NAMES = [name for name in vars(Calls) if not name.startswith("_")]

# What is possible, but takes long or much memory, is left out.
SLOW = {
    "episodes": lambda value: is_between(value, 200, 10_000_000),
    "num_envs": lambda value: is_between(value, 2_000, 10_000_000),
    "horizon": lambda value: is_between(value, 1_000, 10_000_000),
    "compute": lambda value: value is True or isinstance(value, np.bool_),
    "time": lambda value: False,
}

# Shapes that might fit.
LIKELY = {
    "transitions": [(1, 5), (5, 5), (0, 5), (5,), (5, 4)],
    "start": [(2,), (3,)],
    "answer": [(3,)],
    "ratios": [(2,)],
    "probabilities": [(2,)],
    "observation": [(2,), (5, 2), (70,), (3, 70), (0, 70)],
}


def is_between(value: Any, least: int, most: int) -> bool:
    try:
        return bool(least <= value <= most)
    except BaseException:
        return False


@pytest.fixture(scope="module")
def calls(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Calls:
    return Calls(runs, tmp_path_factory.mktemp("fuzz"))


@pytest.fixture(scope="module", autouse=True)
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Files that are written under strange names lie in a folder of their own."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    yield
    os.chdir(before)


@pytest.mark.parametrize("name", NAMES)
def test_bad_arguments_are_refused(name: str, calls: Calls, repeat: Any) -> None:
    function, good = getattr(calls, name)()
    assert not attempt(name, function, **good)
    # Files that cannot be read are said to be so.
    allowed = (OSError,) if name == "mdp_of_csv" else ()

    @fuzzed(examples=10)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        options = dict(good)
        unknown = data.draw(st.sampled_from(["unknown", "a\nb", "\0", "\ud800", "", "map.x", "é", "a.b", '"']))
        for key in data.draw(st.sets(st.sampled_from([*good, unknown]), min_size=1, max_size=2)):
            value = data.draw(bad(*LIKELY.get(key, []), instead=good.get(key)))
            hypothesis.assume(not SLOW.get(key, lambda _: False)(value))
            # They write where they are told.
            hypothesis.assume(key != "out" or not is_path_elsewhere(value))
            options[key] = value
        attempt(name, function, allowed=allowed, **options)

    repeat(test)


def is_path_elsewhere(value: Any) -> bool:
    return isinstance(value, (str, bytes, os.PathLike)) and str(value)[:1] in ("/", ".")


@pytest.mark.usefixtures("limits")
def test_what_memory_cannot_hold_is_refused() -> None:
    rows = ["S" + "." * 998 + "G", *["." * 1000] * 999]
    large = World("lava-grid", map="\n".join(rows), horizon=1_000_000)
    seen = {"observation": "features"}
    assert attempt("batch", cvar_game.LavaVectorEnv, 1_000_000, large, **seen)
    assert attempt("tabulate", cvar_game.tabulate, up, large, **seen)
    assert attempt("tabulate", cvar_game.tabulate, up, large, time=True)
    options = {"episodes": 1_000_000, "num_envs": 1_000_000}
    assert attempt("evaluate", cvar_game.evaluate, up, large, 1.0, **options, **seen)
    assert attempt("evaluate", cvar_game.evaluate, np.broadcast_to(0.25, (10**6, 10**6, 4)), large, 1.0)
    assert attempt("exact", cvar_game.exact, large, 1.0)
    for count in (0, -1, 10_000_001, 2**40, 2**64, 10**30):
        assert attempt("batch", cvar_game.LavaVectorEnv, count)
        assert attempt("evaluate", cvar_game.evaluate, up, "lava-grid", 1.0, episodes=count)
        assert attempt("evaluate", cvar_game.evaluate, up, "lava-grid", 1.0, episodes=10, num_envs=count)
    # One state has many actions, so that a policy of shape (T, S, A) has more numbers than the MDP.
    many = FiniteMDP([(s, a, s, 1.0, 0.0) for s in range(1_000) for a in range(1 if s else 10_000)], horizon=1_000)
    assert attempt("evaluate", many.evaluate, np.zeros((1_000, 1_000), int))


# Environments: a refused call changes nothing.


def good_action(world: World, slots: int | None) -> Any:
    if world.actions is not None:
        return 0 if slots is None else np.zeros(slots, np.int64)
    return np.zeros(2) if slots is None else np.zeros((slots, 2))


@st.composite
def operations(draw: Any, kinds: list[str]) -> Any:
    return draw(st.lists(st.tuples(st.sampled_from(kinds), st.booleans()), min_size=1, max_size=6))


OBSERVED = ["lava-grid", "lava-point"]

# Their episodes end after two steps.
SMALL: dict[str, dict[str, Any]] = {"lava-grid": {"map": "S.G"}, "lava-point": {}}


@pytest.mark.parametrize("name", OBSERVED)
def test_an_environment_refuses_and_goes_on(name: str, repeat: Any) -> None:
    world = World(name, horizon=2, **SMALL[name])
    good = good_action(world, None)

    @fuzzed(examples=20)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        env = cvar_game.LavaEnv(world, render_mode="ansi", eta=1.0)
        saved = env.snapshot()
        for kind, wrong in data.draw(operations(["reset", "step", "step", "restore", "render", "close", "options"])):
            before = env.snapshot()
            if kind == "reset":
                refused = attempt("reset", env.reset, seed=data.draw(bad()) if wrong else 3)
            elif kind == "options":
                refused = attempt("options", env.reset, options=data.draw(bad()))
            elif kind == "step":
                refused = attempt("step", env.step, data.draw(bad((2,), ())) if wrong else good)
            elif kind == "restore":
                mutant = data.draw(st.one_of(bad(), mutations(saved))) if wrong else saved
                refused = attempt("restore", env.restore, mutant)
            else:
                refused = attempt(kind, getattr(env, kind))
            assert not refused or env.snapshot() == before, kind
            saved = env.snapshot()
        env.reset(seed=3)
        env.step(good)

    repeat(test)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("name", OBSERVED)
def test_a_batch_refuses_and_goes_on(name: str, mode: AutoresetMode, repeat: Any) -> None:
    world = World(name, horizon=2, **SMALL[name])
    good = good_action(world, 3)
    shape = good.shape

    @fuzzed(examples=30)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        env = cvar_game.LavaVectorEnv(3, world, render_mode="ansi", eta=1.0, autoreset_mode=mode)
        saved = env.snapshot(1)
        kinds = ["reset", "reset", "seeds", "mask", "step", "step", "snapshot", "restore", "render", "close"]
        for kind, wrong in data.draw(operations(kinds)):
            before = [env.snapshot(slot) for slot in range(3)]
            if kind == "reset":
                refused = attempt("reset", env.reset, seed=data.draw(bad()) if wrong else 3)
            elif kind == "seeds":
                seeds = [data.draw(bad()) if wrong else slot for slot in range(3)]
                refused = attempt("reset", env.reset, seed=seeds)
            elif kind == "mask":
                options = {"reset_mask": data.draw(bad((3,)))} if wrong else {"reset_mask": np.array([True, False, True])}
                refused = attempt("reset", env.reset, options=options)
            elif kind == "step":
                refused = attempt("step", env.step, data.draw(bad(shape)) if wrong else good)
            elif kind == "snapshot":
                refused = attempt("snapshot", env.snapshot, data.draw(bad()) if wrong else 1)
            elif kind == "restore":
                slot = data.draw(st.one_of(st.just(1), bad())) if wrong else 1
                mutant = data.draw(st.one_of(bad(), mutations(saved))) if wrong else saved
                refused = attempt("restore", env.restore, slot, mutant)
            else:
                refused = attempt(kind, getattr(env, kind))
            assert not refused or [env.snapshot(slot) for slot in range(3)] == before, kind
            saved = env.snapshot(1)
        env.reset(seed=3)
        if not env.closed:
            env.step(good)

    repeat(test)


@pytest.mark.parametrize("name", OBSERVED)
def test_a_restored_slot_can_be_played(name: str, repeat: Any) -> None:
    world = World(name)
    env = cvar_game.LavaVectorEnv(2, world, eta=1.0)
    env.reset(seed=1)
    env.step(good_action(world, 2))
    saved = env.snapshot(0)

    @fuzzed(examples=30)
    @hypothesis.given(mutations(saved))
    def test(snapshot: bytes) -> None:
        if attempt("restore", env.restore, 0, snapshot):
            return
        for _ in range(30):
            attempt("step", env.step, good_action(world, 2))
        attempt("render", env._games.positions)
        env.restore(0, env.snapshot(0))

    repeat(test)


@pytest.mark.parametrize("name", OBSERVED)
def test_a_game_refuses_and_goes_on(name: str, repeat: Any) -> None:
    world = World(name, horizon=2, **SMALL[name])
    good = [good_action(world, None), None]

    @fuzzed(examples=20)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        game = LavaGame(world, eta=2.0, render_mode="ansi")
        good[1] = np.zeros(game.action_space("antagonist").shape)
        kinds = ["reset", "step", "step", "observe", "render", "last", "close", "action_space", "observation_space"]
        for kind, wrong in data.draw(operations(kinds)):
            before = game._games.snapshot(0)
            if kind == "reset":
                refused = attempt("reset", game.reset, seed=data.draw(bad()) if wrong else 3)
            elif kind == "step":
                turn = getattr(game, "agent_selection", "protagonist") == "antagonist"
                refused = attempt("step", game.step, data.draw(bad((4,), (2,), ())) if wrong else good[turn])
            elif kind in ("observe", "action_space", "observation_space"):
                agent = data.draw(bad()) if wrong else "antagonist"
                refused = attempt(kind, getattr(game, kind), agent)
            else:
                refused = attempt(kind, getattr(game, kind))
            assert not refused or game._games.snapshot(0) == before, kind
        game.reset(seed=3)
        game.step(good[0])
        game.step(good[1])

    repeat(test)


# Policies that answer with anything.


@pytest.mark.parametrize("name", OBSERVED)
def test_bad_answers_of_policies_are_refused(name: str, repeat: Any) -> None:
    shapes = [(5,), (5, 1), (5, 2), (70,), (70, 1)]

    @fuzzed(examples=20)
    @hypothesis.given(bad(*shapes), st.sampled_from(["function", "predict", "pair"]))
    def test(answer: Any, kind: str) -> None:
        policy: Any = lambda _: answer  # noqa: E731
        if kind != "function":
            given = answer if kind == "predict" else (answer, None)
            policy = types.SimpleNamespace(predict=lambda *_, **__: given)
        attempt("evaluate", cvar_game.evaluate, policy, name, 1.0, episodes=10, num_envs=5)
        attempt("tabulate", cvar_game.tabulate, policy, name)

    repeat(test)


# MDPs.


@st.composite
def numbers(draw: Any) -> Any:
    return draw(st.one_of(st.sampled_from(NUMBERS), st.sampled_from([0, 1, 2, -1, 0.5, 0.25]), st.floats(), bad()))


def test_bad_transitions_are_refused(repeat: Any) -> None:
    @fuzzed(examples=20)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        rows: list[Any] = [list(row) for row in COIN]
        for _ in range(data.draw(st.integers(1, 3))):
            row, column = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, 4))
            rows[row][column] = data.draw(numbers())
        horizon = data.draw(st.sampled_from([1, 2, 5]))
        gamma = data.draw(st.sampled_from([1.0, 0.5, 1e-3, 1e-200, 5e-324]))
        start = data.draw(st.sampled_from([0, [0.5, 0.5], [1e-300, 1.0]]))
        made: list[Any] = []
        attempt("FiniteMDP", lambda: made.append(FiniteMDP(rows, horizon=horizon, gamma=gamma, start=start)))
        for mdp in made:
            ask(mdp, data.draw(st.sampled_from([1.0, 0.5, 1e-3, 1e-300, 5e-324])))

    repeat(test)


def ask(mdp: FiniteMDP, alpha: float) -> None:
    """All that an MDP answers."""
    attempt("pickle", lambda: pickle.loads(pickle.dumps(mdp)))
    attempt("best_stationary", mdp.best_stationary, alpha)
    attempt("chow", lambda: mdp.chow(1.0 / alpha))
    found: list[Any] = []
    attempt("optimum", lambda: found.append(mdp.optimum(alpha)))
    for best in found:
        attempt("table", best.table)
        attempt("evaluate", mdp.evaluate, best)
        worst: list[Any] = []
        attempt("worst_case", lambda: worst.append(best.worst_case(1.0 / alpha)))
        for of in worst:
            attempt("table", of.table)
            attempt("start_ratios", of.start_ratios)
            assert np.isfinite(of.value)
            for time_ in range(mdp.horizon):
                for level in mdp.levels(time_):
                    attempt("ratios", of.ratios, time_, level, 0)
                    attempt("budget", of.budget, time_, level, 0)


CSV = b"idstatefrom,idaction,idstateto,probability,reward\n1,1,1,0.5,1.0\n1,1,2,0.5,0\n2,1,1,1,-1.5\n1,2,2,1,0.125\n"


def test_bad_csv_is_refused(tmp_path: Path, repeat: Any) -> None:
    @fuzzed(examples=30)
    @hypothesis.given(st.one_of(mutations(CSV), st.binary(), st.text().map(lambda text: text.encode("utf-8", "replace"))))
    def test(content: bytes) -> None:
        path = tmp_path / "mdp\n.csv"
        path.write_bytes(content)
        attempt("from_csv", FiniteMDP.from_csv, path, horizon=2)

    repeat(test)


def test_bad_tables_of_environments_are_refused(repeat: Any) -> None:
    @fuzzed(examples=30)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        table: Any = {s: {a: [(0.5, 0, 1.0, False), (0.5, 1, 0.0, True)] for a in range(2)} for s in range(2)}
        match data.draw(st.integers(0, 5)):
            case 0:
                table = data.draw(bad())
            case 1:
                table[data.draw(st.sampled_from([0, 1, 2, "x", None]))] = data.draw(bad())
            case 2:
                table[0][data.draw(st.sampled_from([0, 1, 2, "x", None]))] = data.draw(bad())
            case 3:
                table[1][0][1] = data.draw(bad())
            case _:
                row = list(table[1][1][0])
                row[data.draw(st.integers(0, 3))] = data.draw(numbers())
                table[1][1][0] = tuple(row)
        law = data.draw(st.one_of(bad((2,)), st.just([0.5, 0.5])))
        env = types.SimpleNamespace(P=table, initial_state_distrib=law, spec=None)
        attempt("from_env", FiniteMDP.from_env, env, 2)

    repeat(test)


# Files of runs.


@pytest.mark.parametrize("name", OBSERVED)
@pytest.mark.parametrize("file", ["config.toml", "final.safetensors"])
def test_broken_runs_are_refused(name: str, file: str, runs: Path, tmp_path: Path, repeat: Any) -> None:
    folder = tmp_path / name
    shutil.copytree(folder_of(runs, name), folder)
    original = (folder / file).read_bytes()

    @fuzzed(examples=20)
    @hypothesis.given(mutations(original))
    def test(content: bytes) -> None:
        (folder / file).write_bytes(content)
        loaded: list[Any] = []
        attempt("load", lambda: loaded.append(cvar_game.load(folder)))
        for run in loaded:
            width = run._core.observation_size
            attempt("predict", run.predict, np.zeros((3, width), np.float32))
            if run.world.states is not None:
                attempt("table", run.table)
            attempt("env", cvar_game.LavaEnv, run.world, opponent=run, **{"observation": run.observation, "time": run.time})

    repeat(test)


@pytest.mark.parametrize("file", ["config.toml", "evaluation.json", "manifest.json", "progress.csv"])
def test_broken_results_are_refused(file: str, runs: Path, tmp_path: Path, repeat: Any) -> None:
    shutil.copytree(runs, tmp_path / "results")
    path = folder_of(tmp_path / "results", "lava-grid") / file
    original = path.read_bytes()

    @fuzzed(examples=30)
    @hypothesis.given(mutations(original))
    def test(content: bytes) -> None:
        path.write_bytes(content)
        attempt("results", cvar_game.results, tmp_path / "results")

    repeat(test)


# The native module itself.


def natively(calls: Calls) -> dict[str, tuple[Any, list[Any], dict[str, Any]]]:
    """Functions of the native module and their good arguments."""
    world, law = calls.grid._core, calls.law
    judged = world.judge_table(TABLE, 2.0, 1.0, None)
    games = _core.Games(
        world, slots=2, features=False, time=False, eta=2.0, autoreset="next-step",
        opponent=_core.Opponent.played("auto", 1, 4.0, 50.0),
    )  # fmt: skip
    up_to = np.zeros(2, np.int64)
    seen = np.zeros((2, calls.run._core.observation_size), np.float32)
    setting = {"eta": 2.0, "gamma": 1.0, "episodes": 9, "slots": 2, "seed": 1, "features": True, "time": True}
    finished = {"method": "m", "eta": 2.0, "gamma": 1.0, "seed": 1, "steps": 3, "seconds": 1.0, "clearance": None}
    rows = np.array(COIN)
    ids = [np.ascontiguousarray(rows[:, k].astype(np.int64)) for k in range(3)]
    law_of_start = np.array([0.5, 0.5])
    mdp = calls.mdp._core
    return {
        "World": (_core.World, ["lava-grid", "{}"], {}),
        "picture": (world.picture, [np.zeros((2, 2))], {}),
        "exact": (world.exact, [2.0, 1.0, False], {}),
        "judge_table": (world.judge_table, [TABLE, 2.0, 1.0, None], {}),
        "judge_law": (world.judge_law, [law, 2.0, 1.0], {}),
        "optimal_policy": (world.optimal_policy, [2.0, 1.0], {}),
        "sights": (world.sights, [False, False, 0], {}),
        "sight_width": (world.sight_width, [False, False], {}),
        "worst_case": (world.worst_case, [TABLE, 2.0, 1.0], {}),
        "play": (world.play, [up], setting),
        "Opponent.worst_case": (_core.Opponent.worst_case, [TABLE, 1.0], {}),
        "Opponent.trained": (_core.Opponent.trained, [calls.run.folder], {}),
        "Opponent.played": (_core.Opponent.played, ["auto", 1, 4.0, 50.0], {}),
        "Games.reset": (games.reset, [[0, 1], [1, 2]], {}),
        "Games.step": (games.step, [up_to, np.zeros((2, games.parameters), np.float32)], {}),
        "Games.situation": (games.situation, [up_to], {}),
        "Games.snapshot": (games.snapshot, [0], {}),
        "Games.restore": (games.restore, [0, games.snapshot(0)], {}),
        "Run": (_core.Run, [calls.run.folder], {}),
        "Run.act": (calls.run._core.act, [seen, 1], {}),
        "write_run": (_core.write_run, [calls.folder / "out", world, judged], finished),
        "read_results": (_core.read_results, [calls.runs], {}),
        "Mdp": (
            _core.Mdp,
            [*ids, np.ascontiguousarray(rows[:, 3]), np.ascontiguousarray(rows[:, 4])],
            {"states": 2, "start": law_of_start, "horizon": 3, "gamma": 1.0},
        ),
        "Mdp.evaluate": (mdp.evaluate, [np.full((2, 2), 0.5)], {}),
        "Mdp.worst_case": (mdp.worst_case, [np.full((2, 2), 0.5), 2.0], {}),
    }


NATIVE = [
    "World", "picture", "exact", "judge_table", "judge_law", "optimal_policy", "sights", "sight_width", "worst_case", "play",
    "Opponent.worst_case", "Opponent.trained", "Opponent.played", "Games.reset", "Games.step", "Games.situation",
    "Games.snapshot", "Games.restore", "Run", "Run.act", "write_run", "read_results", "Mdp", "Mdp.evaluate",
    "Mdp.worst_case",
]  # fmt: skip


@pytest.mark.parametrize("name", NATIVE)
def test_the_native_module_refuses_bad_arguments(name: str, calls: Calls, repeat: Any) -> None:
    known = natively(calls)
    assert set(known) == set(NATIVE)
    function, args, named = known[name]
    assert not attempt(name, function, *args, **named)

    @fuzzed(examples=10)
    @hypothesis.given(st.data())
    def test(data: Any) -> None:
        given: list[Any] = list(args)
        options = dict(named)
        for key in data.draw(st.sets(st.sampled_from([*range(len(args)), *named]), min_size=1, max_size=2)):
            instead = args[key] if isinstance(key, int) else named[key]
            value = data.draw(bad((2,), (2, 2), (2, 4), (5,), instead=instead))
            hypothesis.assume(not SLOW.get(str(key), lambda _: False)(value))
            # The functions of the package look at sizes.
            hypothesis.assume(not isinstance(value, range))
            hypothesis.assume(not isinstance(value, np.ndarray) or value.size < 2**30)
            hypothesis.assume(name != "write_run" or key != 0 or not is_path_elsewhere(value))
            if isinstance(key, int):
                given[key] = value
            else:
                options[key] = value
        # The functions of the package look at whole numbers.
        attempt(name, function, *given, allowed=(OverflowError,), **options)

    repeat(test)
