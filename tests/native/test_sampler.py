"""Rounds of MPPI in C against those in PyTorch with the same noise, with every kind of part of a problem."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from tests.native import users
from tests.native.lanes import drawn
from tests.native.test_engine import user_problem
from tests.problems import boxed_batch, planar_batch, quadrotor_batch
from torchgco import MPPI, Body, Boxes, ControlBounds, Problem, Spheres, kernels, presets
from torchgco.base.draws import DrawKey, standard_normal
from torchgco.eager import sampling
from torchgco.guidance import mppi
from torchgco.kernels import in_c
from torchgco.native.compiler import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def native_again() -> Iterator[None]:
    yield
    kernels.use_native(True)


def moving() -> tuple[Problem, Tensor]:
    problem, U = quadrotor_batch(B=3, N=20)
    centers = problem.constraints[0].centers
    spheres = Spheres(
        centers, problem.constraints[0].inflated_radii - 0.3, 0.3, velocities=0.3 * torch.ones_like(centers)
    )
    return Problem(problem.dynamics, problem.cost, [spheres, *problem.constraints[1:]], problem.x0, problem.N), U


def a_body() -> tuple[Problem, Tensor]:
    problem, U = planar_batch(B=3, N=20)
    body = Body([[-0.1, 0.0], [0.1, 0.02]], [0.06, 0.05])
    spheres = Spheres([[-0.7, 0.05], [-0.3, 0.2]], [0.1, 0.1], body)
    boxes = Boxes([[-0.5, -0.2]], [[0.1, 0.05]], body)
    return Problem(problem.dynamics, problem.cost, [spheres, boxes, problem.constraints[1]], problem.x0, 20), U


def given_as_functions() -> tuple[Problem, Tensor]:
    problem = user_problem(B=3)
    return problem, torch.zeros(3, problem.N, problem.m, dtype=torch.float64)


def users_own(name: str) -> tuple[Problem, Tensor]:
    problem = users.PROBLEMS[name]().in_cost_units()
    return problem.take(slice(0, 3)), torch.zeros(3, problem.N, problem.m, dtype=torch.float64)


def bounds_by_knot() -> tuple[Problem, Tensor]:
    problem, U = planar_batch(B=3, N=20)
    fading = torch.linspace(3.0, 0.5, 20).double().view(1, 20, 1) * torch.tensor([1.0, 1.5, 2.0]).double().view(3, 1, 1)
    late = ControlBounds([[[-0.5, -torch.inf]]], 0.25 * fading[:, 12:].expand(-1, -1, 2), knots=slice(12, 20))
    bounds = ControlBounds(-fading.expand(-1, -1, 2), 2.5)
    return Problem(problem.dynamics, problem.cost, [bounds, late, problem.constraints[0]], problem.x0, 20), U


def bounds_of_some_knots() -> tuple[Problem, Tensor]:
    problem, U = bounds_by_knot()
    return Problem(problem.dynamics, problem.cost, [problem.constraints[1]], problem.x0, 20), U


PROBLEMS = {
    "planar": partial(planar_batch, B=3, N=20),
    "quadrotor": partial(quadrotor_batch, B=3, N=20),
    "moving": moving,
    "boxes": partial(boxed_batch, 2, B=3, N=20),
    "boxes in space": partial(boxed_batch, 3, B=3, N=20),
    "functions": given_as_functions,
    "a user's cost": partial(users_own, "by knot"),
    "dynamics by stage": partial(users_own, "dynamics by stage"),
    "bounds by knot": bounds_by_knot,
    "bounds of some knots": bounds_of_some_knots,
    "a body": a_body,
}
SAMPLERS = {
    "as printed": MPPI(samples=30, covariance=0.5, temperature=50.0),
    "wider than the bounds": MPPI(samples=9, covariance=4.0, temperature=50.0, saturation="symmetric"),
    "free": MPPI(samples=8, covariance=0.1, temperature=50.0, saturation=None, dwell_cost=0.7),
    "rounds of smooth noise": MPPI(samples=33, covariance=None, spread=0.1, temperature=20.0, rounds=3, noise_knots=5,
                                   decay=0.8, elite=4),
    "one sample": MPPI(samples=1, covariance=0.5),
}  # fmt: skip
LENIENT = {
    "as printed": 50.0,
    "rounds of smooth noise": 10.0,
}  # collision penalties small enough for the costs of samples to matter


def sampler_of(name: str, monkeypatch: pytest.MonkeyPatch) -> MPPI:
    """A sampler; sets its collision penalty."""
    monkeypatch.setattr(mppi, "COLLISION_PENALTY", LENIENT.get(name, mppi.COLLISION_PENALTY))
    return SAMPLERS[name]


def key(B: int) -> DrawKey:
    return DrawKey(7, 3 + 5 * torch.arange(B), torch.arange(B))


def test_the_noise_is_that_of_pytorch() -> None:
    made, want = drawn(key(3), 33, 1000), standard_normal(key(3), 33, range(1000), torch.float64)
    torch.testing.assert_close(made, want, rtol=2e-6, atol=2e-6)
    assert abs(float(made.mean())) < 0.02 and abs(float(made.var()) - 1.0) < 0.02


@pytest.mark.sampled(7)
@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("made", PROBLEMS)
def test_rounds_equal_those_of_pytorch(made: str, sampler: str, monkeypatch) -> None:
    problem, U = PROBLEMS[made]()

    def same_noise(key: DrawKey, rows: int, samples: range, dtype: torch.dtype, stream: int) -> Tensor:
        return drawn(key, rows, samples.stop, stream)[..., samples.start :].to(dtype)

    monkeypatch.setattr(sampling, "standard_normal", same_noise)
    drawing = sampler_of(sampler, monkeypatch)
    X, V = drawing.improve(problem, U, key(3))
    kernels.use_native(False)
    want_X, want_V = drawing.improve(problem, U, key(3))
    # Rounding grows from round to round, by a sample's change of score divided by the temperature.
    torch.testing.assert_close(V, want_V, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(X, want_X, rtol=1e-7, atol=1e-7)
    little = ("functions", "a user's cost", "dynamics by stage")
    assert made in little or sampler == "one sample" or not torch.equal(V, U)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("made", ["planar", "quadrotor"])
def test_problems_do_not_affect_each_other(made: str, dtype: str, monkeypatch) -> None:
    problem, U = PROBLEMS[made]()
    sampler = replace(sampler_of("rounds of smooth noise", monkeypatch), dtype=dtype)
    _, V = sampler.improve(problem, U, key(3))
    for rows in ([1], [2, 0], [0, 0, 2, 1]):
        index = torch.tensor(rows)
        assert torch.equal(sampler.improve(problem.take(index), U[index], key(3).take(index))[1], V[index])
    bad = U.clone()
    bad[1, 0] = torch.nan
    _, W = sampler.improve(problem, bad, key(3))
    assert torch.equal(W[[0, 2]], V[[0, 2]])


@pytest.mark.parametrize("made", ["planar", "quadrotor"])
def test_single_precision_follows_double(made: str, monkeypatch) -> None:
    problem, U = PROBLEMS[made]()
    printed = sampler_of("as printed", monkeypatch)
    single, double = (
        replace(printed, temperature=1e3, dtype=dtype).improve(problem, U, key(3))[1]
        for dtype in ("float32", "float64")
    )
    torch.testing.assert_close(single, double, rtol=1e-2, atol=1e-2)


def test_a_sample_that_overflows_affects_no_other() -> None:
    problem, U = PROBLEMS["planar"]()
    wild = MPPI(samples=64, covariance=1e300, saturation=None, temperature=1.0)
    _, V = wild.improve(problem, U, key(3))
    assert torch.isfinite(V).all()


def test_a_solve_that_never_samples_compiles_no_sampler(monkeypatch) -> None:
    problem, U = planar_batch(B=1, N=20)
    free = Problem(problem.dynamics, problem.cost, [Spheres([[50.0, 50.0]], [0.1], 0.1)], problem.x0, problem.N)
    made = []
    monkeypatch.setattr(in_c, "Sampler", lambda *words: made.append(words))
    presets.gco(free).solve(free, U)
    assert not made
