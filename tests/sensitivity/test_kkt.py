"""Solves with the matrix of the KKT conditions, in C and in PyTorch, against one dense matrix in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference.kkt import dense_kkt
from tests.slow import mostly
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
)
from torchgco.kernels import interior_of, use_native
from torchgco.lagrangian.kkt import KktSolve, RightSides

B, N, D = 9, 6, torch.float64  # one problem more than lanes
COLUMNS = 2


def draw(seed: int) -> Callable[..., Tensor]:
    random = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.rand(*shape, generator=random, dtype=D) * 2 - 1


def curved(traced_cost: bool) -> Problem:
    """Curved dynamics, rows of every kind of which no two are alike, and a cost convex enough for a strict minimum."""
    random = draw(0)

    def field(x: Tensor, u: Tensor, a: Tensor) -> Tensor:
        (p, q, r), (v, w) = x.unbind(-1), u.unbind(-1)
        return torch.stack((a[..., 0] * (q + r).sin() + v * r.cos(), v * w + r * r, w + 0.3 * p * q), dim=-1)

    def stage(x: Tensor, u: Tensor) -> Tensor:
        return 3 * x.square().sum(-1) + 4 * u.square().sum(-1) + (x[..., 0] * u[..., 1]).cos()

    model = FunctionDynamics(field, 3, 2, 0.2, "rk4", slice(0, 2), values={"a": random(B, 1)})
    cost = FunctionCost(stage, lambda x: 5 * x.square().sum(-1) + x[..., 0].exp())
    weights = torch.tensor([[4.0, 0.3], [0.3, 5.0]], dtype=D)
    quadratic = QuadraticCost(
        [6.0, 5.0, 7.0], weights, [9.0, 8.0, 9.0], x_ref=random(B, N + 1, 3), u_ref=random(B, 1, 2)
    )
    constraints = [
        ControlBounds([-1.0, -1.5], [2.0, 1.0]),
        FunctionConstraint(lambda x: (x[..., :1] * x[..., 1:2] + x[..., 2:]).sin() - 0.1, "equality", knots=[N]),
        FunctionConstraint(
            lambda x, u: u.square().sum(-1, keepdim=True) + x[..., :1].sin() - 1.5, knots=[0, 2], of="xu"
        ),
        StateBounds([-1.5, -torch.inf, -1.2], [1.5, torch.inf, 1.3], knots=[1, 2, 4]),
        Spheres(2 * random(B, 2, 2), 0.4 + 0.1 * random(B, 2), 0.1, velocities=0.1 * random(B, 2, 2)),
        Boxes(1.5 + random(B, 1, 2), torch.full((B, 1, 2), 0.3, dtype=D), 0.2),
    ]
    return Problem(model, cost if traced_cost else quadratic, constraints, 0.3 * random(B, 3), N)


def systems(problem: Problem) -> tuple[Tensor, Tensor, tuple[Tensor, ...], Tensor, RightSides]:
    """A point with multipliers, rows that hold, few enough not to depend on each other, and right hand sides."""
    random = draw(1)
    X, U = 0.5 * random(B, N + 1, 3), 0.5 * random(B, N, 2)
    X[:, 0] = problem.x0
    lam = tuple(random(B, *shape) for shape in problem.row_shapes)
    lam = tuple(part if c.sense == "equality" else part.abs() for part, c in zip(lam, problem.constraints, strict=True))
    held = [torch.zeros(B, K, p, dtype=torch.bool) for K, p in problem.row_shapes]
    held[0][:, 1, 0] = held[0][:, 3, 3] = held[1][:] = held[2][:, 1] = held[3][:, 2, 1] = held[4][:, 2, 1] = True
    held[5][::2, 4] = True
    active = torch.cat([part.flatten(1) for part in held], dim=1)
    R = active.shape[1]
    return X, U, lam, active, RightSides(random(COLUMNS, B, N + 1, 5), random(COLUMNS, B, N, 3), random(COLUMNS, B, R))


def solved(problem: Problem, native: bool, give: Tensor | None = None) -> KktSolve:
    use_native(native)
    try:
        return interior_of(problem.renewed()).kkt(problem, *systems(problem), give)
    finally:
        use_native(True)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", mostly([True, False], False))
@pytest.mark.parametrize(
    ("traced_cost", "barrier"), [(True, False), pytest.param(False, False, marks=pytest.mark.slow), (False, True)]
)
def test_solutions_are_those_of_a_dense_matrix(native: bool, traced_cost: bool, barrier: bool) -> None:
    """With rows that hold as equalities, or that give way to their multipliers by shares of very different sizes."""
    problem = curved(traced_cost)
    X, U, lam, active, right = systems(problem)
    inside = torch.cat(
        [
            torch.full((p[0] * p[1],), c.sense != "equality")
            for p, c in zip(problem.row_shapes, problem.constraints, strict=True)
        ]
    )
    give = 10.0 ** (6 * draw(2)(*active.shape)) * inside if barrier else None
    found = solved(problem, native, give)
    assert bool(found.definite.all()) and float(found.left.max()) < 1e-12
    for b in (0, 4, 8):
        one, rows = slice(b, b + 1), active[b].numpy()
        matrix, y = dense_kkt(problem.take(one), X[one], U[one], tuple(part[one] for part in lam), rows)
        if give is not None:
            last = np.arange(len(matrix) - rows.sum(), len(matrix))
            matrix[last, last] -= give[b].numpy()[rows]
        np.testing.assert_allclose(found.costates[b, 1:], y, atol=1e-11)
        for c in range(COLUMNS):
            a = torch.cat((right.a[c, b, 1:, :3].flatten(), right.a[c, b, :-1, 3:].flatten()))
            side = torch.cat((a, right.b[c, b].flatten(), right.c[c, b][active[b]]))
            z = torch.cat((found.z[c, b, 1:, :3].flatten(), found.z[c, b, :-1, 3:].flatten()))
            mine = torch.cat((z, found.y[c, b].flatten(), found.v[c, b][active[b]]))
            np.testing.assert_allclose(mine, np.linalg.solve(matrix, -side.numpy()), atol=1e-9, rtol=1e-9)
            assert not found.z[c, b, 0, :3].any() and not found.v[c, b][~active[b]].any()


@pytest.mark.slow
def test_problems_do_not_depend_on_their_batch() -> None:
    problem = curved(False)
    whole, (X, U, lam, active, right) = solved(problem, True), systems(problem)
    rows = torch.tensor([7, 2])
    part = problem.take(rows)
    some = RightSides(right.a[:, rows], right.b[:, rows], right.c[:, rows])
    found = interior_of(part).kkt(part, X[rows], U[rows], tuple(one[rows] for one in lam), active[rows], some)
    for name in ("z", "y", "v", "left"):
        assert torch.equal(getattr(found, name), getattr(whole, name)[:, rows])
    assert torch.equal(found.costates, whole.costates[rows])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", [True, False])
def test_rows_that_depend_on_each_other_and_saddles_are_told(native: bool) -> None:
    ends = FunctionConstraint(lambda x: x[..., :1], "equality", knots=[N])
    model = FunctionDynamics(lambda x, u: u, 1, 1, 0.1)
    cost = FunctionCost(lambda x, u: u.square().sum(-1), lambda x: -100.0 * x.square().sum(-1))
    for constraints, definite, dependent in (([ends], True, False), ([ends, ends], True, True), ([], False, False)):
        problem = Problem(model, cost, constraints, [[1.0]], N)
        use_native(native)
        try:
            X, U = torch.zeros(1, N + 1, 1, dtype=D), torch.zeros(1, N, 1, dtype=D)
            R = len(constraints)
            lam, active = tuple(torch.zeros(1, 1, 1, dtype=D) for _ in constraints), torch.ones(1, R, dtype=torch.bool)
            c = torch.arange(1.0, R + 1.0, dtype=D).view(1, 1, R)
            right = RightSides(torch.ones(1, 1, N + 1, 2, dtype=D), torch.zeros(1, 1, N, 1, dtype=D), c)
            found = interior_of(problem).kkt(problem, X, U, lam, active, right)
        finally:
            use_native(True)
        assert bool(found.definite) == definite
        assert not definite or (float(found.left) > 0.1) == dependent
