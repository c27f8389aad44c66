"""Malformed input raises one error that names the part at fault; constraints hold at their knots."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import HOVER, START, planar_batch
from torchgco import (
    Boxes,
    Capsules,
    ControlBounds,
    Cost,
    Field,
    FirstStepRates,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    OccupancyGrid,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
)
from torchgco.api import solve
from torchgco.base.errors import StartWarning

nan, inf = float("nan"), float("inf")


def planar(constraints=(), x0=None, N=5, dynamics=None, cost=None) -> Problem:
    x0 = torch.zeros(2, 6, dtype=torch.float64) if x0 is None else x0
    cost = cost or QuadraticCost([1] * 6, [1, 1], [1] * 6)
    return Problem(dynamics or Planar(), cost, list(constraints), x0, N)


def nowhere(*constraints) -> Problem:
    """Dynamics without a position."""
    return planar(constraints, dynamics=FunctionDynamics(lambda x, u: x, 6, 2, 0.1))


@dataclass(frozen=True)
class Aimed(Cost):
    goal: Tensor


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: planar(N=0), "N: expected at least one stage"),
        (lambda: planar(N=2.5), "N: expected"),
        (lambda: planar(x0=torch.zeros(2, 5, dtype=torch.float64)), "x0: expected shape"),
        (lambda: planar(x0=torch.zeros(1, 2, 6, dtype=torch.float64)), "x0: expected a floating tensor"),
        (lambda: planar(x0=torch.zeros(2, 6, dtype=torch.bool)), "x0"),
        (lambda: planar(dynamics=Planar(drag=torch.ones(3, dtype=torch.float64))), "dynamics.drag"),
        (lambda: planar(dynamics=Planar(drag=torch.ones(2))), "dynamics.drag: expected torch.float64"),
        (lambda: planar(dynamics=FunctionDynamics(lambda x, u: x[..., :3], 6, 2, 0.1)), "dynamics.step"),
        (lambda: planar(constraints=[ControlBounds([1, 1], [0, 2])]), "control_bounds.lower: expected at most"),
        (lambda: planar(constraints=[ControlBounds([-1, nan], [1, 1])]), "control_bounds.lower"),
        (lambda: planar(constraints=[ControlBounds([-1], [1])]), "control_bounds.lower"),
        (lambda: planar(constraints=[StateBounds([-inf] * 6, [inf] * 6)]), "state_bounds: expected at least one"),
        (lambda: planar(constraints=[Spheres([[0.0, 0, 0]], [0.1])]), "obstacles.centers: expected 2-D points"),
        (lambda: nowhere(Spheres([[0.0, 0]], [0.1])), "obstacles.centers: expected dynamics with a position"),
        (lambda: nowhere(Spheres([], [])), "obstacles.centers: expected dynamics with a position: set `position = sli"),
        (lambda: planar(constraints=[Spheres([[nan, nan]], [0.1])]), "obstacles.radii: expected NaN exactly where"),
        (lambda: planar(constraints=[Spheres([[0.0, 1.0]], [-0.1])]), "obstacles.radii: expected finite radii of"),
        (lambda: planar(constraints=[Spheres([[0.0, 1.0]], [0.1, 0.2])]), "obstacles.radii"),
        (lambda: planar(constraints=[Spheres([[0.0, 1.0]], [0.1], 0.0, [[1.0, 1.0]] * 2)]), "obstacles.velocities"),
        (lambda: planar(constraints=[FunctionConstraint(lambda x: x[..., 0])]), "constraint.function"),
        (lambda: planar(constraints=[FunctionConstraint(lambda x: x, sense="equal")]), "constraint.sense"),
        (lambda: planar(constraints=[FunctionConstraint(lambda x: x, of="y")]), "constraint.of"),
        (lambda: planar(constraints=[FunctionConstraint(lambda x: x, knots=[6])]), "constraint.knots"),
        (lambda: planar(constraints=[FunctionConstraint(lambda x: x, knots=[2, 2])]), "constraint.knots"),
        (lambda: planar(constraints=[FunctionConstraint(lambda u: u, of="u", geometric=True)]), "constraint.geometric"),
        (lambda: planar(constraints=[FirstStepRates([1.0] * 4)]), "first_step.dynamics"),
        (lambda: planar(constraints=["spheres"]), "constraints"),
        (lambda: planar(cost=Aimed(torch.zeros(6))), "cost.goal: expected a method, which no field may hide"),
    ],
)  # fmt: skip
def test_malformed_parts_are_named(make, message: str) -> None:
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        make()


def test_mixed_dtypes_are_named() -> None:
    x0 = torch.zeros(2, 6)
    bounds = ControlBounds(torch.tensor([-1.0, -1.0], dtype=torch.float64), [1, 1])
    with pytest.raises(InputError, match=r"control_bounds.lower: expected dtype torch.float32 as in x0"):
        planar(x0=x0, constraints=[bounds])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_tensor_of_another_type_than_x0_is_named(dtype: torch.dtype) -> None:
    other = torch.float32 if dtype == torch.float64 else torch.float64
    network, weights = torch.nn.Linear(4, 2, dtype=other), torch.ones(2, dtype=other)
    x0 = torch.zeros(3, 2, dtype=dtype)
    plain = FunctionDynamics(lambda x, u: x + 0.1 * u, 2, 2, 0.1, "none")
    learned = FunctionDynamics(lambda x, u: network(torch.cat((x, u), dim=-1)), 2, 2, 0.1, "none")
    cost = QuadraticCost([1.0] * 2, [0.1] * 2, [5.0] * 2)
    rows = FunctionConstraint(lambda x: x @ weights.diag() - 1.0)
    named = rf"{other} \(.*\) beside {dtype}, the type of x0, in torch"
    for parts, where in (
        ((learned, cost, []), "linear"), ((plain, cost, [rows]), "matmul"),
        ((plain, FunctionCost(lambda x, u: (x @ weights.diag()).sum(-1)), []), "matmul"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=rf"{named}.*{where}"):
            Problem(*parts, x0, 5)


def test_errors_survive_a_worker_process() -> None:
    error = pickle.loads(pickle.dumps(InputError("N", "at least 1", 0)))
    assert str(error) == "N: expected at least 1, got 0" and error.field == "N"


def test_knots_of_a_constraint() -> None:
    """A waypoint at two knots, counted from both ends, and a bound on one state only."""
    waypoint = FunctionConstraint(lambda x: x[..., :1] - 1.0, sense="equality", knots=[2, -1])
    limit = StateBounds([-inf, -inf, -inf, -0.5, -inf, -inf], [inf] * 6)
    problem = planar([waypoint, limit])
    X = torch.arange(6, dtype=torch.float64).view(1, 6, 1).repeat(2, 1, 6)
    U = torch.zeros(2, 5, 2, dtype=torch.float64)
    assert problem.constraints[0].value(X, U)[0, :, 0].tolist() == [1.0, 4.0]
    assert problem.constraints[1].value(-X, U)[0, :, 0].tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]
    assert [problem.constraints[0].holds_at(k) for k in range(6)] == [False, False, True, False, False, True]


def test_a_missing_bound_is_infinite_and_its_rows_hold() -> None:
    """Also where other problems of the batch have that bound."""
    problem = planar(constraints=[ControlBounds([[-1.0, -inf], [-inf, -inf]], [2.0, 3.0])])
    (bounds,), D = problem.constraints, torch.float64
    assert problem.control_bounds is bounds
    assert bounds.lower.tolist() == [[-1.0, -inf], [-inf, -inf]] and bounds.range.tolist() == [[3.0, inf], [inf, inf]]
    rest, signs = torch.zeros(2, 1, 2, dtype=D), torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=D)
    reach = bounds.range_from(rest, signs)
    assert reach.tolist() == [[[2.0, inf], [1.0, 3.0]], [[2.0, inf], [inf, 3.0]]]
    assert bounds.middle(rest).tolist() == [[[0.5, 0.0]], [[0.0, 0.0]]]
    rows = bounds.value(torch.zeros(2, problem.N + 1, 6, dtype=D), torch.full((2, problem.N, 2), -9.0, dtype=D))
    assert rows.shape[-1] == 3 and bool(torch.isfinite(rows).all())
    assert (rows > 0).any(1).tolist() == [[False, False, True], [False, False, False]]


def test_moving_spheres_are_at_their_positions() -> None:
    centers, velocities = torch.rand(2, 3, 2, dtype=torch.float64), torch.rand(2, 3, 2, dtype=torch.float64)
    problem = planar([Spheres(centers, [0.1, 0.2, 0.3], torch.tensor([0.05, 0.1]).double(), velocities)])
    spheres = problem.constraints[0]
    X = torch.rand(2, 6, 6, dtype=torch.float64)
    U = torch.zeros(2, 5, 2, dtype=torch.float64)
    t = 0.05 * torch.arange(1, 6, dtype=torch.float64).view(1, 5, 1, 1)
    where = centers.unsqueeze(1) + t * velocities.unsqueeze(1)
    R = torch.tensor([[0.15, 0.25, 0.35], [0.2, 0.3, 0.4]], dtype=torch.float64).unsqueeze(1)
    expected = R**2 - (X[:, 1:, None, :2] - where).square().sum(-1)
    torch.testing.assert_close(spheres.value(X, U), expected)
    torch.testing.assert_close(spheres.at(X[:, 3:4], 3)[:, 0], expected[:, 2])
    torch.testing.assert_close(spheres.violation(X, U), (R - (R**2 - expected).sqrt()).clamp(min=0.0))


def test_layouts_of_unequal_counts_share_a_batch() -> None:
    centers = torch.tensor([[[0.5, 0.0], [nan, nan]], [[0.5, 0.0], [0.0, 0.5]]], dtype=torch.float64)
    radii = torch.tensor([[0.1, nan], [0.1, 0.1]], dtype=torch.float64)
    spheres = planar([Spheres(centers, radii)]).constraints[0]
    X, U = torch.zeros(2, 6, 6, dtype=torch.float64), torch.zeros(2, 5, 2, dtype=torch.float64)
    assert (spheres.value(X, U)[0, :, 1] == -1.0).all()
    assert spheres.violation(X, U)[0, :, 1].abs().sum() == 0


def test_first_step_rates_are_those_of_the_airframe() -> None:
    x0 = torch.tensor([START], dtype=torch.float64)
    x0[0, 10:13] = torch.tensor([0.3, -0.2, 0.5])
    cost = QuadraticCost([1] * 14, [1] * 4, [1] * 14, x_ref=START, u_ref=HOVER)
    first = FirstStepRates([3.0, 4.0, 5.0, 4.0], period=0.05)
    problem = Problem(QuadrotorPlanning(), cost, [first], x0, 3)
    from tests.reference.models import first_step_consistency

    g = first_step_consistency(x0[0, 10:13].numpy(), torch.tensor([3.0, 4, 5, 4]).numpy(), 0.05)
    X = torch.randn(1, 4, 14, dtype=torch.float64)
    value = problem.constraints[0].value(X, torch.zeros(1, 3, 4, dtype=torch.float64))
    torch.testing.assert_close(value[0, 0], torch.as_tensor(g(X[0, 1].numpy())), rtol=1e-12, atol=1e-12)


def test_solve_takes_sensible_defaults() -> None:
    problem, _ = planar_batch(B=2, N=8, obstacles=2)
    solution = solve(problem)
    assert solution.X.shape == (2, 9, 6) and bool(torch.isfinite(solution.cost).all())
    again = solve(problem, warm=solution)
    assert bool((again.cost <= solution.cost * 1.01).all())


@pytest.mark.parametrize("x0", [[0.0] * 6, [0] * 6, np.zeros(6), torch.zeros(6, dtype=torch.int64), [[0.0] * 6]])
def test_starts_may_be_lists_arrays_and_single_states(x0) -> None:
    problem = planar(x0=x0)
    assert problem.x0.dtype == torch.float64 and tuple(problem.x0.shape) == (1, 6)


def test_shapes_that_parts_state_are_those_of_their_rows() -> None:
    knots = torch.tensor([1, 3, 4])
    parts = [
        ControlBounds([-1.0, -inf], [inf, 2.0]),
        ControlBounds([-1.0, -1.0], [1.0, inf], knots=[0, 2]),
        StateBounds([-inf, -3.0, -inf, -1.0], [inf, 3.0, 2.0, inf]),
        StateBounds(torch.full((1, 3, 4), -5.0), torch.full((1, 3, 4), 5.0), knots=knots),
        RateBounds([-1.0, -inf], [1.0, 1.0]),
        Spheres([[5.0, 5.0], [7.0, 7.0], [9.0, 9.0]], [1.0, 1.0, 0.5], 0.1),
        Spheres([[5.0, 5.0]], [1.0], 0.1, velocities=[[0.1, 0.0]]),
        Boxes([[5.0, 5.0], [7.0, 7.0]], [[1.0, 1.0], [0.5, 1.0]], 0.1, [0.0, 0.3], knots=[1, 2]),
        Capsules([[5.0, 5.0]], [[7.0, 7.0]], [1.0]),
        Field(OccupancyGrid(np.eye(4, dtype=bool), (4.0, 4.0), 1.0), 0.1, knots=knots),
    ]
    dynamics = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, position=slice(0, 2))
    problem = Problem(dynamics, QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4), parts, torch.zeros(2, 4), 5)
    X, U = torch.zeros(2, 6, 4), torch.zeros(2, 5, 2)
    for part, shape in zip(problem.constraints, problem.row_shapes, strict=True):
        assert part.row_shape(problem.N) == shape == tuple(part.value(X, U).shape[1:])


@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
def test_a_start_counts_where_obstacles_hold_from_the_first_knots() -> None:
    """A vehicle may leave an obstacle that holds later, and a free start is a guess."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.2, "euler", position=slice(0, 2))
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 0.2], [30, 30, 2, 2], [1.5, 0.8, 0, 0])

    def near(knots: slice | None, free: list[bool] | None = None) -> Problem:
        spheres = Spheres([[0.1, 0.0]], 0.2, 0.05, knots=knots)
        return Problem(model, cost, [ControlBounds(-4.0, 4.0), spheres], [[0.0] * 4], 10, free_start=free)

    for knots in (None, slice(0, 11), slice(1, 3)):
        assert solve(near(knots), verbose=False).statuses == [Status.INVALID_START]
    for problem in (near(slice(5, 11)), near(None, [True, True, False, False])):
        found = solve(problem, solver="interior_point", verbose=False)
        assert found.statuses != [Status.INVALID_START] and float(found.violation) <= 1e-6
    with pytest.warns(StartWarning):
        assert solve(near(None, [False, False, True, True]), solver="al_ilqr").statuses == [Status.INVALID_START]
