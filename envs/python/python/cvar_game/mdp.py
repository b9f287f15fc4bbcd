"""Exact answers about the static CVaR of any finite MDP.

    import gymnasium
    from cvar_game import FiniteMDP

    mdp = FiniteMDP.from_env(gymnasium.make("FrozenLake-v1"))
    best = mdp.optimum(alpha=0.05)
    print(best.cvar, best.mean, mdp.worst_case(best, eta=20).value)

An episode lasts at most T steps (``horizon``), and its return is ``J = sum over t < T of gamma^t r_t``, in
the units of the rewards. ``CVaR_alpha(J)`` is the mean of the worst share alpha of the outcomes. It is the
*static* CVaR: of the whole return, seen from the start. ``alpha = 1`` is the mean.

A policy of the best static CVaR needs to know the time and the reward that has been accumulated so far,
``R_t = sum over k < t of gamma^k r_k`` (Baeuerle & Ott 2011, "Markov decision processes with
average-value-at-risk criteria"). All answers here are exact up to rounding: nothing is sampled, and no grid
is laid over rewards or risk levels. The price is size: combinations of time, accumulated reward and state
must be at most five million. Rewards that are small multiples of one number have few different sums; with
``gamma < 1`` sums of different rewards hardly ever meet, so that their number grows fast with the horizon.
Other threads run while an answer is computed, but Ctrl-C has to wait for it.

| symbol | meaning |
|---|---|
| S, A, T | number of states, most actions of a state, time limit in steps |
| K | number of outcomes of an action in a state: pairs of next state and reward |
| alpha, eta | risk level in (0, 1], and the antagonist's budget ``eta = 1 / alpha`` |

Nothing in this module needs Gymnasium but :class:`BudgetedAntagonist`, which imports it on first use.
"""

from __future__ import annotations

import csv
import operator
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import numpy.typing as npt

from cvar_game._arguments import MOST_NUMBERS, array_of, number, numbers, shown, whole
from cvar_game._core import Law, Mdp, Optimum

if TYPE_CHECKING:
    import gymnasium

    from cvar_game._core import MdpWorstCase

__all__ = ["BudgetedAntagonist", "FiniteMDP", "Optimum", "Player", "Stationary", "admissible"]

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

COLUMNS = ("idstatefrom", "idaction", "idstateto", "probability", "reward")
"""The columns of a CSV file, see :meth:`FiniteMDP.from_csv`."""

LARGEST = 5_000_000
"""The most states, steps, and combinations of time, accumulated reward and state."""

# A budget is cut off here, which leaves the antagonist less than it has.
LARGEST_BUDGET = 1e300


@dataclass(frozen=True)
class Stationary:
    """A good policy that sees the state and nothing else, found by local search.

    To find the best one is a hard combinatorial problem. The search changes one action at a time, from the
    optimal policy and others, as long as the exact CVaR grows. So ``cvar`` is a lower bound of the best
    stationary CVaR, and :meth:`FiniteMDP.optimum` is an upper bound of it.
    """

    alpha: float
    """Risk level."""
    cvar: float
    """CVaR_alpha of the return under the policy."""
    var: float
    """VaR_alpha, the lower alpha-quantile of the return."""
    mean: float
    """Mean return."""
    actions: Integers = field(repr=False)
    """Action of each state, shape ``(S,)``; -1 where the episode has ended."""
    local_optimum: bool
    """Whether no change of the action in one state improves the CVaR by more than 1e-9. False if the limit
    on the number of evaluations stopped the search."""
    evaluated: int
    """Number of policies evaluated."""
    law: Law = field(repr=False)
    """The law of the return."""


Policy = Union[Optimum, Stationary, npt.ArrayLike]
"""An optimum or a stationary policy of the same MDP; action probabilities of shape ``(S, A)`` or
``(T, S, A)``; or actions (whole numbers) of shape ``(S,)`` or ``(T, S)``."""

Ratios = Callable[[int, int, Floats, float], npt.ArrayLike]
"""An antagonist as a function ``(state, action, probabilities, budget) -> ratios``: the likelihood ratios of
the outcomes ``env.unwrapped.P[state][action]``, in their order."""


