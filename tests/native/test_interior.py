"""Steps of the interior point, in C and in PyTorch, against dense linear systems (tests/reference/interior.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference.interior import Array, Point, Program, begin, moved, newton_step
from tests.slow import mostly
from torchgco import (
    Body,
    Boxes,
    ControlBounds,
    Field,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    RateBounds,
    Separation,
    Spheres,
    StateBounds,
)
from torchgco.kernels import interior_of, use_native
from torchgco.maps import OccupancyGrid
from torchgco.problem.carried import with_carried
from torchgco.problem.scale import CostScale
from torchgco.solvers.interior import InteriorPoint

pytestmark = [
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning"),
    pytest.mark.usefixtures("native"),
]

B, D = 9, torch.float64  # one problem more than lanes
LOOKED_AT = (0, 5, 8)  # the last one takes a lane that another problem has left
# Without what would make a step another one than the formulae's: corrections, shifts after short steps, softer steps.
PLAIN = InteriorPoint(1e-6).options(
    False, max_soc=0, crawl=0.0, explodes=1e300, watchdog_shortened_iter_trigger=100,
    nlp_scaling_obj_target_gradient=100.0,
)  # fmt: skip
UNSCALED = CostScale(*torch.zeros(3, B, dtype=D))


def draw(seed: int) -> Callable[..., Tensor]:
    random = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.rand(*shape, generator=random, dtype=D) * 2 - 1


def curved(seed: int) -> Problem:
    """Strongly curved dynamics and rows of every kind; a terminal equality is given twice."""
    N, random = 5, draw(seed)

    def field(x: Tensor, u: Tensor, a: Tensor, k: Tensor) -> Tensor:
        (p, q, r), (v, w) = x.unbind(-1), u.unbind(-1)
        first = a[..., 0] * q * (2 * p).sin() + v * r.cos()
        return torch.stack((first, v * w + a[..., 1] * r * r, w + p * q * v - 0.1 * r * k), dim=-1)

    def stage(x: Tensor, u: Tensor) -> Tensor:
        return (2 * x[..., 0] + u[..., 0]).cos() + x.square().sum(-1) * (1 + u[..., 1].square()) + u.square().sum(-1)

    def mixed(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 0] * u[..., 0] - 0.6, u.square().sum(-1) + x[..., 1].sin() - 1.5), dim=-1)

    def last(x: Tensor) -> Tensor:
        return (x[..., :1] * x[..., 1:2] + x[..., 2:]).sin() - 0.1

    ends = FunctionConstraint(last, "equality", knots=[N])
    high = 1.0 + 0.5 * random(B, N, 2).abs()
    constraints = [
        ControlBounds(-high, high),
        ends,
        FunctionConstraint(mixed, of="xu"),
        StateBounds([-1.5, -torch.inf, -1.2], [1.5, torch.inf, 1.3], knots=[1, 2, 4]),
        FunctionConstraint(lambda x, u: u[..., :1] * x[..., 2:] - 0.2 * u[..., 1:], "equality", knots=[1, 3], of="xu"),
        ends,
    ]
    dynamics = FunctionDynamics(field, 3, 2, 0.4, "rk4", values={"a": 1 + 0.5 * random(B, 2)})
    return Problem(dynamics, FunctionCost(stage, lambda x: 30 * x.pow(4).sum(-1)), constraints, 0.6 * random(B, 3), N)


def obstacles(seed: int) -> Problem:
    """Moving spheres, rotated boxes with and without radii, and some that are absent; a steep cost, which is scaled."""
    N, random = 6, draw(seed)

    def field(x: Tensor, u: Tensor) -> Tensor:
        v = x[..., 2:]
        return torch.cat((v, u - 0.4 * v * v.square().sum(-1, keepdim=True)), dim=-1)

    centers, radii = 0.9 * random(B, 3, 2) + torch.tensor([0.5, 0.0], dtype=D), 0.15 + 0.1 * random(B, 3).abs()
    centers[::2, 2], radii[::2, 2] = torch.nan, torch.nan
    corners, half, rounds = random(B, 2, 2), 0.1 + 0.1 * random(B, 2, 2).abs(), 0.05 * random(B, 2).abs()
    corners[1::3, 1], half[1::3, 1], rounds[1::3, 1] = torch.nan, torch.nan, torch.nan
    start = torch.cat((torch.tensor([-1.5, 0.0], dtype=D) + 0.1 * random(B, 2), 0.5 * random(B, 2)), dim=-1)
    return Problem(
        FunctionDynamics(field, 4, 2, 0.3, position=slice(0, 2)),
        QuadraticCost([300.0, 300, 1, 1], [1.0, 1], [900.0, 900, 5, 5], [1.5, 0.2, 0, 0]),
        [
            Spheres(centers, radii, 0.1, 0.2 * random(B, 3, 2)),
            ControlBounds(-2.0, 2.0),
            Boxes(corners, half, 0.1, random(B, 2), rounds),
        ],
        start,
        N,
    )


def rates(seed: int) -> Problem:
    """The controls of the stage before among the states."""
    problem = curved(seed)
    limits = RateBounds(-0.4, 0.5, previous=0.1 * draw(seed + 1)(B, 2))
    parts = [*problem.constraints[:3], limits]
    return with_carried(Problem(problem.dynamics, problem.cost, parts, problem.x0, problem.N))


def apart(seed: int) -> Problem:
    """Three points with drag in one state, two pairs of which keep a distance that differs between problems."""
    N, random = 5, draw(seed)

    def field(x: Tensor, u: Tensor) -> Tensor:
        return u - 0.3 * x * x.square().sum(-1, keepdim=True)

    aims = torch.tensor([1.5, 0.2, 0.0, -1.5, -0.2, 0.0], dtype=D)
    return Problem(
        FunctionDynamics(field, 6, 6, 0.3, position=slice(0, 2)),
        QuadraticCost([9.0] * 6, [5.0] * 6, [9.0] * 6, aims),
        [Separation([[0, 1], [3, 2], [5, 4]], 0.5 + 0.3 * random(B).abs(), [[0, 1], [2, 0]]), ControlBounds(-2.0, 2.0)],
        torch.tensor([-1.2, 0, 0, 1.2, 1.2, -1.2], dtype=D) + 0.1 * random(B, 6),
        N,
    )


def maps(seed: int) -> Problem:
    """Maps of their own, one of them empty, among which the rows bend from node to node."""
    plain, rng = obstacles(seed), np.random.default_rng(seed)
    cells = rng.random((B, 8, 8)) < 0.08
    cells[1] = False
    field = Field(OccupancyGrid(cells, plain.x0[:, :2].numpy() + np.array([0.1, -1.6]), 0.4), 0.15)
    return Problem(plain.dynamics, plain.cost, [field, plain.constraints[1]], plain.x0, plain.N)


def bodies(seed: int) -> Problem:
    """Discs of three sizes that turn with the velocity, among moving spheres, turned boxes and maps."""
    plain, rng, random = obstacles(seed), np.random.default_rng(seed), draw(seed + 1)

    def attitude(x: Tensor) -> Tensor:
        angle = 0.7 * x[..., 2] + x[..., 3].sin()
        cos, sin = angle.cos(), angle.sin()
        return torch.stack((torch.stack((cos, -sin), dim=-1), torch.stack((sin, cos), dim=-1)), dim=-2)

    body = Body([[-0.1, 0.02], [0.05, 0.0], [0.15, -0.05]], [0.08, 0.1, 0.06], attitude)
    centers, radii = 0.9 * random(B, 3, 2) + torch.tensor([0.5, 0.0], dtype=D), 0.15 + 0.1 * random(B, 3).abs()
    centers[::2, 2], radii[::2, 2] = torch.nan, torch.nan
    cells = rng.random((B, 8, 8)) < 0.08
    cells[1] = False
    parts = [
        Spheres(centers, radii, body, 0.2 * random(B, 3, 2)),
        Boxes(random(B, 2, 2), 0.1 + 0.1 * random(B, 2, 2).abs(), body, random(B, 2)),
        plain.constraints[1],
        Field(OccupancyGrid(cells, plain.x0[:, :2].numpy() + np.array([0.1, -1.6]), 0.4), body),
    ]
    return Problem(plain.dynamics, plain.cost, parts, plain.x0, plain.N)


def narrow(seed: int) -> Problem:
    """Bounds so close that a slack has less room than it is usually given."""
    problem = curved(seed)
    high = torch.tensor([0.02, 1.5], dtype=D) * (1 + 0.5 * draw(seed)(B, problem.N, 2).abs())
    slow = ControlBounds(-high, high)
    return Problem(problem.dynamics, problem.cost, [slow, *problem.constraints[1:]], problem.x0, problem.N)


def with_rows_without_room(seed: int) -> tuple[Problem, Problem]:
    """A problem with bounds that coincide and rows that nothing moves, and the same with equalities, without rows."""
    problem, value = curved(seed), 0.3 * draw(seed + 1)(B, 1, 1)
    low, high = (torch.full((B, problem.N, 2), bound, dtype=D) for bound in (-1.3, 1.2))
    others = [0, 1, 3, 4]
    plain = [ControlBounds(low[:, others], high[:, others], knots=others), *problem.constraints[1:]]
    low[:, 2:3, :], high[:, 2:3, :] = value, value
    both = lambda x, u, v: u - v
    equal = FunctionConstraint(both, "equality", of="xu", knots=[2], values={"v": value[:, 0].repeat(1, 2)})
    start = StateBounds(problem.x0.unsqueeze(1), problem.x0.unsqueeze(1) + 1.0, knots=[0])
    flat = FunctionConstraint(lambda x, u: torch.stack((0 * u[..., 0], 0 * x[..., 1] - 1e-3), dim=-1), of="xu")
    parts = [ControlBounds(low, high), *problem.constraints[1:], start, flat]
    of = lambda rows: Problem(problem.dynamics, problem.cost, rows, problem.x0, problem.N)
    return of(parts), of([*plain, equal])


MAKERS = {
    "curved": curved, "obstacles": obstacles, "bodies": bodies, "rates": rates, "apart": apart, "maps": maps,
    "narrow": narrow,
}  # fmt: skip


USUAL = ("obstacles",)  # the others are among the slow tests


def guess(problem: Problem, seed: int) -> tuple[Tensor, Tensor]:
    """States and controls that don't fit each other."""
    random = draw(seed)
    X = problem.x0.unsqueeze(1) + 0.3 * random(B, problem.N + 1, problem.n)
    X[:, 0] = problem.x0
    return X, 0.5 * random(B, problem.N, problem.m)


