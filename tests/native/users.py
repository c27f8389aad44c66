"""Costs and constraints as users write them, on a car with all kinds of constraints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from tests.native.test_engine import normal, user_problem
from tests.problems import quadrotor_batch
from torchgco import (
    Cone,
    ControlBounds,
    Cost,
    FirstStepRates,
    FunctionConstraint,
    FunctionDynamics,
    NormBounds,
    Problem,
    QuadraticCost,
    StateBounds,
)
from torchgco import Spheres as Discs
from torchgco.constraints.base import Constraint, Sense
from torchgco.constraints.bounds import ControlBounds as Bounds
from torchgco.costs.base import ShiftedCost

B, N = 5, 12


def rows_of(own: Tensor, x: Tensor) -> Tensor:
    """A vector per problem (B, d), shaped to fit states (B, n), (B, N, n) or samples (B, S, n)."""
    return own if x.dim() == 2 else own.unsqueeze(1)


class Smooth(Cost):
    """A pseudo-Huber distance, a hill, and a term that joins states and controls."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        far = (1.0 + (x[..., :2] - 1.0).square().sum(-1)).sqrt() - 1.0
        hill = torch.exp(-4.0 * x[..., :2].square().sum(-1))
        return far + 0.5 * hill + 0.2 * u.square().sum(-1) + 0.1 * (u[..., 0] * x[..., 3]).tanh()

    def terminal(self, x: Tensor) -> Tensor:
        return 10.0 * torch.log1p((x - 0.5).square().sum(-1))


class FirstIsFree(Smooth):
    """Other operations at the first stage."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        value = super().stage(x, u, k)
        if isinstance(k, int):
            return value if k > 0 else 0.0 * value
        return torch.cat((torch.zeros_like(value[:, :1]), value[:, 1:]), dim=1)


@dataclass(frozen=True)
class Each(Cost):
    """A target and a weight per problem, and a shared weight."""

    target: Tensor  # (B, 4)
    weight: Tensor  # (B, 1)
    shared: Tensor  # (1, 4)

    batched: ClassVar[tuple[str, ...]] = ("target",)
    per_element: ClassVar[tuple[str, ...]] = ("weight", "shared")

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        e = x - rows_of(self.target, x)
        far = (0.1 + (rows_of(self.shared, x) * e.square()).sum(-1)).sqrt()
        return rows_of(self.weight, x)[..., 0] * far + 0.1 * (1.0 + x[..., 3].square()) * u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 5.0 * self.weight[..., 0] * (x - self.target).square().sum(-1) + x[..., 2].cosh()


@dataclass(frozen=True)
class ByKnot(Cost):
    """References per knot, shared and per problem, and weights computed from k."""

    path: Tensor  # (N, 4)
    own_path: Tensor  # (B, N, 2)

    batched: ClassVar[tuple[str, ...]] = ("own_path",)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        own = self.own_path[:, k].unsqueeze(1) if isinstance(k, int) and x.dim() == 3 else self.own_path[:, k]
        far = (0.1 + (x - self.path[k]).square().sum(-1)).sqrt()
        late = torch.where(torch.as_tensor(k) > 5, 2.0, 0.5)
        return 0.9**k * far + late * (u - own).square().sum(-1) + 0.01 * (k + 1) * (x[..., 3] * u[..., 0]).sin()

    def terminal(self, x: Tensor) -> Tensor:
        return (x - self.path[-1]).square().sum(-1)


@dataclass(frozen=True)
class AllAtOnce(ByKnot):
    """The same, but any k that is not an int is taken for all stages."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        path, own = (self.path[k], self.own_path[:, k]) if isinstance(k, int) else (self.path, self.own_path)
        return (0.1 + (x - path).square().sum(-1)).sqrt() + (u - own).square().sum(-1)


@dataclass(frozen=True)
class Dense(Cost):
    """A function of every pair of states and controls."""

    W: Tensor  # (8, 6)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return torch.nn.functional.softplus(torch.cat((x, u), dim=-1) @ self.W.mT).square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return (x @ self.W[:, :4].mT).cos().sum(-1) + 3.0 * x.square().sum(-1)


