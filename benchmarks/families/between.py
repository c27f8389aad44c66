"""python -m benchmarks.families.between: rows within stages, on drawn problems of six kinds with few stages each.

What is left is measured at 1,000 instants of each stage, by steps and rows written here.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown
from torchgco import (
    BetweenKnots,
    Cone,
    Constraint,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    NormBounds,
    Problem,
    QuadraticCost,
    Solution,
    StateBounds,
)

INSTANTS = 1000  # of each stage
ROUNDS = 5
HEAD = (
    "rows", "stages", "converged", "knots alone", "three points", *(f"round {i + 1}" for i in range(ROUNDS)),
    "cost more, %", "time", "first three points",
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """Problems of one kind of row; starts, and what they begin with, are drawn."""

    field: Callable[[Tensor, Tensor], Tensor]
    rows: Sequence[Constraint]
    excess: Callable[[np.ndarray], np.ndarray]  # of states (..., n), in the units of the rows
    cost: QuadraticCost
    start: Sequence[float]
    spread: Sequence[float]  # of the starts
    dt: float
    N: int
    most: float  # of each control

    def problem(self, count: int, seed: int, *more: Constraint) -> Problem:
        draws = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, len(self.start)))
        x0 = torch.from_numpy(np.asarray(self.start) + np.asarray(self.spread) * draws)
        model = FunctionDynamics(self.field, len(self.start), len(self.cost.R), self.dt, "rk4")
        bounds = ControlBounds(-self.most, self.most)
        return Problem(model, self.cost, [bounds, *self.rows, *more], x0, self.N)

    def left(self, solution: Solution) -> float:
        """The largest excess within stages, of the states to which one step of rk4 leads from the knot before."""
        X, worst = solution.X[:, :-1], 0.0
        for h in torch.linspace(0.0, self.dt, INSTANTS + 2, dtype=X.dtype)[1:-1]:
            a = self.field(X, solution.U)
            b = self.field(X + 0.5 * h * a, solution.U)
            c = self.field(X + 0.5 * h * b, solution.U)
            x = X + h / 6.0 * (a + 2.0 * b + 2.0 * c + self.field(X + h * c, solution.U))
            worst = max(worst, float(self.excess(x.numpy()).max()))
        return worst


def turning(x: Tensor, u: Tensor) -> Tensor:
    """A point whose velocity is turned all the while, as on a rotating table."""
    v = x[..., 2:]
    return torch.cat((v, u + 1.5 * torch.stack((-v[..., 1], v[..., 0]), -1)), -1)


def point(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat((x[..., 2:], u), -1)


def falling(x: Tensor, u: Tensor) -> Tensor:
    gravity = torch.tensor([0.0, 0.0, 1.6], dtype=x.dtype)
    return torch.cat((x[..., 3:], u - gravity), -1)


def swinging(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 9.0 * x[..., 0]), -1)


def speed(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x[..., 2:], axis=-1)


def to(x_ref: list[float], end: list[float], R: int) -> QuadraticCost:
    return QuadraticCost(Q=[0.0] * len(x_ref), R=[0.01] * R, Qf=end, x_ref=x_ref)


OUTER = FunctionConstraint(lambda x: x[..., :2].square().sum(-1, keepdim=True) - 1.21, name="outer")
INNER = FunctionConstraint(lambda x: 0.81 - x[..., :2].square().sum(-1, keepdim=True), name="inner")
OVAL = FunctionConstraint(lambda x: 1.0 - (x[..., :1] / 0.6).square() - (x[..., 1:2] / 0.3).square(), name="oval")
GROUND = FunctionConstraint(lambda x: 0.2 * torch.sin(3.0 * x[..., :1]) - x[..., 1:2], name="ground")
PLANE_END = [100.0, 100.0, 10.0, 10.0]
KINDS = {
    "a ring": Kind(
        point, [OUTER, INNER], lambda x: abs(np.square(x[..., :2]).sum(-1) - 1.01) - 0.2,
        to([-1.0, 0, 0, 0], PLANE_END, 2),
        [1.0, 0.0, 0.0, 0.5], [0.05, 0.05, 0.1, 0.2], 0.35, 6, 9.0,
    ),
    "a bound of a speed": Kind(
        swinging, [StateBounds([-9.0, -1.5], [9.0, 1.5])], lambda x: abs(x[..., 1]) - 1.5,
        QuadraticCost([1.0, 0.0], [0.01], [10.0, 10.0]), [0.6, 0.0], [0.2, 0.3], 0.25, 16, 6.0,
    ),
    "a norm of a velocity": Kind(
        turning, [NormBounds(("x", [2, 3]), upper=1.0)], lambda x: speed(x) - 1.0, to([2.0, 1.0, 0, 0], PLANE_END, 2),
        [0.0, 0.0, 0.3, 0.0], [0.2, 0.2, 0.2, 0.2], 0.4, 10, 3.0,
    ),
    "a cone": Kind(
        falling, [Cone([0, 0, 1], math.radians(46.0), ("x", [0, 1, 2]), apex=[0.0, 0.0, -0.02])],
        lambda x: np.cos(np.radians(46.0)) * np.linalg.norm(x[..., :3] + [0, 0, 0.02], axis=-1) - x[..., 2] - 0.02,
        to([0.0] * 6, [100.0] * 3 + [10.0] * 3, 3), [1.5, 0.0, 2.2, -0.5, 0.6, 0.0], [0.2, 0.2, 0.2, 0.3, 0.3, 0.3],
        0.5, 8, 4.0,
    ),
    "an oval to go around": Kind(
        point, [OVAL], lambda x: 1.0 - np.square(x[..., 0] / 0.6) - np.square(x[..., 1] / 0.3),
        to([1.0, 0.0, 0, 0], PLANE_END, 2), [-1.0, 0.15, 0.0, 0.4], [0.1, 0.1, 0.1, 0.2], 0.35, 7, 6.0,
    ),
    "ground below": Kind(
        point, [GROUND], lambda x: 0.2 * np.sin(3.0 * x[..., 0]) - x[..., 1], to([3.0, 0.0, 0, 0], PLANE_END, 2),
        [0.0, 0.3, 0.5, 0.0], [0.2, 0.1, 0.2, 0.1], 0.4, 10, 4.0,
    ),
}  # fmt: skip


def row(name: str, count: int, seed: int) -> list[str]:
    """Knots alone, three points, then rounds of `tightened`, and what they take together."""
    kind = KINDS[name]
    plain = kind.problem(count, seed)
    within = problem = kind.problem(count, seed, *(BetweenKnots(row) for row in kind.rows))
    solve = lambda p, **more: torchgco.solve(p, solver="interior_point", verbose=False, **more)
    alone, solution = solve(plain), solve(within)
    left = [kind.left(alone), kind.left(solution)]
    for again in range(2):  # the first compiles
        problem, solution = within, solve(within)
        took, first = [], time.process_time()
        solve(within)
        first = time.process_time() - first
        for _ in range(ROUNDS):
            began = time.process_time()
            problem = torchgco.tightened(problem, solution)
            solution = solve(problem, warm=solution, X0=solution.X)
            took.append(time.process_time() - began)
            if again:
                left.append(kind.left(solution))
    solve(plain)  # as `within` above was solved just before
    began = time.process_time()
    solve(plain)
    plainly = time.process_time() - began
    converged = sum(status.name == "CONVERGED" for status in solution.statuses)
    more = 100.0 * float(((solution.cost - alone.cost) / alone.cost.abs()).median())
    cells = [name, f"{kind.N}", f"{converged} of {count}", *(f"{max(0.0, value):.1e}" for value in left)]
    return [*cells, f"{more:.2f}", f"{(first + sum(took)) / plainly:.1f}", f"{first / plainly:.1f}"]


def table(count: int, seed: int) -> str:
    return markdown(HEAD, rows(count, seed))


def rows(count: int, seed: int) -> Iterator[list[str]]:
    for name in KINDS:
        yield row(name, count, seed)


main = Command(
    __doc__, "between", table, "{count} drawn problems of each, seed {seed}",
    count=(32, "problems of each kind"), seed=(2718, "of what is drawn"),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
