"""A user's class whose own methods would never be called, or that lacks one, is refused in one line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    Boxes,
    Constraint,
    ControlBounds,
    Cost,
    FunctionConstraint,
    FunctionCost,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    Status,
)
from torchgco.base.shapes import Dimensions
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.kernels import use_native
from torchgco.obstacles import Obstacles
from torchgco.obstacles.spheres import BoundSpheres

D, N = torch.float64, 10
GUESS = torch.full((2, N, 2), 0.3, dtype=D)
WEIGHTS = {"Q": [1.0] * 6, "R": [0.1] * 2, "Qf": [10.0] * 6, "x_ref": [1.0, 0, 0, 0, 0, 0]}


def problem(*constraints: Constraint, cost: Cost | None = None, dynamics: Any = None) -> Problem:
    cost = QuadraticCost(**WEIGHTS) if cost is None else cost
    return Problem(dynamics or Planar(dt=0.05), cost, list(constraints), torch.zeros(2, 6, dtype=D), N)


@dataclass(frozen=True)
class Effort(QuadraticCost):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.abs().sum(-1)


@dataclass(frozen=True)
class Waypoint(QuadraticCost):
    def total(self, X: Tensor, U: Tensor) -> Tensor:
        return (X[:, 5, :2] - 0.3).square().sum(-1)


@dataclass(frozen=True)
class Soft(Spheres):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return X[:, 1:, :1] - 5.0


@dataclass(frozen=True)
class Plain(Boxes):
    geometric = False


@dataclass(frozen=True)
class SofterStill(Soft):
    """The method is one of a class between."""


LOST = {
    "cost.stage": lambda: problem(cost=Effort(**WEIGHTS)),
    "cost.total": lambda: problem(cost=Waypoint(**WEIGHTS)),
    "constraints[0].value": lambda: problem(Soft([[0.5, 0.5]], [0.1], 0.05)),
    "constraints[0].geometric": lambda: problem(Plain([[0.5, 0.5]], [[0.1, 0.1]], vehicle_radius=0.05)),
    "constraints[1].value": lambda: problem(ControlBounds(-1, 1), SofterStill([[0.5, 0.5]], [0.1], 0.05)),
}


@pytest.mark.parametrize("field", LOST)
def test_methods_that_would_never_be_called_are_refused(field: str) -> None:
    with pytest.raises(InputError, match="own methods are called: Bound") as told:
        LOST[field]()
    assert told.value.field == field


def test_new_parts_of_a_problem_are_looked_at_as_well() -> None:
    given = problem()
    with pytest.raises(InputError, match=r"cost\.stage: .* one of Effort"):
        given.started_at(given.x0, [], cost=Effort(**WEIGHTS))


@dataclass(frozen=True)
class Late(FunctionConstraint):
    """Its class stays what it is: its own rows are those that hold."""

    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        return super().rows_at(k, *arguments) - 0.1


@dataclass(frozen=True)
class Scaled(QuadraticCost):
    """A field, a method and a `bind` of its own: nothing is lost."""

    factor: float = 2.0

    def bind(self, dims: Dimensions) -> Cost:
        return QuadraticCost(**WEIGHTS | {"R": self.weights()}).bind(dims)

    def weights(self) -> list[float]:
        return [self.factor * w for w in self.R]


def test_classes_that_keep_their_methods_pass() -> None:
    late = problem(Late(lambda x: x[..., :1] - 0.5))
    rows = late.constraints[0].value(*late.at_rest)
    assert float((rows + 0.6).abs().max()) < 1e-12
    scaled = problem(cost=Scaled(**WEIGHTS))
    assert isinstance(scaled.cost, BoundQuadratic) and bool((scaled.cost.R == 0.2).all())


def made(kind: type[Cost | Constraint], bound: Cost | Constraint) -> Any:
    """The bound part as one of a user's class."""
    return kind(**vars(bound))