def multipliers(problem: Problem, X: Tensor, U: Tensor, seed: int | None) -> tuple[Tensor, ...]:
    """Random ones, above 0 for inequalities; zeros without a seed."""
    random = draw(seed or 0)
    found = []
    for part in problem.constraints:
        lam = random(*part.value(X, U).shape)
        lam = lam if part.sense == "equality" else 0.01 + lam.abs()
        found.append(0 * lam if seed is None else lam)
    return tuple(found)


def iterates(
    problem: Problem, X: Tensor, U: Tensor, lam: tuple[Tensor, ...], mu: float, count: int, warm: bool
) -> dict[str, Any]:
    """The state of all problems after `count` iterations."""
    X, U, lam, mus = X.clone(), U.clone(), tuple(part.clone() for part in lam), torch.full((B,), mu, dtype=D)
    out = interior_of(problem).solve(problem, X, U, lam, mus, UNSCALED, replace(PLAIN, warm=int(warm), max_iter=count))
    return {"X": X, "U": U, "lam": lam, "mu": mus, **out}


def split_by_sense(problem: Problem, lam: tuple[Tensor, ...], b: int) -> tuple[Array, Array]:
    """Multipliers of the inequalities and of the equalities of problem b."""
    parts = list(zip(problem.constraints, lam, strict=True))
    z, e = (
        torch.cat([torch.zeros(0, dtype=D), *(lam[b].flatten() for c, lam in parts if c.sense == sense)]).numpy()
        for sense in ("inequality", "equality")
    )
    return z, e