class FiniteMDP:
    """A finite MDP with a time limit, solved exactly for the static CVaR of its return.

    Args:
        transitions: An array of shape ``(N, 5)``, or an iterable of tuples: state, action, next state,
            probability, reward. States and actions are whole numbers from 0; the actions of a state have no
            gaps. Rows that differ in nothing but the probability are one outcome. The probabilities of each
            state and action must sum to 1 within 1e-6, and are normalised. States without transitions have
            ended. The next state -1 ends the episode as well.
        horizon: Time limit T in steps, a true end of the episode: the last reward counts, nothing is
            bootstrapped.
        gamma: Discount per step, in (0, 1].
        start: The state in which episodes start, or the probabilities of all states, shape ``(S,)``. The
            draw of the start is chance like any other: the CVaR is that of the whole return.
        states: Number of states S; by default the largest state that is mentioned, plus 1.

    Raises:
        ValueError: If a number is out of range or a law does not sum to 1, or the MDP is too large.

    Example:
        A coin decides between 1 and 0 if it is tossed, and there is 0.4 for not tossing it:

        >>> coin = [(0, 0, -1, 0.5, 1.0), (0, 0, -1, 0.5, 0.0), (0, 1, -1, 1.0, 0.4)]
        >>> mdp = FiniteMDP(coin, horizon=1)
        >>> mdp.optimum(1.0).cvar, mdp.optimum(0.5).cvar
        (0.5, 0.4)
    """

    def __init__(
        self,
        transitions: npt.ArrayLike | Iterable[Sequence[float]],
        *,
        horizon: int,
        gamma: float = 1.0,
        start: int | npt.ArrayLike = 0,
        states: int | None = None,
    ) -> None:
        rows = _rows(transitions)
        mentioned = int(rows[:, [0, 2]].max())
        law: Floats | None = None
        try:
            first = operator.index(start)  # type: ignore[arg-type]
        except TypeError:
            law, first = numbers("start", start), 0
            if law.ndim != 1:
                raise ValueError(
                    f"start = {shown(start)} must be a state or the probabilities of all states, shape (S,)"
                ) from None
            mentioned = max(mentioned, len(law) - 1)
        if states is None:
            count = whole("the number of states", max(mentioned, first) + 1, 1, LARGEST)
        else:
            count = whole("states", states, 1, LARGEST)
        if law is None:
            if not 0 <= first < count:
                raise ValueError(f"start = {shown(first)} must be a state in [0, {count})")
            law = np.zeros(count)
            law[first] = 1.0
        elif len(law) < count and states is None:
            raise ValueError(f"start must have the probabilities of all {count} states, got {len(law)}")
        ids = rows[:, :3].astype(np.int64)
        self._rows = rows
        self._core = Mdp(
            np.ascontiguousarray(ids[:, 0]),
            np.ascontiguousarray(ids[:, 1]),
            np.ascontiguousarray(ids[:, 2]),
            np.ascontiguousarray(rows[:, 3]),
            np.ascontiguousarray(rows[:, 4]),
            states=count,
            start=law,
            horizon=whole("horizon", horizon, 1, LARGEST),
            gamma=number("gamma", gamma),
        )

    def __repr__(self) -> str:
        return (
            f"FiniteMDP({self.states} states, {self.actions} actions, horizon={self.horizon}, "
            f"gamma={self.gamma:g})"
        )

    def __deepcopy__(self, memo: object) -> FiniteMDP:
        return self  # it never changes

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (self._rows, self.horizon, self.gamma, self.start, self.states)

    @classmethod
    def from_env(
        cls,
        env: Any,
        horizon: int | None = None,
        gamma: float = 1.0,
        *,
        start: int | npt.ArrayLike | None = None,
    ) -> FiniteMDP:
        """The MDP of an environment of Gymnasium's toy text: FrozenLake, CliffWalking, Taxi and their like.

        States and actions keep their numbers. A transition that terminates ends the episode, whatever its
        next state.

        Args:
            env: An environment, wrapped or not, whose ``env.unwrapped.P`` is
                ``{state: {action: [(probability, next state, reward, terminated)]}}``.
            horizon: Time limit T in steps; by default the ``max_episode_steps`` of its ``spec``. Reaching it
                is the end of the episode here, as the return has no other end.
            gamma: Discount per step.
            start: As in the constructor; by default ``env.unwrapped.initial_state_distrib``.

        Raises:
            ValueError: If the environment has no such table, or no time limit and none is given.
        """
        inner = getattr(env, "unwrapped", env)
        rows, states = _table_rows(inner)
        if horizon is None:
            horizon = getattr(getattr(env, "spec", None), "max_episode_steps", None)
        if horizon is None:
            raise ValueError("the environment has no time limit (max_episode_steps); give horizon=...")
        if start is None:
            start = getattr(inner, "initial_state_distrib", None)
        if start is None:
            raise ValueError("the environment does not say where it starts; give start=...")
        return cls(rows, horizon=horizon, gamma=gamma, start=start, states=states)

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        *,
        horizon: int,
        gamma: float = 1.0,
        start: int | npt.ArrayLike = 0,
    ) -> FiniteMDP:
        """The MDP of a CSV file, as those of RiskMDPs.jl and CRAAM.

        Args:
            path: A file with the columns ``idstatefrom,idaction,idstateto,probability,reward`` and a header;
                other columns are ignored. Ids of states, and those of actions, may start at 0 or at 1. Here
                they always start at 0: where the file's start at 1, its state 5 is state 4.
            horizon: Time limit T in steps.
            gamma: Discount per step.
            start: As in the constructor, counted from 0.

        Raises:
            ValueError: If a line makes no sense; the message has its number.
            OSError: If the file cannot be read.
        """
        name = os.fsdecode(path)
        name = name if name.isprintable() else shown(name)
        rows, lines = _read_csv(path, name)
        _check_csv(name, rows, lines)
        rows[:, [0, 2]] -= rows[:, [0, 2]].min()
        rows[:, 1] -= rows[:, 1].min()
        return cls(rows, horizon=horizon, gamma=gamma, start=start)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Writes the transitions for :meth:`from_csv` and for the program's world ``table``.

        ``cvar-game train --env table --file PATH --set env.horizon=T --set env.start=S`` plays the game on it.
        A transition that ends the episode leads to one of two further states there: to the first one if it
        pays more than 0, which the program counts as a goal, else to the second one. States that no episode
        reaches have no transitions in the file.

        Args:
            path: The file, which is replaced.

        Raises:
            ValueError: If episodes do not start in a single state, which the world ``table`` needs.
            OSError: If the file cannot be written.
        """
        start = np.flatnonzero(self.start)
        if len(start) != 1:
            raise ValueError(f"episodes start in {len(start)} states; the world table has a single start")
        rows = self._rows[np.isin(self._rows[:, 0], self._reached(int(start[0])))]
        ends = rows[:, 2] == -1
        good = ends & (rows[:, 4] > 0.0)
        rows[good, 2] = self.states
        rows[ends & ~good, 2] = self.states + good.any()
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            for state, action, after, probability, reward in rows.tolist():
                writer.writerow([int(state), int(action), int(after), probability, reward])

    def _reached(self, start: int) -> list[int]:
        """The states that episodes can reach."""
        after: dict[int, set[int]] = {}
        for state, _, to, probability, _ in self._rows.tolist():
            if probability > 0.0 and to >= 0:
                after.setdefault(int(state), set()).add(int(to))
        seen, left = {start}, [start]
        while left:
            new = after.get(left.pop(), set()) - seen
            seen |= new
            left += new
        return sorted(seen)

    @property
    def states(self) -> int:
        """Number of states S."""
        return self._core.states

    @property
    def actions(self) -> int:
        """The most actions of a state, A."""
        return self._core.actions

    @property
    def horizon(self) -> int:
        """Time limit T in steps."""
        return self._core.horizon

    @property
    def gamma(self) -> float:
        """Discount per step."""
        return self._core.gamma

    @property
    def start(self) -> Floats:
        """The probability that an episode starts in each state, shape ``(S,)``."""
        return self._core.start

    @property
    def one_level(self) -> bool:
        """Whether the time says what has been accumulated, so that policies need time and state only."""
        return self._core.one_level

    def action_count(self, state: int) -> int:
        """Number of actions of a state; 0 where the episode has ended."""
        return self._core.action_count(state)

    def outcomes(self, state: int, action: int) -> tuple[Integers, Floats, Floats]:
        """What chance may decide after an action in a state.

        Returns:
            Next states (-1 where the transition ends the episode), probabilities and rewards, each of shape
            ``(K,)``, ascending in next state and reward.
        """
        return self._core.outcomes(state, action)

    def levels(self, time: int) -> Floats:
        """The values that the accumulated reward R_t may have at a time in [0, T), ascending."""
        return self._core.levels(time)

    def optimum(self, alpha: float) -> Optimum:
        """The best CVaR_alpha of the return that any policy attains, and a policy that attains it.

        The best one over all policies that know the whole history; one that knows time, accumulated reward
        and state is enough (Baeuerle & Ott 2011). Among policies of the same CVaR it is one of high mean.
        Its ``action(time, accumulated, state)`` is the action, ``table()`` all actions by time and state
        where :attr:`one_level` holds, and a :class:`Player` plays it.

        Args:
            alpha: Risk level in (0, 1]; 1 is the mean.
        """
        return self._core.optimum(number("alpha", alpha))

    def evaluate(self, policy: Policy) -> Law:
        """The exact law of the return under a policy: its values and probabilities, mean, VaR and CVaR.

        Args:
            policy: Action probabilities of shape ``(S, A)`` or ``(T, S, A)``, with 0 for actions that a state
                does not have; actions of shape ``(S,)`` or ``(T, S)``; or what :meth:`optimum` or
                :meth:`best_stationary` returned. What it says where the episode has ended is ignored.
        """
        if isinstance(policy, Optimum):
            return self._own(policy).law
        return self._core.evaluate(self._probabilities(policy))

    def worst_case(self, policy: Policy, eta: float) -> MdpWorstCase:
        """The worst that an antagonist can do to a deterministic policy within a budget.

        The antagonist multiplies the probabilities of the outcomes by likelihood ratios, whose product over
        an episode never exceeds eta. The worst mean return that it can reach is the CVaR of the policy at
        ``alpha = 1 / eta`` (Chow et al. 2015, "Risk-sensitive and robust decision-making", Proposition 1).
        The result has that ``value``, the ``law`` of the return against this antagonist (its mean is the
        value), the ``ratios(time, accumulated, state)`` of the outcomes in the order of :meth:`outcomes`,
        and ``table()``, all of them with shape ``(T, S, K)`` where :attr:`one_level` holds.

        Args:
            policy: As in :meth:`evaluate`. Of probabilities the likeliest action counts: against a policy
                that draws its actions such an antagonist would not be the worst.
            eta: Budget, at least 1.
        """
        eta = number("eta", eta)
        if isinstance(policy, Optimum):
            return self._own(policy).worst_case(eta)
        return self._core.worst_case(self._probabilities(policy), eta)

    def chow(self, eta: float) -> float:
        """The value that the budget-augmented dynamic programme reports.

        The programme of Chow et al. 2015 ("Risk-sensitive and robust decision-making", Theorem 2) lets the
        policy see the antagonist's remaining budget. So its value is an upper bound of the best CVaR at
        ``alpha = 1 / eta``, and in general above it (Hau et al. 2023, "On dynamic programming decompositions
        of static risk measures in Markov decision processes"). Solved without a grid of risk levels.

        Args:
            eta: Budget, at least 1.
        """
        return self._core.chow(number("eta", eta))

    def best_stationary(self, alpha: float) -> Stationary:
        """A good deterministic policy that sees the state only, found by local search: not proven the best.

        It solves for the optimum first and then evaluates at most some 4,000 policies.

        Args:
            alpha: Risk level in (0, 1].
        """
        alpha = number("alpha", alpha)
        law, actions, local_optimum, evaluated = self._core.best_stationary(alpha)
        return Stationary(
            alpha=alpha,
            cvar=law.cvar(alpha),
            var=law.var(alpha),
            mean=law.mean(),
            actions=actions,
            local_optimum=local_optimum,
            evaluated=evaluated,
            law=law,
        )

    def _own(self, optimum: Optimum) -> Optimum:
        if not self._core.has_solved(optimum):
            raise ValueError("this optimum belongs to another MDP; use that of this one")
        return optimum

    def _probabilities(self, policy: Stationary | npt.ArrayLike) -> Floats:
        """A policy as action probabilities of shape ``(S, A)`` or ``(T, S, A)``."""
        if isinstance(policy, Stationary):
            policy = policy.actions
        array = array_of("the policy", policy)
        if array.dtype.kind not in "iu":
            return numbers("the policy", array)
        shapes = ((self.states,), (self.horizon, self.states))
        if array.shape not in shapes:
            raise ValueError(
                f"a policy of whole numbers has an action for each state and must have shape {shapes[0]} or "
                f"{shapes[1]}, got {array.shape}; probabilities must be real numbers"
            )
        counts = np.array([self.action_count(state) for state in range(self.states)])
        wrong = (counts > 0) & ((array < 0) | (array >= counts))
        if wrong.any():
            place = tuple(int(index) for index in np.argwhere(wrong)[0])
            raise ValueError(
                f"policy[{', '.join(map(str, place))}] = {array[place]} is no action: state {place[-1]} has "
                f"{counts[place[-1]]}"
            )
        if array.size * self.actions > MOST_NUMBERS:
            raise ValueError(f"the policy has too many numbers as probabilities: {array.size} x {self.actions}")
        chosen = array[..., np.newaxis] == np.arange(self.actions)
        return np.ascontiguousarray(chosen, dtype=np.float64)


class Player:
    """Plays the policy of an optimum: keeps the time and the accumulated reward.

        player = Player(mdp.optimum(alpha=0.1))
        state, info = env.reset()
        player.reset()
        while not over:
            state, reward, terminated, truncated, info = env.step(player.act(state))
            player.observe(reward)

    Args:
        optimum: What :meth:`FiniteMDP.optimum` returned.
    """

    def __init__(self, optimum: Optimum) -> None:
        self.optimum = optimum
        """The optimum whose policy it plays."""
        self.reset()

    def reset(self) -> None:
        """Starts an episode."""
        self.time = 0
        """Steps since the reset."""
        self.accumulated = 0.0
        """The discounted sum of the rewards since the reset."""

    def act(self, state: int) -> int:
        """The action in a state.

        Raises:
            ValueError: If the episode has ended there, the time is up, or no episode of the MDP has
                accumulated what was observed.
        """
        return self.optimum.action(self.time, self.accumulated, whole("state", state, 0, LARGEST))

    def observe(self, reward: float) -> None:
        """Takes note of the reward of the step."""
        self.accumulated += self.optimum.gamma**self.time * number("reward", reward)
        self.time += 1


def admissible(ratios: npt.ArrayLike, probabilities: npt.ArrayLike, budget: float) -> Floats:
    """Likelihood ratios made admissible: of mean 1 under a law, and at most a budget where it has mass.

    They are divided by their mean. If the largest is above the budget, they are mixed with 1 (chance itself)
    so that the largest equals it: ``1 + w (ratios - 1)``, ``w = (budget - 1) / (largest - 1)``.

    Args:
        ratios: Numbers that are not negative, shape ``(K,)``.
        probabilities: The law, shape ``(K,)``.
        budget: At least 1.

    Raises:
        ValueError: If a ratio is negative or not finite, or all are 0 where the law has mass.
    """
    law, ratio = numbers("probabilities", probabilities), numbers("ratios", ratios)
    budget = number("budget", budget)
    if law.ndim != 1 or ratio.shape != law.shape:
        raise ValueError(f"ratios must have shape {law.shape}, got {ratio.shape}")
    if not (np.isfinite(ratio).all() and (ratio >= 0.0).all()):
        raise ValueError(f"likelihood ratios must be finite and not negative, got {shown(ratio)}")
    if not 1.0 <= budget < np.inf:
        raise ValueError(f"a budget must be a finite number of at least 1, got {budget}")
    if budget == 1.0:
        return np.ones_like(law)
    possible = law > 0.0
    largest = ratio[possible].max(initial=0.0)
    if largest == 0.0:
        raise ValueError("likelihood ratios must not all be 0 where chance has mass")
    ratio = ratio / largest
    ratio = np.where(possible, ratio / float(law @ ratio), 1.0)
    largest = ratio.max()
    if largest > budget:
        ratio = 1.0 + (ratio - 1.0) * ((budget - 1.0) / (largest - 1.0))
    # Only rounding exceeds these bounds.
    return np.clip(ratio, 0.0, budget)


class _Fixed:
    """The exact worst case of a policy between an environment and an agent."""

    def __init__(self, inner: Any, mdp: FiniteMDP, eta: float, policy: Policy) -> None:
        if not isinstance(mdp, FiniteMDP):
            raise ValueError(f"mdp = {shown(mdp)} must be a FiniteMDP, or None for that of the environment")
        self.mdp = mdp
        self.worst = mdp.worst_case(policy, eta)
        # By state and action: the outcome of the MDP that each transition is, -1 if it is impossible.
        self.places = _places(inner, mdp)
        self.reset()

    def reset(self) -> None:
        self.time = 0
        self.accumulated = 0.0

    def observe(self, reward: float) -> None:
        self.accumulated += self.mdp.gamma**self.time * reward
        self.time += 1

    def ratios(self, state: int, action: int, count: int) -> Floats:
        if self.time >= self.mdp.horizon:
            return np.ones(count)
        if self.worst.action(self.time, self.accumulated, state) != action:
            return np.ones(count)
        places = self.places[state, action]
        return np.append(self.worst.ratios(self.time, self.accumulated, state), 1.0)[places]


if TYPE_CHECKING:

    class BudgetedAntagonist(gymnasium.Wrapper[Any, Any, Any, Any]):
        """Puts a budgeted antagonist between an environment of Gymnasium's toy text and an agent."""

        eta: float
        """Budget."""

        def __init__(
            self,
            env: gymnasium.Env[Any, Any],
            mdp: FiniteMDP | None,
            eta: float,
            policy: Policy | None = None,
            *,
            ratios: Ratios | None = None,
        ) -> None: ...

        @property
        def budget(self) -> float:
            """What is left of eta."""

else:

    def __getattr__(name: str) -> Any:
        if name != "BudgetedAntagonist":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return globals().setdefault(name, _budgeted_antagonist())


def _budgeted_antagonist() -> type[Any]:
    """The class :class:`BudgetedAntagonist`, made on first use because its base is Gymnasium's."""
    import gymnasium

    class BudgetedAntagonist(
        gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs
    ):
        """Puts a budgeted antagonist between an environment of Gymnasium's toy text and an agent.

        In each step the antagonist multiplies the probabilities of the outcomes by likelihood ratios, and an
        outcome is drawn by the new ones. The budget starts at eta, and the ratio of what happened divides
        it: ``eta' = eta / ratio``. No ratio is above the budget, so that their product over an episode
        never exceeds eta.

        With a ``policy`` the antagonist is the exact worst case of it (of its greedy version). Where the
        agent takes another action it leaves chance alone, and so it does after the time limit of the MDP.
        It acts on the draw of the start as well, where this is drawn: so the mean return of an agent that
        plays the policy is its CVaR at ``alpha = 1 / eta``.

        With ``ratios`` it is a function ``(state, action, probabilities, budget) -> ratios`` for the outcomes
        ``env.unwrapped.P[state][action]``. Its answer is made :func:`admissible`. The start is left alone.

        ``info`` has ``likelihood_ratio``, that of what happened, and ``budget``, what is left. The random
        stream is used as the environment uses it, so that at ``eta = 1`` episodes are the same as without
        the wrapper. While the environment takes its step, ``env.unwrapped.P`` has only the drawn outcome.

        Args:
            env: An environment with ``env.unwrapped.P``, such as FrozenLake, CliffWalking or Taxi.
            mdp: Its MDP, :meth:`FiniteMDP.from_env`; ``None`` for that, or with ``ratios``.
            eta: Budget, at least 1.
            policy: The policy whose worst case it is, as in :meth:`FiniteMDP.worst_case`.
            ratios: Another antagonist, in place of a policy.

        Raises:
            ValueError: If there is not exactly one of ``policy`` and ``ratios``, the MDP is not that of the
                environment, or a number is out of range.
        """

        def __init__(
            self,
            env: gymnasium.Env[Any, Any],
            mdp: FiniteMDP | None,
            eta: float,
            policy: Policy | None = None,
            *,
            ratios: Ratios | None = None,
        ) -> None:
            gymnasium.utils.RecordConstructorArgs.__init__(
                self, _disable_deepcopy=True, mdp=mdp, eta=eta, policy=policy, ratios=ratios
            )
            gymnasium.Wrapper.__init__(self, env)
            if (policy is None) == (ratios is None):
                raise ValueError("an antagonist needs either a policy or ratios")
            self.eta = number("eta", eta)
            """Budget."""
            if not 1.0 <= self.eta < np.inf:
                raise ValueError(f"the budget eta must be a finite number of at least 1, got {self.eta}")
            inner: Any = env.unwrapped
            _table_rows(inner)
            if ratios is not None and not callable(ratios):
                raise ValueError("ratios must be a function (state, action, probabilities, budget)")
            self._ratios = ratios
            self._worst: _Fixed | None = None
            if policy is not None:
                mdp = FiniteMDP.from_env(env) if mdp is None else mdp
                self._worst = _Fixed(inner, mdp, self.eta, policy)
            self._budget = self.eta
            self._over = True

        @property
        def budget(self) -> float:
            """What is left of eta."""
            return self._budget

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            inner: Any = self.env.unwrapped
            ratio = 1.0
            law = getattr(inner, "initial_state_distrib", None)
            if self._worst is None or law is None:
                observation, info = self.env.reset(seed=seed, options=options)
            else:
                self._worst.reset()
                ratios = admissible(self._worst.worst.start_ratios(), law, self.eta)
                try:
                    inner.initial_state_distrib = np.asarray(law, dtype=np.float64) * ratios
                    observation, info = self.env.reset(seed=seed, options=options)
                finally:
                    inner.initial_state_distrib = law
                ratio = float(ratios[int(inner.s)])
            self._over = False
            self._budget = _spent(self.eta, ratio)
            return observation, {**info, "likelihood_ratio": ratio, "budget": self._budget}

        def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
            inner: Any = self.env.unwrapped
            if self._over or not self.env.action_space.contains(action):
                # The environment says what is wrong, or goes on by itself.
                observation, reward, terminated, truncated, info = self.env.step(action)
                return observation, reward, terminated, truncated, {
                    **info, "likelihood_ratio": 1.0, "budget": self._budget
                }  # fmt: skip
            state, chosen = int(inner.s), int(action)
            actions = inner.P[state]
            outcomes = actions[chosen]
            law = np.array([outcome[0] for outcome in outcomes], dtype=np.float64)
            if self._worst is not None:
                wanted: npt.ArrayLike = self._worst.ratios(state, chosen, len(law))
            else:
                assert self._ratios is not None
                wanted = self._ratios(state, chosen, law.copy(), self._budget)
            ratios = admissible(wanted, law, self._budget)
            index = _drawn(law * ratios, inner.np_random)
            try:
                actions[chosen] = [outcomes[index]]
                observation, reward, terminated, truncated, info = self.env.step(action)
            finally:
                actions[chosen] = outcomes
            ratio = float(ratios[index])
            self._budget = _spent(self._budget, ratio)
            self._over = bool(terminated or truncated)
            if self._worst is not None:
                self._worst.observe(float(outcomes[index][2]))
            info = {**info, "likelihood_ratio": ratio, "budget": self._budget}
            return observation, reward, terminated, truncated, info

    BudgetedAntagonist.__qualname__ = "BudgetedAntagonist"
    return BudgetedAntagonist


def _spent(budget: float, ratio: float) -> float:
    # Only rounding takes it below 1.
    return min(max(budget / ratio, 1.0), LARGEST_BUDGET)


def _drawn(law: Floats, random: np.random.Generator) -> int:
    """Draws an outcome with the random number that the environment will use next, as it would."""
    before = random.bit_generator.state
    number = random.random()
    random.bit_generator.state = before
    sums = np.cumsum(law)
    index = int(np.argmax(sums > number))
    # The sum may be below the number by rounding.
    return index if sums[index] > number else int(np.flatnonzero(law)[-1])


def _places(inner: Any, mdp: FiniteMDP) -> dict[tuple[int, int], Integers]:
    """By state and action: the MDP's outcome of each transition, -1 for impossible ones."""
    other = "the MDP is not that of the environment; use FiniteMDP.from_env(env)"
    rows, states = _table_rows(inner)
    if states != mdp.states:
        raise ValueError(f"{other}: it has {mdp.states} states in place of {states}")
    known: dict[tuple[int, int], dict[tuple[int, float], int]] = {}
    sums: dict[tuple[int, int], Floats] = {}
    places: dict[tuple[int, int], list[int]] = {}
    for state, action, next_state, probability, reward in rows:
        pair = (int(state), int(action))
        if pair not in known:
            if pair[1] >= mdp.action_count(pair[0]):
                raise ValueError(f"{other}: it has no action {pair[1]} in state {pair[0]}")
            found, law, rewards = mdp.outcomes(*pair)
            known[pair] = {
                (int(found[i]), float(rewards[i])): i for i in range(len(found))
            }
            sums[pair], places[pair] = law.copy(), []
        place = known[pair].get((int(next_state), float(reward)), -1)
        if place >= 0:
            sums[pair][place] -= probability
        elif probability > 0.0:
            raise ValueError(f"{other}: they differ in state {pair[0]}, action {pair[1]}")
        places[pair].append(place)
    for pair, left in sums.items():
        if np.abs(left).max() > 1e-6:
            raise ValueError(f"{other}: they differ in state {pair[0]}, action {pair[1]}")
    return {pair: np.array(of, dtype=np.int64) for pair, of in places.items()}


def _table_rows(inner: Any) -> tuple[list[tuple[float, float, float, float, float]], int]:
    """Transitions and number of states of a toy-text environment."""
    table = getattr(inner, "P", None)
    if not isinstance(table, (Mapping, Sequence)) or len(table) == 0:
        raise ValueError(
            "the environment has no table env.unwrapped.P of transitions, as those of toy text have"
        )
    if getattr(inner, "fickle_passenger", False):
        raise ValueError("the environment's table P leaves out the fickle passenger; make it without one")
    rows: list[tuple[float, float, float, float, float]] = []
    pairs = 0
    for state in range(len(table)):
        try:
            actions = table[state]
            pairs += 1 + len(actions)
            if pairs > LARGEST:
                break
            for action in range(len(actions)):
                for probability, next_state, reward, terminated in actions[action]:
                    if len(rows) == LARGEST:
                        break
                    next_state = -1 if terminated else int(next_state)
                    row = (state, action, next_state, float(probability), float(reward))
                    rows.append(row)
        except (IndexError, KeyError, OverflowError, TypeError, ValueError):
            raise ValueError(
                f"env.unwrapped.P[{state}] must be {{action: [(probability, next, reward, terminated)]}}, "
                "with states and actions numbered from 0"
            ) from None
    if max(pairs, len(rows)) >= LARGEST:
        raise ValueError(f"env.unwrapped.P must have fewer than {LARGEST} actions and transitions")
    return rows, len(table)


def _read_csv(path: str | os.PathLike[str], name: str) -> tuple[Floats, list[int]]:
    """Rows of a CSV file in the order of :data:`COLUMNS`, and their line numbers."""
    rows: list[list[float]] = []
    lines: list[int] = []
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file, strict=True)
        try:
            header = [cell.strip().lower() for cell in next(reader, [])]
            missing = [column for column in COLUMNS if column not in header]
            if missing:
                raise ValueError(f"{name}, line 1: the header must have {','.join(COLUMNS)}")
            places = [header.index(column) for column in COLUMNS]
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                rows.append(_csv_row(cells, places, f"{name}, line {reader.line_num}"))
                lines.append(reader.line_num)
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{name}, line {reader.line_num + 1}: {error}") from None
    if not rows:
        raise ValueError(f"{name} has no transitions")
    return np.array(rows, dtype=np.float64), lines


