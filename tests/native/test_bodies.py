"""Native rows of bodies against PyTorch's: values, expansions, violations, solves and their batches."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.engines import compiled, in_c
from tests.obstacles.test_body import kinds
from tests.problems import assert_same_bits, planar_batch, quadrotor_batch, random_trajectory
from torchgco import AugmentedLagrangian, Body, InteriorPoint, Problem, kernels
from torchgco.kernels import measured
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers

pytestmark = compiled

ROD = Body([[-0.1, 0.0], [0.0, 0.02], [0.12, 0.0]], [0.06, 0.08, 0.05])
FRAME = Body([[0.2, 0.0, 0.0], [-0.1, 0.2, 0.05]], [0.1, 0.15], "quaternion")


def among(d: int, names: tuple[str, ...], N: int = 12) -> Problem:
    """Problems among obstacles of these kinds, near their starts."""
    plain, _ = planar_batch(3, N) if d == 2 else quadrotor_batch(3, N)
    make, body = kinds(d), ROD if d == 2 else FRAME
    parts = [*(make[name](body) for name in names), plain.constraints[1]]
    return Problem(plain.dynamics, plain.cost, parts, plain.x0, N)


@pytest.mark.parametrize(
    ("d", "names"),
    [
        (2, ("moving", "boxes", "map")),
        (3, ("spheres", "boxes")),
        pytest.param(2, ("oscillating",), marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("phr", [True, False])
def test_values_and_expansions_are_pytorchs(d: int, names: tuple[str, ...], phr: bool) -> None:
    problem = among(d, names)
    X, U = random_trajectory(problem, spread=0.4)
    generator = torch.Generator().manual_seed(6)
    multipliers = Multipliers.zero(problem, 3.0)
    lam = [(torch.rand(t.shape, generator=generator, dtype=t.dtype) - 0.5).clamp(min=0.0) for t in multipliers.lam]
    for part in lam:
        part[:, ::2] = 0.0  # where C leaves out what is far from all balls
    lagrangian = Lagrangian(problem, Multipliers(tuple(lam), multipliers.mu), None, phr)
    kernels = in_c(problem)
    assert kernels is not None
    torch.testing.assert_close(kernels.value(lagrangian, X, U), lagrangian.value(X, U), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(kernels.judged(lagrangian, X, U).slack, lagrangian.slack(X, U), rtol=1e-10, atol=1e-10)
    slopes, H = kernels.expand(problem, X, U, lagrangian)
    want, n, s = lagrangian.expand(X, U).transpose(0, 1), problem.n, problem.n + problem.m
    kept = [i for i in range(s + 1) if i != n]
    torch.testing.assert_close(slopes[:, :-1], want[:, :-1, kept, n], rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(slopes[:, -1, :n], want[:, -1, :n, n], rtol=1e-10, atol=1e-9)
    upper = torch.triu(torch.ones(s, s, dtype=torch.bool))
    torch.testing.assert_close(H[..., upper], want[:, :, kept][..., kept][..., upper], rtol=1e-10, atol=1e-9)
    deepest = torch.stack([part.violation(X, U).flatten(1).amax(-1) for part in problem.obstacles]).amax(0)
    assert bool((deepest > 0.02).all())
    torch.testing.assert_close(measured(problem, X, U, obstacles=True), deepest, rtol=1e-9, atol=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "solver", [AugmentedLagrangian(max_outer_iterations=6), InteriorPoint(max_iterations=30)], ids=["al", "ip"]
)
def test_solves_of_a_batch_and_of_its_parts(solver: Any) -> None:
    """The same bits alone, and nearly those of PyTorch's kernels."""
    plain, U = planar_batch(3, 20)
    make = kinds(2, seed=5)
    problem = Problem(
        plain.dynamics, plain.cost, [make["boxes"](ROD), make["moving"](ROD), plain.constraints[1]], plain.x0, 20
    )
    whole = solver.solve(problem, U)
    rows = torch.tensor([2, 0])
    assert_same_bits(whole.take(rows), solver.solve(problem.take(rows), U[rows], ids=rows))
    kernels.use_native(False)
    try:
        slow = solver.solve(problem.renewed(), U)
    finally:
        kernels.use_native(True)
    torch.testing.assert_close(slow.cost, whole.cost, rtol=1e-5, atol=1e-6)
    assert torch.equal(slow.status, whole.status)
