"""Linear programmes over a horizon: the interior point finds what HiGHS does, in iterations that hardly grow with N."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from scipy.optimize import linprog

from tests.slow import mostly
from torchgco import ControlBounds, FunctionConstraint, FunctionCost, FunctionDynamics, Problem, StateBounds, Status
from torchgco.kernels import use_native
from torchgco.solvers.interior import InteriorPoint

TINY = 1e-9  # weight of the squares of controls, which changes no figure that is compared
GRID = 60.0  # most that is bought and sold at once, net


def store(N: int, seeds: range, grid: bool = False, weight: float = 0.0) -> tuple[Problem, torch.Tensor]:
    """Stores of any size that buy and sell at hourly prices, and their prices (B, N)."""
    draws = [np.random.default_rng(seed) for seed in seeds]
    hours = np.arange(N)
    shape = lambda draw: 40 + 20 * np.sin(2 * np.pi * (hours - draw.integers(24)) / 24) + 8 * draw.standard_normal(N)
    prices = torch.tensor(np.stack([shape(draw) for draw in draws])) / 1000.0
    size, buy, sell = torch.tensor([[draw.uniform(50, 400), *draw.uniform(20, 60, 2)] for draw in draws]).T.double()

    def stage(x: torch.Tensor, u: torch.Tensor, price: torch.Tensor) -> torch.Tensor:
        return price * (u[..., 0] - u[..., 1]) + weight * u.square().sum(-1)

    cost = FunctionCost(stage, knot_values={"price": torch.nn.functional.pad(prices, (0, 1))})
    model = FunctionDynamics(lambda x, u: x + 0.85 * u[..., :1] - u[..., 1:], n=1, m=2, dt=1.0, integrator="none")
    most = torch.stack((buy, sell), dim=-1)
    rows = [StateBounds(torch.zeros_like(size).unsqueeze(-1), size.unsqueeze(-1)), ControlBounds(0.0 * most, most)]
    if grid:
        net = lambda u: torch.cat((u[..., :1] - u[..., 1:], u[..., 1:] - u[..., :1]), dim=-1) - 0.5 * GRID
        rows.append(FunctionConstraint(net, of="u"))
    x0 = torch.zeros(len(draws), 1, dtype=torch.float64)
    return Problem(model, cost, rows, x0, N), torch.cat((size.unsqueeze(-1), most, prices), dim=-1)


def best_of(numbers: torch.Tensor, N: int, grid: bool) -> float:
    """The optimum of one programme by HiGHS, in the variables x_1..x_N, what is bought, and what is sold."""
    size, buy, sell, *prices = numbers.tolist()
    eye, price = sp.eye(N), np.array(prices)
    steps = sp.hstack([sp.diags([np.ones(N), -np.ones(N - 1)], [0, -1]), -0.85 * eye, eye]).tocsr()
    net = sp.hstack([0 * eye, eye, -eye])
    limits = {"A_ub": sp.vstack([net, -net]).tocsr(), "b_ub": np.full(2 * N, 0.5 * GRID)} if grid else {}
    bounds = [(0, size)] * N + [(0, buy)] * N + [(0, sell)] * N
    return linprog(np.r_[0 * price, price, -price], A_eq=steps, b_eq=np.zeros(N), bounds=bounds, **limits).fun


@pytest.mark.sampled(1)
@pytest.mark.parametrize("grid", mostly([False, True], False))
@pytest.mark.parametrize(("N", "most", "weight"), [(24, 40, 0.0), (480, 70, TINY)])
def test_drawn_programmes(N: int, most: int, weight: float, grid: bool) -> None:
    """64 in all. From multipliers of the central path they take several hundred iterations at N = 480."""
    problem, numbers = store(N, range(16), grid, weight)
    found = InteriorPoint().solve(problem, problem.x0.new_zeros(16, N, 2))
    assert found.statuses == [Status.CONVERGED] * 16
    due = torch.tensor([best_of(row, N, grid) for row in numbers])
    torch.testing.assert_close(found.cost, due.double(), rtol=1e-4, atol=1e-5)
    assert int(found.iterations.max()) <= most


def test_iterations_hardly_grow_with_the_horizon() -> None:
    most = []
    for N in (48, 384, 3072):
        problem, _ = store(N, range(2))
        most.append(int(InteriorPoint().solve(problem, problem.x0.new_zeros(2, N, 2)).iterations.max()))
    assert most[2] <= 2 * most[0]


def test_in_pytorch_alike() -> None:
    """As many iterations as in C, but for rounding."""
    counts = {}
    for in_c in (True, False):
        use_native(in_c)
        try:
            for weight in (0.0, TINY):
                problem, _ = store(24, range(3), weight=weight)
                found = InteriorPoint().solve(problem, problem.x0.new_zeros(3, 24, 2))
                assert found.statuses == [Status.CONVERGED] * 3
                counts.setdefault(weight, []).append(found.iterations)
        finally:
            use_native(True)
    for first, second in counts.values():
        assert bool(((first - second).abs() <= 1).all())


def drawn_programme(seed: int, n: int = 2, m: int = 2, p: int = 2, N: int = 12) -> tuple[Problem, int]:
    """One with mixed rows and controls that half the time have no bound, and HiGHS's status: 0 optimal, 3 unbounded."""
    draw = np.random.default_rng(seed)
    A, B, x0 = np.eye(n) + 0.3 * draw.normal(size=(n, n)), draw.normal(size=(n, m)), draw.normal(size=n)
    by_x, by_u, at_end = draw.normal(size=n), draw.normal(size=m), draw.normal(size=n)
    G, H = draw.normal(size=(p, n)), draw.normal(size=(p, m))
    h = 1.0 + draw.random(p) + np.abs(G) @ np.abs(x0)
    bounded = draw.random((2, m)) < 0.6
    bounded[0, 0] = True
    ends = np.where(bounded, [[-1.0], [1.0]] * np.ones(m), [[-np.inf], [np.inf]])

    # In the variables x_1..x_N, u_0..u_N-1.
    steps = np.c_[np.eye(N * n) - np.kron(np.eye(N, k=-1), A), -np.kron(np.eye(N), B)]
    rows = np.c_[np.kron(np.eye(N, k=-1), G), np.kron(np.eye(N), H)]
    first = np.r_[A @ x0, np.zeros((N - 1) * n)], np.tile(h, N) - np.r_[G @ x0, np.zeros((N - 1) * p)]
    cost = np.r_[np.tile(by_x, N - 1), at_end, np.tile(by_u, N)]
    bounds = [(None, None)] * (N * n) + list(zip(*np.tile(ends, N), strict=True))
    status = linprog(cost, rows, first[1], steps, first[0], bounds, method="highs").status

    A, B, G, H, h, by_x, by_u, at_end = map(torch.tensor, (A, B, G, H, h, by_x, by_u, at_end))
    model = FunctionDynamics(lambda x, u: x @ A.T + u @ B.T, n, m, dt=1.0, integrator="none")
    value = FunctionCost(lambda x, u: (x * by_x).sum(-1) + (u * by_u).sum(-1), lambda x: (x * at_end).sum(-1))
    row = FunctionConstraint(lambda x, u: x @ G.T + u @ H.T - h, of="xu")
    return Problem(model, value, [row, ControlBounds(*torch.tensor(ends))], torch.tensor(x0)[None], N), status


@pytest.mark.slow
@pytest.mark.parametrize("seeds", mostly([range(20), range(20, 80)], range(20)), ids=str)
def test_programmes_without_an_end(seeds: range) -> None:
    """What HiGHS calls unbounded is never said to be feasible, and most is told; what has an optimum isn't."""
    told = []
    for seed in seeds:
        problem, status = drawn_programme(seed)
        found = InteriorPoint().solve(problem, problem.x0.new_zeros(1, problem.N, problem.m)).statuses[0]
        if status == 3:
            assert found not in (Status.CONVERGED, Status.FEASIBLE), seed
            told.append(found == Status.UNBOUNDED)
        else:
            assert found != Status.UNBOUNDED, seed
    assert len(told) >= 5 and sum(told) >= 0.7 * len(told), told
