"""Required attitudes that q and -q meet alike."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InputError,
    Problem,
    Status,
    certify,
    judge,
)
from torchgco.problem.goal import GoalState

D, NAN = torch.float64, math.nan
QUATERNION = range(3, 7)
REST = [0.0, 0.0, 0.0]


def times(p: Tensor, q: Tensor) -> Tensor:
    """The product of two quaternions (..., 4), scalar first."""
    (a, b, c, d), (w, x, y, z) = p.unbind(-1), q.unbind(-1)
    parts = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return torch.stack(parts, -1)


def spun(x: Tensor, u: Tensor) -> Tensor:
    """Of x = [body rates (3), quaternion (4)] with accelerations u."""
    rates = torch.nn.functional.pad(x[..., :3], (1, 0))
    return torch.cat((u, 0.5 * times(x[..., 3:], rates)), -1)


def turned(axis: list[float], angle: float) -> Tensor:
    half = torch.tensor(angle / 2, dtype=D)
    return torch.cat((half.cos().view(1), half.sin() * torch.tensor(axis, dtype=D) / math.hypot(*axis)))


def satellites(goals: Tensor, quaternion: Any = QUATERNION, rest: Any = REST, **more: Any) -> Problem:
    """Satellites that turn from the same attitude into those of `goals` (B, 4), at rest."""
    model = FunctionDynamics(spun, n=7, m=3, dt=0.1, integrator="rk4")
    state = torch.cat((torch.tensor(rest, dtype=D).expand(len(goals), 3), goals), -1)
    goal = Goal(state=state, required=True, quaternion=quaternion)
    x0 = torch.tensor([0, 0, 0, 1.0, 0, 0, 0], dtype=D).expand(len(goals), 7).contiguous()
    return Problem(model, FunctionCost(lambda x, u: u.square().sum(-1)), [ControlBounds(-9, 9)], x0, 30, goal, **more)


G = turned([1.0, 2.0, -1.0], 1.9)
BOTH = torch.stack((G, -G, 3.0 * turned([0.0, 0.0, 1.0], -2.8)))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr"])
def test_both_signs_are_the_same_goal(solver: str) -> None:
    problem = satellites(BOTH)
    solution = torchgco.solve(problem, solver=solver)
    assert all(status in (Status.CONVERGED, Status.FEASIBLE) for status in solution.statuses)
    assert float(solution.cost[1]) == pytest.approx(float(solution.cost[0]), rel=1e-3)
    end = solution.X[:, -1, 3:]
    left = times(BOTH / BOTH.norm(dim=-1, keepdim=True) * torch.tensor([1.0, -1, -1, -1], dtype=D), end)
    assert bool((left[:, 1:].abs() < 1e-3).all()) and bool((left[:, 0].abs() > 0.99).all())
    verdict = judge(problem, solution.U)
    assert bool(verdict.feasible.all())
    torch.testing.assert_close(verdict.violation, solution.violation, rtol=1e-6, atol=1e-9)
    if solver != "al_ilqr":
        assert bool((certify(problem, solution.X, solution.U).kkt_residual < 1e-4).all())


@pytest.mark.slow
def test_without_it_the_other_sign_is_a_longer_way() -> None:
    near, far = (float(torchgco.solve(satellites(BOTH[i : i + 1], None)).cost) for i in (0, 1))
    ours = torchgco.solve(satellites(BOTH[:2])).cost
    assert far > 2.0 * near and float(ours[1]) == pytest.approx(near, rel=1e-3)


def test_rows_are_the_rotation_that_is_left() -> None:
    problem = satellites(G.view(1, 4), rest=[0.0, NAN, 0.0])
    row = problem.constraints[-1]
    assert isinstance(row, GoalState) and problem.row_shapes[-1] == (1, 2 + 3)
    X, U = torch.zeros(1, 31, 7, dtype=D), torch.zeros(1, 30, 3, dtype=D)
    for axis in range(3):
        by = [0.0, 0.0, 0.0]
        by[axis] = 1.0
        for sign in (1.0, -1.0):
            X[0, -1, 3:] = sign * times(G, turned(by, 1e-4))
            expected = torch.tensor([0.0, 0.0, *(sign * 1e-4 * b for b in by)], dtype=D)
            torch.testing.assert_close(row.value(X, U)[0, 0], expected, rtol=1e-6, atol=1e-12)
        assert row.told(2 + axis, 30, problem.dynamics) == f"rotation about the body's {'xyz'[axis]} axis"
    assert row.told(1, 30, problem.dynamics) == "state 2"


def test_its_own_derivatives_are_those_of_its_rows() -> None:
    row = satellites(BOTH, rest=[0.0, NAN, 0.0]).constraints[-1]
    draw = torch.Generator().manual_seed(0)
    X, U = torch.randn(3, 31, 7, generator=draw, dtype=D), torch.zeros(3, 30, 3, dtype=D)
    g, h = (torch.randn(3, 1, 5, generator=draw, dtype=D) for _ in range(2))
    own, by_torch = torch.zeros(3, 31, 11, 11, dtype=D), torch.zeros(3, 31, 11, 11, dtype=D)
    row.accumulate(X, U, g, h, own)
    super(GoalState, row).accumulate(X, U, g, h, by_torch)
    torch.testing.assert_close(own, by_torch)


def test_a_compiled_problem_takes_other_attitudes() -> None:
    loop = torchgco.compile(satellites(G.view(1, 4)))
    other = torch.cat((torch.zeros(3, dtype=D), -BOTH[2])).view(1, 7)
    answer = loop(state=other)
    expected = torchgco.solve(satellites(-BOTH[2:]), solver="interior_point")
    torch.testing.assert_close(torch.as_tensor(answer.U), expected.U, rtol=1e-5, atol=1e-5)
    assert bool(judge(loop.problem, torch.as_tensor(answer.U)).feasible.all())


@pytest.mark.parametrize("quaternion", [range(3, 6), [3, 4, 5, 5], [4, 5, 6, 7], "wxyz", 3, [3.0, 4.0, 5.0, 6.0]])
def test_other_than_four_states_are_refused(quaternion: Any) -> None:
    with pytest.raises(InputError, match=r"^goal\.quaternion: expected four of the states"):
        satellites(BOTH, quaternion)


def test_attitudes_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match=r"^goal\.state: expected a quaternion other than 0"):
        satellites(0.0 * BOTH)
    with pytest.raises(InputError, match=r"^goal\.state: expected a quaternion other than 0"):
        satellites(torch.full((1, 4), NAN, dtype=D))
    point = FunctionDynamics(lambda x, u: u, n=4, m=4, dt=0.1, position=slice(0, 2))
    cost = FunctionCost(lambda x, u: u.square().sum(-1))
    with pytest.raises(InputError, match=r"^goal\.quaternion: expected None without a state"):
        Problem(point, cost, [], torch.zeros(1, 4, dtype=D), 5, Goal([1.0, 0.0], 0.1, quaternion=range(4)))