class Hinge(BoundQuadratic):
    """A term that is 0 where problems are tried, so that no difference shows it."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return super().stage(x, u, k) + 4.0 * (x[..., 0] - 0.3).relu().square()


class Landing(BoundQuadratic):
    def terminal(self, x: Tensor) -> Tensor:
        return super().terminal(x) + 4.0 * (x[..., 0] - 0.3).relu().square()


class OwnSlopes(Hinge):
    """The weights alone are scaled to the unit of cost, not the hinge."""

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        Cost.expand(self, X, U, H)


class Whole(OwnSlopes):
    def scaled(self, factor: Tensor) -> Cost:
        return Cost.scaled(self, factor)


class Larger(BoundSpheres):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return super().value(X, U) + 0.1 * (X[:, self.knots, :1] - 0.3).relu()


class Nearer(BoundSpheres):
    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return super().signed_distance(p, t) - 0.1


class Narrower(StateBounds):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return super().value(X, U) + (X[:, self.knots, :1] - 0.3).relu()


class Later(FunctionConstraint):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return super().value(X, U) + (X[:, self.knots, :1] - 0.3).relu()


def of_bound_cost(kind: type[BoundQuadratic]) -> Problem:
    return problem(cost=made(kind, problem().cost))


def of_bound_spheres(kind: type[BoundSpheres]) -> Problem:
    return problem(made(kind, problem(Spheres([[0.5, 0.5]], [0.1], 0.05)).constraints[0]))


TORN = {
    "cost.expand": lambda: of_bound_cost(Hinge),
    "cost.expand ": lambda: of_bound_cost(Landing),
    "cost.scaled": lambda: of_bound_cost(OwnSlopes),
    "constraints[0].accumulate": lambda: of_bound_spheres(Larger),
    "constraints[0].violation": lambda: of_bound_spheres(made_violation()),
    "constraints[0].rows": lambda: of_bound_spheres(Nearer),
    "constraints[0].accumulate ": lambda: problem(Narrower(-9.0, 9.0)),
    "constraints[0].accumulate  ": lambda: problem(Later(lambda x: x[..., :1] - 0.5)),
}


def made_violation() -> type[BoundSpheres]:
    """A class with rows and slopes of its own, whose penetration is that of the spheres."""

    class Both(Larger):
        def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
            super().accumulate(X, U, g, h, H)

    return Both


@pytest.mark.parametrize("field", TORN)
def test_an_inherited_method_that_does_not_know_a_class_own_one_is_refused(field: str) -> None:
    with pytest.raises(InputError, match="which doesn't call this") as told:
        TORN[field]()
    assert told.value.field == field.strip()


@pytest.mark.slow
@compiled
def test_a_class_with_all_of_its_own_methods_is_solved() -> None:
    found, due = (
        torchgco.solve(p, solver="interior_point")
        for p in (of_bound_cost(Whole), problem(cost=FunctionCost(hinged, ended)))
    )
    assert found.statuses == due.statuses == [Status.CONVERGED] * 2
    assert float((found.cost - due.cost).abs().max()) < 1e-9


def hinged(x: Tensor, u: Tensor) -> Tensor:
    away = x - torch.tensor(WEIGHTS["x_ref"], dtype=D)
    return 0.5 * away.square().sum(-1) + 0.05 * u.square().sum(-1) + 4.0 * (x[..., 0] - 0.3).relu().square()


def ended(x: Tensor) -> Tensor:
    return 5.0 * (x - torch.tensor(WEIGHTS["x_ref"], dtype=D)).square().sum(-1)


@dataclass(frozen=True)
class NoBind(Constraint):
    pass


@dataclass(frozen=True)
class NoKnots(Constraint):
    def bind(self, dims: Dimensions) -> Self:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return X[:, 1:, :1] - 0.5


@dataclass(frozen=True)
class ReturnsNone(NoKnots):
    def bind(self, dims: Dimensions) -> Any:
        return None


@dataclass(frozen=True)
class NoValue(Constraint):
    knots = slice(1, N + 1)

    def bind(self, dims: Dimensions) -> Self:
        return self


@dataclass(frozen=True)
class NoSlopes(NoValue):
    knots = slice(0, N)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return (X[:, :-1, :2] * U).sum(-1, keepdim=True) - 0.2


@dataclass(frozen=True)
class NoObstacles(Obstacles):
    pass


@dataclass(frozen=True)
class Nothing(Planar):
    def bind(self, dims: Dimensions) -> Any:
        return None


@dataclass(frozen=True)
class OtherSum(Cost):
    """Its own sum has a term that `stage` doesn't know."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return 0.1 * u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return (x[..., 0] - 1.0).square()

    def total(self, X: Tensor, U: Tensor) -> Tensor:
        return super().total(X, U) + 3.0 * (X[:, 5, 0] - 0.9).square()


