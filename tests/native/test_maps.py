"""Native rows of maps against PyTorch's: near, inside, far, beyond the map; batches, and each local solver."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.engines import in_c
from tests.maps.test_field import random_grid
from tests.native.lanes import drawn
from tests.problems import assert_same_bits, planar_batch, quadrotor_batch, random_trajectory
from torchgco import MPPI, ControlBounds, Field, Goal, Planar, Problem, QuadraticCost, Solution, judge, kernels, presets
from torchgco.base.draws import DrawKey
from torchgco.eager import sampling
from torchgco.guidance import mppi
from torchgco.kernels import chord_clearance, kernels_of, measured, open_loop, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.maps import DistanceField, OccupancyGrid
from torchgco.maps.field import BoundField


@pytest.fixture(autouse=True)
def cache() -> None:
    """Use the user's cache folder: libraries are compiled once for all tests of this file."""


def mapped_batch(d: int, interpolation: str, B: int = 5, N: int = 30) -> Problem:
    """Vehicles among spheres and in maps of their own, whose radii differ; the last map is empty."""
    plain, _ = planar_batch(B, N, 3) if d == 2 else quadrotor_batch(B, N, 3)
    cells = np.stack([random_grid(d, seed).occupied for seed in range(B)])
    cells[-1] = False
    origins = plain.x0[:, plain.dynamics.position].numpy() - 0.5
    field = DistanceField.of(OccupancyGrid(cells, origins, 0.2), refine=2 if d == 2 else 1)
    radii = torch.linspace(0.0, 0.3, B, dtype=torch.float64)
    parts = [*plain.constraints, Field(field, radii, interpolation)]
    return Problem(plain.dynamics, plain.cost, parts, plain.x0, N)