def length_of(step: Array, moved: Array, longest: float) -> float:
    """The length of the step that was made: the longest one, halved some times."""
    alpha = float(step @ moved / (step @ step))
    halvings = np.log2(longest / alpha)
    assert abs(halvings - round(halvings)) < 1e-4 and round(halvings) >= 0, (alpha, longest)
    return longest / 2 ** round(halvings)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("warm", mostly([False, True], True), ids=["cold", "warm"])
@pytest.mark.parametrize(
    "name", [name if name in USUAL else pytest.param(name, marks=pytest.mark.slow) for name in MAKERS]
)
@pytest.mark.parametrize("called", [False, True], ids=["compiled", "called"])
def test_steps_are_those_of_a_dense_system(name: str, warm: bool, called: bool) -> None:
    """Four iterations: states, controls, all multipliers, slacks, mu and the shift of indefinite curvature."""
    problem = MAKERS[name](3)
    X, U = guess(problem, 1)
    lam, mu = multipliers(problem, X, U, 5 if warm else None), 0.05 if warm else 0.1
    use_native(not called)
    try:
        found = [iterates(problem, X, U, lam, mu, count, warm) for count in (1, 2, 3, 4)]
    finally:
        use_native(True)
    lengths, shifts = [], []
    for b in LOOKED_AT:
        program = Program(problem.take(slice(b, b + 1)))
        first = split_by_sense(problem, lam, b) if warm else None
        point = begin(program, X[b : b + 1], U[b : b + 1], mu, PLAIN, first)
        for after in found:
            step = newton_step(program, point, PLAIN)
            w = torch.cat((after["X"][b, 1:].flatten(), after["U"][b].flatten())).numpy()
            alpha = length_of(step.w, w - point.w, step.primal)
            point = moved(program, point, step, alpha, PLAIN)
            assert_same(point, w, split_by_sense(problem, after["lam"], b), float(after["mu"][b]))
            lengths.append(alpha / step.primal)
            shifts.append(step.shift)
    assert np.mean(np.array(lengths) == 1) > 0.5 and 0 < np.mean(np.array(shifts) > 0) < 1