class Kinks(Cost):
    """Terms with kinks at rest."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        inside = torch.where(u.abs() < 0.5, u.square(), u.abs() - 0.25).sum(-1)
        return inside + u.norm(dim=-1) + x.clamp(min=0.0).square().sum(-1) + torch.relu(u[..., 0]).square()

    def terminal(self, x: Tensor) -> Tensor:
        return torch.linalg.vector_norm(x, dim=-1) + x.square().sum(-1)


class GaussNewton(Cost):
    """Overrides `expand`: its gradients are exact, its Hessians aren't."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return x.cosh().log().sum(-1) + 0.2 * u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return x.cosh().log().sum(-1)

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        H.zero_()
        H[..., :n, :n].diagonal(dim1=-2, dim2=-1).add_(1.0 + X.square())
        H[:, :-1, n + 1 :, n + 1 :].diagonal(dim1=-2, dim2=-1).add_(0.4 + 0.1 * U.square())
        H[:, :-1, n + 1, 3] = H[:, :-1, 3, n + 1] = 0.1 * U[..., 0].cos()
        H[..., :n, n] = H[..., n, :n] = X.tanh()
        H[:, :-1, n + 1 :, n] = H[:, :-1, n, n + 1 :] = 0.4 * U


@dataclass(frozen=True)
class ScalesItself(Cost):
    """Overrides `scaled`, which turns its number into a tensor."""

    weight: Any = 2.0

    per_element: ClassVar[tuple[str, ...]] = ("weight",)

    def scaled(self, factor: Tensor) -> ScalesItself:
        return replace(self, weight=factor * self.weight)

    def _times(self, value: Tensor) -> Tensor:
        own = self.weight
        return value * (own.view(-1, *[1] * (value.dim() - 1)) if isinstance(own, Tensor) else own)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self._times((1.0 + x.square().sum(-1)).sqrt() + u.square().sum(-1))

    def terminal(self, x: Tensor) -> Tensor:
        return self._times(x.square().sum(-1))


@dataclass(frozen=True)
class Around(Cost):
    """Another cost plus a term in states and controls."""

    inner: Cost

    batched: ClassVar[tuple[str, ...]] = ("inner",)

    def bind(self, dims: Any) -> Around:
        return Around(self.inner.bind(dims))

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self.inner.stage(x, u, k) + (x[..., 0] * u[..., 1]).sin()

    def terminal(self, x: Tensor) -> Tensor:
        return self.inner.terminal(x) + x[..., 2].cos()


def with_cost(cost: Cost) -> Problem:
    base = user_problem(B, N)
    return Problem(base.dynamics, cost, base.constraints, base.x0, N)


def each(B: int = B) -> Each:
    return Each(normal(B, 4, seed=20), 1.0 + normal(B, 1, seed=21).abs(), torch.tensor([[1.0, 2.0, 0.5, 0.1]]).double())


def by_knot(kind: type[ByKnot] = ByKnot) -> ByKnot:
    return kind(normal(N, 4, seed=22), 0.3 * normal(B, N, 2, seed=23))


def around() -> Around:
    weights = dict(Q=[1.0, 2.0, 0.5, 0.1], R=[0.3, 0.2], Qf=[5.0] * 4)
    return Around(QuadraticCost(**weights, x_ref=normal(B, N + 1, 4, seed=24), u_ref=normal(N, 2, seed=25)))


@dataclass(frozen=True)
class Tube(Constraint):
    """|p_k - center_k| within a radius per problem, at some knots."""

    centers: Tensor  # (N+1, 2)
    radius: Tensor  # (B,)
    knots: Any
    sense: Sense = "inequality"

    batched: ClassVar[tuple[str, ...]] = ("radius",)

    def bind(self, dims: Any) -> Tube:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        away = (X[..., :2] - self.centers)[:, self.knots]
        return away.square().sum(-1, keepdim=True) - self.radius.view(-1, 1, 1).square()

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        slope = 2.0 * (X[..., :2] - self.centers)[:, self.knots]
        add = H[:, self.knots]
        add[..., :2, 4] += g * slope
        add[..., 4, :2] += g * slope
        add[..., :2, :2] += h.unsqueeze(-1) * slope.unsqueeze(-1) * slope.unsqueeze(-2)
        H[:, self.knots] = add


