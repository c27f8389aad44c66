"""What an exported controller's own test compares with: periods in Python, of every element."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.compiled import Answer, Compiled, compile
from torchgco.export.exported import NEAR, Exported
from torchgco.export.tables import table
from torchgco.problem.in_time import states_in_time
from torchgco.receding.plan import Plan

PERIODS = 40  # of each element
LEAST = 1e-6  # of their size, where they hardly change: some last bits of single precision
DISTURBED = 1e-3  # of the size of each state along the plan: by how much the test's states are off it
FLOWN = 0.6  # of the time of the first plan, that the test lasts at most where the time is free


@dataclass
class Periods:
    """Periods one after the other, element by element.

    Attributes:
        elapsed: s, between two steps where the time is free.
        ranges: by how much controls change along the plans, (m,), and how large they are.
    """

    elapsed: float
    ranges: tuple[np.ndarray, np.ndarray] | None = None
    states: list[np.ndarray] = field(default_factory=list)
    controls: list[np.ndarray] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    elements: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.states)


def periods_of(exported: Exported) -> Periods:
    """Those of each element in Python, as long as they converge."""
    free, begin, B = exported.is_free, exported.begin, exported.problem.B
    compiled = compile(
        exported.compiled.now, "interior_point", ["x0", *exported.previous], exported.receding and not free,
        exported.compiled.interior.tolerance,
    )  # fmt: skip
    elapsed = exported.period
    if begin.plan is not None:
        elapsed = min(elapsed, FLOWN * float(begin.plan[2][:, -1].min()) / PERIODS)
    each, runs = [Periods(elapsed) for _ in range(B)], np.full(B, not free or begin.plan is not None)
    x, draws = compiled.problem.x0.numpy().copy(), np.random.default_rng(0)
    first, plans = x, list[np.ndarray]()
    for k in range(PERIODS):
        answer = _stepped(compiled, exported, x, elapsed if k else 0.0, k == 0)
        runs &= answer.status.numpy() == Status.CONVERGED
        if free and k == 0:
            runs &= compiled._good(np.ones(B, dtype=bool))  # and not by a search, which C hasn't
        if not runs.any():
            break
        u = _controls(compiled, exported, answer)
        compiled.numbers.write(dict.fromkeys(exported.previous, u))
        plans.append(answer.U[torch.from_numpy(runs)].flatten(0, 1).numpy())
        for b in runs.nonzero()[0].tolist():
            each[b].states.append(x[b])
            each[b].controls.append(u[b].numpy())
            each[b].iterations.append(int(answer.iterations[b]))
            each[b].elements.append(b)
        later = _states_at(answer, elapsed) if exported.receding else first
        x = later + DISTURBED * answer.X.abs().amax(1).numpy() * draws.standard_normal(x.shape)
    U = np.concatenate(plans) if plans else np.zeros((1, exported.problem.m))
    every = Periods(elapsed, (np.ptp(U, axis=0), np.abs(U).max(axis=0)))
    for one in each:
        for name in ("states", "controls", "iterations", "elements"):
            getattr(every, name).extend(getattr(one, name))
    return every


def _stepped(compiled: Compiled, exported: Exported, x: np.ndarray, elapsed: float, is_first: bool) -> Answer:
    """A call from the states x (B, n); where the time is free, the first one begins with the plan that C has."""
    if not exported.is_free:
        return compiled.call({"x0": x}, shift=exported.period)  # type: ignore[no-any-return]
    plan, user = exported.begin.plan, compiled.problem
    if not is_first or plan is None:
        return compiled.call({"x0": x}, elapsed=elapsed)  # type: ignore[no-any-return]
    (X, U, t), (*firsts, last) = plan, (*user.time.segments, user.N)
    # As C computes them, whose bits these are compared with: `in_time.factors_of` adds up stage by stage.
    ends = [*firsts[1:], last]
    lengths = user.dynamics.dt * t.new_tensor([b - a for a, b in zip(firsts, ends, strict=True)])
    factors = ((t[:, ends] - t[:, firsts]) / lengths).clamp(user.time.least, user.time.most)
    lifted = states_in_time(user, X, U, factors)
    return compiled.call(  # type: ignore[no-any-return]
        {"x0": x}, begin=lambda problem, rows: (lifted[0][rows], lifted[1][rows])
    )


def _controls(compiled: Compiled, exported: Exported, answer: Answer) -> Tensor:
    """What C returns of an answer, (B, m)."""
    problem, u = compiled.problem, answer.u
    if exported.period_seconds > 0:
        start = answer.X.new_zeros(len(answer.X))
        dynamics, knots = problem.dynamics, answer.t
        plan = Plan(X=answer.X, U=answer.U, K=answer.K, start=start, dt=exported.dt, dynamics=dynamics, knots=knots)
        u = plan.mean(0.0, exported.period_seconds)
    if problem.control_bounds is not None:
        low, high = problem.control_bounds.over(problem.N)
        u = torch.minimum(torch.maximum(u, low[:, 0]), high[:, 0])
    return u


def _states_at(answer: Answer, later: float) -> np.ndarray:
    """The states (B, n) of an answer so many seconds, or stages, after its start, on straight lines."""
    B, knots, _ = answer.X.shape
    times = np.tile(np.arange(knots), (B, 1)) if answer.t is None else answer.t.numpy()
    each = zip(times, answer.X.numpy(), strict=True)
    return np.array([[np.interp(later, t, values) for values in X.T] for t, X in each])


def compared(exported: Exported, periods: Periods) -> dict[str, str]:
    """What the test compares with, and how: in double precision all bits."""
    flat = lambda rows: [float(value) for row in rows for value in row] or [0.0]
    is_double, many = exported.number == 8, exported.problem.B > 1
    assert periods.ranges is not None
    near = np.maximum(NEAR * periods.ranges[0], LEAST * periods.ranges[1])
    tables = [
        table("static const double states[]", flat(periods.states)),
        table("static const double controls[]", flat(periods.controls)),
        table("static const double near[]", [0.0] * len(near) if is_double else near.tolist()),
        *([table("static const int iterations[]", periods.iterations or [0])] if is_double else []),
        *([table("static const int elements[]", periods.elements or [0])] if many else []),
    ]
    bits = "The bits are those of a processor with fused products, and of -ffp-contract=off."
    wrong = bits if is_double else "Controls differ by more than rounding in single precision makes them."
    words: dict[str, Any] = {
        "ITERATIONS": " && workspace.iterations == iterations[k]" if is_double else "",
        "IS_FIRST": "!k || elements[k] != elements[k - 1]" if many else "!k",
        "ELEMENT": ", elements[k]" if many else "",
        "ELAPSED": f"{periods.elapsed!r}" if exported.is_free else f"{exported.name}_STAGES",
    }
    return words | {"TABLES": "\n".join(tables), "OTHERWISE": wrong}