def _check_csv(path: str, rows: Floats, lines: list[int]) -> None:
    """Refuses what only several lines together say, in the file's own ids."""
    for columns, name in (([0, 2], "states"), ([1], "actions")):
        least = int(rows[:, columns].min())
        if least not in (0, 1):
            raise ValueError(f"{path}: the ids of {name} must start at 0 or 1, got {least}")
    sums: dict[tuple[int, int], float] = {}
    first: dict[tuple[int, int], int] = {}
    for (state, action, _, probability, _), line in zip(rows.tolist(), lines, strict=True):
        pair = (int(state), int(action))
        sums[pair] = sums.get(pair, 0.0) + probability
        first.setdefault(pair, line)
    for (state, action), line in first.items():
        if abs(sums[state, action] - 1.0) > 1e-6:
            raise ValueError(
                f"{path}, line {line}: the probabilities of action {action} in state {state} sum to "
                f"{sums[state, action]:.9g}, not to 1"
            )
        if action > least and (state, action - 1) not in first:
            raise ValueError(
                f"{path}, line {line}: state {state} has an action {action} but no action {action - 1}"
            )


def _csv_row(cells: list[str], places: list[int], where: str) -> list[float]:
    row = []
    for name, place in zip(COLUMNS, places, strict=True):
        if place >= len(cells):
            raise ValueError(f"{where}: there is no {name}")
        try:
            value = float(cells[place])
        except ValueError:
            raise ValueError(f"{where}: {name} = {cells[place]!r} is no number") from None
        if name.startswith("id"):
            possible, range_ = value.is_integer() and 0 <= value <= LARGEST, "a whole number from 0"
        elif name == "probability":
            possible, range_ = 0.0 <= value <= 1.0 + 1e-6, "in [0, 1]"
        else:
            possible, range_ = abs(value) <= 1e100, "a finite number"
        if not possible:
            raise ValueError(f"{where}: {name} = {cells[place].strip()} must be {range_}")
        row.append(value)
    return row