def assert_same(point: Point, w: Array, multipliers: tuple[Array, Array], mu: float) -> None:
    assert mu == pytest.approx(point.mu, rel=1e-9)
    np.testing.assert_allclose(w, point.w, rtol=1e-6, atol=1e-7)
    for mine, theirs in zip(multipliers, (point.z, point.e), strict=True):
        np.testing.assert_allclose(point.scale * mine, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.sampled(1)
def test_rows_without_room_take_the_steps_of_the_problem_without_them() -> None:
    """Bounds that coincide are equalities; a tight bound on the start and constant rows have no part in any step."""
    given, plain = with_rows_without_room(3)
    X, U = guess(plain, 1)
    U[:, 2] = given.constraints[0].by_knot[0][:, 2]
    for count in (1, 2, 3, 4):
        mine, theirs = (
            iterates(problem, X, U, multipliers(problem, X, U, None), 0.1, count, False) for problem in (given, plain)
        )
        for name in ("X", "U", "mu"):
            # Both step onto equalities by a dual regularisation of 1e-8, which divides the last bits.
            torch.testing.assert_close(mine[name], theirs[name], rtol=1e-8, atol=2e-9)
        upper, lower = mine["lam"][0][:, 2].split(2, dim=-1)
        torch.testing.assert_close(upper - lower, theirs["lam"][-1][:, 0], rtol=1e-7, atol=1e-9)
        assert not bool(mine["lam"][-1].any()) and not bool(mine["lam"][-2][..., 3:].any())
