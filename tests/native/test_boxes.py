"""Native rows of boxes against PyTorch's: outside, at the surface, inside, absent; and traced for CasADi's solvers."""

from __future__ import annotations

import pytest
import torch

from tests.engines import in_c
from tests.problems import boxed_batch, planar_batch, random_trajectory
from torchgco import Boxes, Capsules, ControlBounds, Goal, Problem, judge
from torchgco.baselines.casadi import CasADiSolver
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.obstacles.boxes import BoundBoxes


@pytest.mark.parametrize("pushed", ["half", "few", "none"])  # of the multipliers
@pytest.mark.parametrize(("phr", "rounded"), [(True, False), (False, False), (True, True)])
@pytest.mark.parametrize("d", [2, 3])
def test_values_and_expansions_are_pytorchs(d: int, phr: bool, rounded: bool, pushed: str) -> None:
    problem, _ = boxed_batch(d, B=5, N=40, boxes=11, rounded=rounded)
    X, U = random_trajectory(problem, spread=0.5)
    (boxes,) = (c for c in problem.constraints if isinstance(c, BoundBoxes))
    generator = torch.Generator().manual_seed(6)
    # Knots within boxes, at their centres and on their surfaces; off the axes of rounded ones, where rounding decides
    # in which direction the distance grows.
    off = 0.013 if rounded else 0.0
    for i in range(6):
        for j, share in enumerate((0.0, 0.5, 0.9, 1.0, 1.2)):
            turn = torch.randint(0, d, (1,), generator=generator)
            local = share * boxes.half_sizes[:, i] * torch.nn.functional.one_hot(turn, d) + off
            at = boxes.centers[:, i] + (boxes.axes[:, i] * local.unsqueeze(-1)).sum(-2)
            X[:, 1 + 5 * i + j, problem.dynamics.position] = at
    assert float(boxes.violation(X, U).amax()) > 0.05
    multipliers = Multipliers.zero(problem, 3.0)
    least = {"half": 0.5, "few": 0.99, "none": 1.0}[pushed]
    lam = [torch.rand(t.shape, generator=generator, dtype=t.dtype).clamp(min=least) - least for t in multipliers.lam]
    (rows,) = (r for r, c in zip(lam, problem.constraints, strict=True) if c is boxes)
    assert bool(rows.any()) == (pushed != "none") and bool((rows == 0).any())
    lagrangian = Lagrangian(problem, Multipliers(tuple(lam), multipliers.mu), None, phr)
    kernels = in_c(problem)
    assert kernels is not None and not kernels.engine.functions  # nothing is traced
    cost, merit = kernels.value(lagrangian, X, U)
    torch.testing.assert_close((cost, merit), lagrangian.value(X, U), rtol=1e-10, atol=1e-10)
    slopes, H = kernels.expand(problem, X, U, lagrangian)
    want, n, s = lagrangian.expand(X, U).transpose(0, 1), problem.n, problem.n + problem.m
    kept = [i for i in range(s + 1) if i != n]
    torch.testing.assert_close(slopes[:, :-1], want[:, :-1, kept, n], rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(slopes[:, -1, :n], want[:, -1, :n, n], rtol=1e-10, atol=1e-9)
    upper = torch.triu(torch.ones(s, s, dtype=torch.bool))
    torch.testing.assert_close(H[..., upper], want[:, :, kept][..., kept][..., upper], rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_slopes_on_the_axis_of_a_post_are_pytorchs(d: int) -> None:
    plain, _ = boxed_batch(d, B=1, N=4)
    along = 0.5 * torch.eye(d, dtype=torch.float64)[-1:] if d == 3 else torch.tensor([[0.5, 0.0]]).double()
    middle = plain.x0[:, plain.dynamics.position]
    post = Capsules(middle - along, middle + along, [0.25], 0.06)
    problem = Problem(plain.dynamics, plain.cost, [post], plain.x0, 4)
    X, U = random_trajectory(problem, spread=0.0)
    X[0, 1:, problem.position] += torch.tensor([[0.0], [0.5], [1.0], [1.5]]).double() * along  # the last: beyond an end
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 3.0), None, True)
    kernels = in_c(problem)
    assert kernels is not None and bool((problem.constraints[0].value(X, U)[:, :3] > 0).all())
    slopes, _ = kernels.expand(problem, X, U, lagrangian)
    want, n = lagrangian.expand(X, U).transpose(0, 1), problem.n
    torch.testing.assert_close(slopes[:, -1, :n], want[:, -1, :n, n], rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(slopes[:, :-1, :n], want[:, :-1, :n, n], rtol=1e-10, atol=1e-9)


WALLS = {
    "box": Boxes([[0.1, 0.0]], [[0.1, 0.3]], 0.06, [0.2]),
    "capsule": Capsules([[0.1, -0.3]], [[0.05, 0.3]], [0.1], 0.06),
}


@pytest.mark.parametrize("wall", WALLS)
def test_casadi_solves_among_boxes(wall: str) -> None:
    plain, U0 = planar_batch(B=1, N=40)
    parts = [WALLS[wall], ControlBounds([-10, -10], [10, 10])]
    problem = Problem(plain.dynamics, plain.cost, parts, plain.x0, 40, Goal([1.0, 0.4], 0.5))
    solution = CasADiSolver("ipopt").prepare(problem).solve(problem, U0)
    verdict = judge(problem, solution.U)
    assert bool(verdict.feasible.all()) and float(verdict.violation) <= 1e-6