MISSING = {
    "NoBind.bind": lambda: problem(NoBind()),
    "NoObstacles.bind": lambda: problem(NoObstacles()),
    "constraints[0].knots": lambda: problem(NoKnots()),
    "constraints[1].bind": lambda: problem(StateBounds(-9.0, 9.0), ReturnsNone()),
    "NoValue.value": lambda: problem(NoValue()),
    "dynamics.bind": lambda: problem(dynamics=Nothing(dt=0.05)),
    "cost.total": lambda: problem(cost=OtherSum()),
    "cost.goal": lambda: problem(cost=own(OtherSum, goal=lambda self, x0: x0 + "here")()),
}


@pytest.mark.parametrize("field", MISSING)
def test_what_a_class_leaves_out_is_named(field: str) -> None:
    with pytest.raises(InputError) as told:
        MISSING[field]()
    assert told.value.field == field


@pytest.mark.sampled(2)
@compiled
@pytest.mark.parametrize("solver", ["al_ilqr", "ilqr", "interior_point", "gco"])
def test_rows_without_derivatives_of_their_own_are_differentiated(solver: str) -> None:
    rows = FunctionConstraint(lambda x, u: (x[..., :2] * u).sum(-1, keepdim=True) - 0.2, of="xu")
    use_native(False)
    try:
        found, due = (torchgco.solve(problem(part), solver=solver, U0=GUESS) for part in (NoSlopes(), rows))
    finally:
        use_native(True)
    assert found.statuses == due.statuses and float((found.U - due.U).abs().max()) < 1e-6


def test_the_derivatives_by_default_are_those_of_each_row() -> None:
    generator = torch.Generator().manual_seed(4)
    X, U = (torch.randn(2, K, width, generator=generator, dtype=D) for K, width in ((N + 1, 6), (N, 2)))
    part = problem(NoSlopes()).constraints[0]
    g, h = torch.randn(2, 2, N, 1, generator=generator, dtype=D).unbind(0)
    found = torch.zeros(2, N + 1, 9, 9, dtype=D)
    part.accumulate(X, U, g, h, found)
    due = torch.zeros_like(found)
    for b in range(2):
        for k in range(N):
            slope = torch.zeros(9, dtype=D)  # of x_0 u_0 + x_1 u_1, in the order [x, 1, u]
            slope[:2], slope[7:] = U[b, k], X[b, k, :2]
            due[b, k] = h[b, k] * slope.outer(slope)
            due[b, k, 6] += g[b, k] * slope
            due[b, k, :, 6] += g[b, k] * slope
    assert float((found - due).abs().max()) < 1e-12


class Doubled(NoSlopes):
    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        super().accumulate(X, U, 2.0 * g, h, H)


def test_derivatives_that_are_wrong_are_named() -> None:
    with pytest.raises(InputError, match="where differences give") as told:
        problem(Doubled())
    assert told.value.field == "constraints[0].accumulate"


def own(heir: type, **names: Any) -> Any:
    return dataclass(frozen=True)(type("Own", (heir,), names))


@dataclass(frozen=True)
class Times(NoSlopes):
    at: float = 0.5  # s: by the name of a method


SHADOWED = {
    "constraints[0].bare": lambda: problem(own(NoSlopes, bare=lambda self: 1)()),
    "constraints[0].kernel": lambda: problem(own(NoSlopes, kernel="own")()),
    "constraints[0].at": lambda: problem(Times()),
    "constraints[0].in_metres": lambda: problem(own(NoSlopes, in_metres=lambda self: True)()),
    "constraints[0].worst": lambda: problem(own(NoSlopes, worst=property(lambda self: 3.0))()),
    "cost.stage": lambda: problem(cost=own(OtherSum, stage=0.5)()),
    "dynamics.position": lambda: problem(dynamics=own(Planar, position=lambda self: slice(0, 2))(dt=0.05)),
}


@pytest.mark.parametrize("field", SHADOWED)
def test_a_name_that_means_something_else_is_refused(field: str) -> None:
    with pytest.raises(InputError, match=r"another name: by this one .* got one of ") as told:
        SHADOWED[field]()
    assert told.value.field == field


def test_names_that_mean_the_same_are_free() -> None:
    problem(own(NoSlopes, told=lambda self, row, knot, dynamics: "the power", power=3.0, geometric=False)())
    problem(dynamics=own(Planar, position=slice(0, 2), speed=lambda self, x: x[..., 3])(dt=0.05))