class Power(FunctionConstraint):
    """u_0 v <= 1 / 10 as a function constraint whose overridden `value` halves it."""

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return 0.5 * super().value(X, U)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        super().accumulate(X, U, 0.5 * g, 0.25 * h, H)


class Tight(Bounds):
    """Bounds with a margin."""

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return super().value(X, U) + 0.1

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        super().accumulate(X, U, g, h, H)  # a margin changes no slope


def with_constraints() -> Problem:
    base = user_problem(B, N)
    radius = 0.5 + normal(B, seed=26).abs()
    rows = [
        Tube(0.3 * normal(N + 1, 2, seed=27), radius, slice(1, N + 1)),
        Tube(0.3 * normal(N + 1, 2, seed=28), radius, torch.tensor([2, 5, N]), "equality"),
        Power(lambda x, u: u[..., :1] * x[..., 3:] - 0.1, of="xu"),
        Tight([-1.0, -torch.inf], [torch.inf, 2.0]),
        ControlBounds([-2.0, -2.0], [2.0, 2.0]),
    ]
    return Problem(base.dynamics, each(), rows, base.x0, N)


def first_step() -> Problem:
    base = quadrotor_batch(B=3, N=6, obstacles=2)[0]
    thrusts = torch.tensor([[3.0, 4, 3, 4], [4.0, 3, 4, 4], [3.5, 3.5, 3.5, 3.6]], dtype=torch.float64)
    return Problem(base.dynamics, base.cost, [FirstStepRates(thrusts), *base.constraints], base.x0, base.N)


def by_stage(x: Tensor, u: Tensor, k: int | Tensor, drag: Tensor, wind: Tensor, dt: Tensor) -> Tensor:
    """A step of a car: drag per problem, wind per problem and stage, lengths per stage, brakes that fade with k."""
    angle, speed = x[..., 2], x[..., 3]
    k = torch.as_tensor(k, dtype=x.dtype)
    fade = torch.where(k > 5, 0.5, 1.0) * 0.95**k
    ahead = torch.stack((speed * angle.cos(), speed * angle.sin(), u[..., 1], fade * u[..., 0] - drag * speed), dim=-1)
    return x + dt * (ahead + torch.cat((wind, torch.zeros_like(wind)), dim=-1))


def with_stages(function: Callable[..., Tensor] = by_stage, rows: slice = slice(None)) -> Problem:
    base = user_problem(B, N)
    wind, lengths = 0.3 * normal(B, N, 2, seed=33)[rows], torch.linspace(0.05, 0.2, N).double().view(1, N, 1)
    model = FunctionDynamics(
        function, 4, 2, dt=0.1, integrator="none", position=slice(0, 2),
        values={"drag": normal(B, seed=34).abs()[rows]}, knot_values={"wind": wind, "dt": lengths},
    )  # fmt: skip
    cost = Errand(each().target[rows, :2].contiguous())
    bounds, discs = ControlBounds(-2, 2), Discs([[1.0, 1.0]], [0.3], 0.1)
    return Problem(model, cost, [bounds, discs], base.x0[rows], N)


def with_models_by_stage() -> Problem:
    """Three kinds of steps, of which one holds numbers of its problem and its stage."""
    drag = 0.2 + 0.1 * normal(B, 4, seed=40).abs()

    def step(x: Tensor, u: Tensor, k: int | Tensor, drag: Tensor, gust: Tensor) -> Tensor:
        push = 0.1 * torch.cat((u, u[..., :1] * x[..., :1], u[..., 1:].sin()), dim=-1)
        kinds = [x + push, (x * (1.0 - 0.1 * drag) + push * gust).tanh(), x.sin() + push.square()]
        if isinstance(k, int):
            return kinds[k % 3]
        return torch.stack([kinds[j % 3][..., i, :] for i, j in enumerate(k.tolist())], dim=-2)

    gusts = {"gust": 1.0 + normal(1, N, 4, seed=41)}
    base = user_problem(B, N)
    model = FunctionDynamics(step, n=4, m=2, dt=0.1, integrator="none", values={"drag": drag}, knot_values=gusts)
    return Problem(model, FirstIsFree(), base.constraints, base.x0, N)