def _rows(transitions: npt.ArrayLike | Iterable[Sequence[float]]) -> Floats:
    """Transitions as an array of shape ``(N, 5)`` whose first three columns are whole numbers."""
    names = "(state, action, next, probability, reward)"
    try:
        if not hasattr(transitions, "__array__"):
            transitions = list(transitions)  # type: ignore[arg-type, assignment]
        rows = np.array(transitions, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, MemoryError):
        raise ValueError(f"transitions must be rows of five numbers, {names}") from None
    if len(rows) == 0:
        raise ValueError(f"there are no transitions {names}")
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise ValueError(f"transitions must have shape (N, 5), {names}, got {rows.shape}")
    # NaN and infinity are no whole numbers either.
    ids = rows[:, :3]
    wrong = ~((np.abs(ids) <= LARGEST) & (ids == np.round(ids)))
    if wrong.any():
        row, column = (int(index) for index in np.argwhere(wrong)[0])
        raise ValueError(
            f"transition {row}: {('state', 'action', 'next')[column]} = {rows[row, column]:g} must be a whole "
            f"number of at most {LARGEST}"
        )
    return rows


def _restore(rows: Floats, horizon: int, gamma: float, start: Floats, states: int) -> FiniteMDP:
    return FiniteMDP(rows, horizon=horizon, gamma=gamma, start=start, states=states)