@pytest.mark.parametrize("mapped", [False, True])
def test_copies_of_one_problem_are_measured_as_it_is(mapped: bool) -> None:
    whole = mapped_batch(2, "linear", B=4) if mapped else planar_batch(4, 30, 3)[0]
    one = whole.take([2])
    X, U = random_trajectory(whole, spread=0.8)
    copies = one.take([0, 0, 0, 0])
    found = measured(copies, X, U)
    assert torch.equal(found, torch.cat([measured(one, X[b : b + 1], U[b : b + 1]) for b in range(4)]))
    assert bool(found.any()) or not mapped
    lagrangian = Lagrangian(copies, Multipliers.zero(copies, 3.0), None, True)
    torch.testing.assert_close(value(lagrangian, X, U), lagrangian.value(X, U), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("mapped", [False, True])
def test_problems_of_a_batch_are_computed_from_its_numbers_as_from_their_own(mapped: bool) -> None:
    whole = mapped_batch(2, "linear", B=5) if mapped else planar_batch(5, 30, 3)[0]
    part, X = whole.take([3, 1, 1, 4]).take([3, 0, 1]), random_trajectory(whole, spread=0.8)[0][:3]
    own, U = part.renewed(), 0.3 * torch.ones(3, whole.N, whole.m, dtype=torch.float64)
    assert part.part_of is not None and part.part_of[0] is whole and own.part_of is None
    assert part.part_of[1].tolist() == [4, 3, 1] and torch.equal(part.x0, whole.x0[[4, 3, 1]])
    for find in (open_loop, lambda p, U: chord_clearance(p, X), lambda p, U: measured(p, X, U)):
        assert torch.equal(find(part, U), find(own, U))
    lam = Multipliers(tuple(torch.rand(3, *shape, dtype=torch.float64) for shape in whole.row_shapes), U[:, 0, 0])
    found = [kernels_of(p).judged(Lagrangian(p, lam, None, True), X, U) for p in (part, own)]
    for a, b in zip(*((one.worst, one.slack, one.step.gains) for one in found), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("interpolation", ["smooth", "linear"])
@pytest.mark.parametrize("d", [2, 3])
def test_values_expansions_and_violations_are_pytorchs(d: int, interpolation: str) -> None:
    problem = mapped_batch(d, interpolation)
    X, U = random_trajectory(problem, spread=0.8)
    (field,) = (c for c in problem.constraints if isinstance(c, BoundField))
    X[:, 3, problem.dynamics.position] = field.origins - 7.0
    assert float(field.violation(X, U)[:-1].amax()) > 0.1 and not bool(field.violation(X, U)[-1].any())
    generator = torch.Generator().manual_seed(6)
    kernels = in_c(problem)
    assert kernels is not None and not kernels.engine.functions  # nothing is traced
    for least in (0.5, 1.0):  # half of the multipliers aren't zero; all are
        zero = Multipliers.zero(problem, 3.0)
        lam = [torch.rand(t.shape, generator=generator, dtype=t.dtype).clamp(min=least) - least for t in zero.lam]
        lagrangian = Lagrangian(problem, Multipliers(tuple(lam), zero.mu), None, True)
        torch.testing.assert_close(kernels.value(lagrangian, X, U), lagrangian.value(X, U), rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(
            kernels.judged(lagrangian, X, U).slack, lagrangian.slack(X, U), rtol=1e-10, atol=1e-10
        )
        slopes, H = kernels.expand(problem, X, U, lagrangian)
        want, n, s = lagrangian.expand(X, U).transpose(0, 1), problem.n, problem.n + problem.m
        kept = [i for i in range(s + 1) if i != n]
        torch.testing.assert_close(slopes[:, :-1], want[:, :-1, kept, n], rtol=1e-10, atol=1e-9)
        upper = torch.triu(torch.ones(s, s, dtype=torch.bool))
        torch.testing.assert_close(H[..., upper], want[:, :, kept][..., kept][..., upper], rtol=1e-10, atol=1e-9)
    worst = violation([field], X, U)
    alone = problem._with({"constraints": (field,)})
    torch.testing.assert_close(measured(alone, X, U), worst, rtol=1e-10, atol=1e-12)


def rooms(B: int = 5, interpolation: str = "smooth") -> Problem:
    """A wall with an opening, in a map that all problems share."""
    cells = np.zeros((30, 20), bool)
    cells[14:16, :12] = True
    field = DistanceField.of(OccupancyGrid(cells, [-1.5, -1.0], 0.1))
    x0 = torch.zeros(B, 6, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.0, torch.linspace(-0.2, 0.5, B)
    cost = QuadraticCost([5.0, 5, 0, 1, 1, 0], [0.1, 0.1], [50.0, 50, 0, 1, 1, 0], [1.0, 0.3, 0, 0, 0, 0])
    parts = [Field(field, 0.1, interpolation), ControlBounds([-10, -10], [10, 10])]
    return Problem(Planar(dt=0.05), cost, parts, x0, 60, Goal([1.0, 0.3], 0.1))


def solved(problem: Problem, name: str, ids: Tensor) -> Solution:
    rest = torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)
    return presets.named(name, problem).solve(problem, rest, ids=ids)


@pytest.mark.parametrize("name", ["al_ilqr", "interior_point"])
def test_both_local_solvers_keep_clear_of_the_cells_with_the_same_bits_in_any_batch(name: str) -> None:
    problem = rooms()
    rows = torch.tensor([3, 1, 4])
    whole = solved(problem, name, torch.arange(5))
    some = solved(problem.take(rows), name, rows)
    assert_same_bits(some, whole.take(rows))
    good = judge(problem, whole.U)
    done = good.violation <= 1e-4
    assert bool(done[-1]) and bool((good.clearance_knots >= 0)[done].all())


def test_a_map_for_all_and_the_same_map_for_each_give_the_same_bits() -> None:
    problem = rooms(3)
    shared = problem.constraints[0]
    assert isinstance(shared, BoundField)
    grid = shared.field.source
    each = OccupancyGrid(np.stack([grid.occupied] * 3), grid.origin, grid.resolution)
    own = Problem(
        problem.dynamics, problem.cost, [Field(each, 0.1), problem.constraints[1]], problem.x0, 60, problem.goal
    )
    ids = torch.arange(3)
    assert_same_bits(solved(own, "al_ilqr", ids), solved(problem, "al_ilqr", ids))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_samples_that_touch_the_map_are_counted_as_pytorch_counts_them(dtype: str, monkeypatch) -> None:
    problem = mapped_batch(2, "smooth", B=3, N=20)
    U = torch.zeros(3, 20, 2, dtype=torch.float64)

    def same_noise(key: DrawKey, rows: int, samples: range, dtype: torch.dtype, stream: int) -> Tensor:
        return drawn(key, rows, samples.stop, stream)[..., samples.start :].to(dtype)

    monkeypatch.setattr(sampling, "standard_normal", same_noise)
    monkeypatch.setattr(mppi, "COLLISION_PENALTY", 10.0)
    sampler = MPPI(
        samples=33,
        covariance=None,
        spread=0.1,
        temperature=20.0,
        rounds=3,
        noise_knots=5,
        decay=0.8,
        elite=4,
        dtype=dtype,
    )
    key = DrawKey(7, torch.arange(3), torch.arange(3))
    _, V = sampler.improve(problem, U, key)
    kernels.use_native(False)
    _, want = sampler.improve(problem, U, key)
    torch.testing.assert_close(V, want, rtol=1e-7, atol=1e-7 if dtype == "float64" else 1e-3)
    kernels.use_native(True)
    _, without = sampler.improve(problem._with({"constraints": problem.constraints[:-1]}), U, key)
    assert not torch.allclose(V, without, atol=1e-2)