def with_bounds_by_knot() -> Problem:
    base = user_problem(B, N)
    lower = -0.2 - normal(B, N, 2, seed=35).abs()
    lower[2, 3:6, 0] = -torch.inf
    ceiling = torch.full((1, 3, 4), torch.inf).double()
    ceiling[0, :2, 3], ceiling[0, 2, :2] = 0.3, torch.tensor([0.1, 0.2]).double()
    rows = [
        ControlBounds(lower, [0.4, 0.5]),
        StateBounds(-torch.inf, ceiling, knots=[2, 5, -1]),
        StateBounds(-5.0, torch.linspace(2, 1, N).double().view(1, N, 1).expand(B, N, 4)),
    ]
    return Problem(base.dynamics, each(), rows, base.x0, N)


def with_norms() -> Problem:
    base = user_problem(B, N)
    low = 0.1 * normal(B, 3, seed=36).abs()
    rows = [
        NormBounds("u", upper=0.5 + normal(B, seed=37).abs()),
        NormBounds(("x", slice(0, 2)), low, low + 0.5, knots=[2, 7, N], center=0.2 * normal(1, 3, 2, seed=38)),
        Cone([1.0, 0.3], torch.linspace(0.4, 2.0, N).double().view(1, N), ("x", [3, 1])),
        Cone(normal(B, 3, seed=39), 0.7, ("quaternion", [3, 0, 1, 2])),
    ]
    return Problem(base.dynamics, each(), rows, base.x0, N)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "smooth": lambda: with_cost(Smooth()),
    "per problem": lambda: with_cost(each()),
    "by knot": lambda: with_cost(by_knot()),
    "all at once": lambda: with_cost(by_knot(AllAtOnce)),
    "dense": lambda: with_cost(Dense(0.4 * normal(8, 6, seed=29))),
    "kinks": lambda: with_cost(Kinks()),
    "overridden expand": lambda: with_cost(GaussNewton()),
    "scales itself": lambda: with_cost(ScalesItself()),
    "around a quadratic one": lambda: with_cost(around()),
    "shifted": lambda: with_cost(ShiftedCost(each(), normal(B, seed=32))),
    "constraints": with_constraints,
    "first step": first_step,
    "dynamics by stage": with_stages,
    "models by stage": with_models_by_stage,
    "bounds by knot": with_bounds_by_knot,
    "norms and cones": with_norms,
}


def unicycle(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x, y, heading and speed under acceleration and turn rate."""
    return torch.stack((x[..., 3] * x[..., 2].cos(), x[..., 3] * x[..., 2].sin(), u[..., 1], u[..., 0]), dim=-1)


@dataclass(frozen=True)
class Errand(Cost):
    """Distance to a target per problem, with a weight that grows with k; fast turns are expensive."""

    target: Tensor  # (B, 2)

    batched: ClassVar[tuple[str, ...]] = ("target",)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        far = (1.0 + (x[..., :2] - rows_of(self.target, x)).square().sum(-1)).sqrt() - 1.0
        return (0.02 + 4e-4 * k) * far + 0.01 * u.square().sum(-1) + 0.02 * (x[..., 3] * u[..., 1]).square()

    def terminal(self, x: Tensor) -> Tensor:
        return 20.0 * (x[..., :2] - rows_of(self.target, x)).square().sum(-1) + 2.0 * x[..., 3].square()

    def goal(self, x0: Tensor) -> Tensor:
        return torch.cat((self.target, torch.zeros_like(x0[:, 2:])), dim=-1)


def errands(B: int = 2, N: int = 100) -> Problem:
    """Unicycles that drive between five discs."""
    start, target = torch.zeros(2, B, 4, dtype=torch.float64)
    start[:, 1], target[:, 0], target[:, 1] = 0.3 * normal(B, seed=30), 5.0, 0.3 * normal(B, seed=31)
    centers = [[1.5, 0.3], [2.2, -0.6], [3.0, 0.5], [3.8, -0.3], [2.7, 1.4]]
    return Problem(
        FunctionDynamics(unicycle, 4, 2, dt=0.05, integrator="rk4", position=slice(0, 2)),
        Errand(target[:, :2].contiguous()),
        [Discs(centers, [0.35] * 5, 0.1), ControlBounds([-3.0, -3.0], [3.0, 3.0])],
        start, N,
    )  # fmt: skip
