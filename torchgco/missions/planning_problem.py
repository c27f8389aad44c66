"""What a plan sees from a measured state: the planning model with its bias, its equalities, obstacles with margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Above, Seconds, check_options
from torchgco.base.shapes import Dimensions, check_shape, check_tensor, tensor
from torchgco.constraints.base import Constraint, Sense
from torchgco.constraints.bounds import bounds_of
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlanning, QuadrotorThrusts
from torchgco.kernels import current, open_loop
from torchgco.obstacles.base import CONTACT_FACTOR, Obstacles
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class FirstStepRates(Constraint):
    """The body rates at knot 1 are those that the rotors' thrusts at x_0 produce (section 5.2.1):

        0 = w(t1) - w(t0) - J^-1 (T F(t0) - w x (J w) - D w) T_s,   at knot 1, with w = w(t0) of x_0.

    Args:
        thrusts: F(t0), (4,) or (B, 4), N.
        period: T_s, s.
        airframe: the quadrotor's parameters.
        reachable: lowest and highest w(t1) of the planning model, (B, 3) each, rad/s; where the rotors lead outside,
            the nearest reachable rates are asked for. None: as printed, which no plan may be able to meet.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, dynamics without the planning model's 14 states.
    """

    thrusts: Any
    period: Seconds = 0.05
    airframe: Airframe = Airframe()
    reachable: tuple[Tensor, Tensor] | None = None
    target: Tensor | None = None  # (B, 3): w(t1), once bound

    knots: ClassVar[slice] = slice(1, 2)
    sense: ClassVar[Sense] = "equality"
    batched: ClassVar[tuple[str, ...]] = ("thrusts", "reachable", "target")
    rates: ClassVar[slice] = slice(10, 13)

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, "first_step")
        if dims.n != 14:
            raise InputError("first_step.dynamics", "the planning model with 14 states", f"{dims.n} states")
        thrusts = tensor(self.thrusts, "first_step.thrusts", dims.like)
        thrusts = thrusts.expand(dims.B, 4) if thrusts.dim() == 1 else thrusts
        check_shape(thrusts, (dims.B, 4), "first_step.thrusts")
        w0 = dims.like[:, self.rates]
        target = w0 + self.period * self.airframe.angular_acceleration(w0, thrusts)
        if self.reachable is not None:
            lower, upper = self.reachable
            for bound in self.reachable:
                check_shape(bound, (dims.B, 3), "first_step.reachable")
                check_tensor(bound, "first_step.reachable", dims.like)
            target = torch.minimum(torch.maximum(target, lower), upper)
        return replace(self, thrusts=thrusts.contiguous(), target=target)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        assert self.target is not None
        return (X[:, 1, self.rates] - self.target).unsqueeze(1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        H[:, 1, self.rates, n] += g[:, 0]
        H[:, 1, n, self.rates] += g[:, 0]
        H[:, 1, self.rates, self.rates] += torch.diag_embed(h[:, 0])


@dataclass(frozen=True)
class ThrustSum(Constraint):
    """The rotors' joint thrust follows the plan (section 5.2.1): 0 = sum_i F_i - m a_ref at knots 1..N.

    Args:
        acceleration: a_ref (B, N), m/s^2, at knots 1..N.
        mass: m, kg.

    Raises:
        InputError: on `Problem(...)`: wrong shape, dynamics without the tracking model's 7 states.
    """

    acceleration: Tensor
    mass: Annotated[float, Above(0, "kg")]
    thrust: Tensor | None = None  # (B, N): m a_ref, N, once bound

    knots: Any = None
    sense: ClassVar[Sense] = "equality"
    batched: ClassVar[tuple[str, ...]] = ("acceleration", "thrust")

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, "thrust_sum")
        if dims.n != 7:
            raise InputError("thrust_sum.dynamics", "the tracking model with 7 states", f"{dims.n} states")
        check_shape(self.acceleration, (dims.B, dims.N), "thrust_sum.acceleration")
        check_tensor(self.acceleration, "thrust_sum.acceleration", dims.like)
        return replace(self, knots=slice(1, dims.N + 1), thrust=self.mass * self.acceleration)

    def toward(self, acceleration: Tensor) -> None:
        """Write another a_ref (B, N), m/s^2, into a bound part's own tensors, unchecked."""
        assert self.thrust is not None
        self.acceleration.copy_(acceleration)
        torch.mul(acceleration, self.mass, out=self.thrust)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        assert self.thrust is not None
        return (X[:, self.knots, 3:].sum(-1) - self.thrust).unsqueeze(-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        H[:, self.knots, 3:n, n] += g
        H[:, self.knots, n, 3:n] += g
        H[:, self.knots, 3:n, 3:n] += h.unsqueeze(-1)


@dataclass(frozen=True)
class RotorLimits(Constraint):
    """Commanded speeds are those that rotors can turn at: rows s (u - u_max), s (u_min - u) at knots 0..N-1.

    In newtons, as the other rows of the tracking problem: s = 2 b Omega_h is the change of thrust by speed at hover.
    Thrusts that start within their limits then stay there.

    Args:
        airframe: the quadrotor's parameters.

    Raises:
        InputError: on `Problem(...)`: dynamics without the tracking model's 4 rotors.
    """

    airframe: Airframe = Airframe()

    knots: Any = None
    batched: ClassVar[tuple[str, ...]] = ()

    def bind(self, dims: Dimensions) -> Self:
        if dims.n != 7:
            raise InputError("rotor_limits.dynamics", "the tracking model with 7 states", f"{dims.n} states")
        return replace(self, knots=slice(0, dims.N))

    @property
    def scale(self) -> float:
        """N per rpm."""
        return 2.0 * self.airframe.thrust_coefficient * self.airframe.hover_speed

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        slowest, fastest = self.airframe.rotor_speeds
        return self.scale * torch.cat((U - fastest, slowest - U), dim=-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, inputs = X.shape[-1], slice(X.shape[-1] + 1, X.shape[-1] + 5)
        gradient = self.scale * (g[..., :4] - g[..., 4:])
        H[:, self.knots, inputs, n] += gradient
        H[:, self.knots, n, inputs] += gradient
        H[:, self.knots, inputs, inputs].diagonal(dim1=-2, dim2=-1).add_(self.scale**2 * (h[..., :4] + h[..., 4:]))


MARGIN_PARTS = 4  # of the horizon, with a margin each, where margins grow
BLIND = 3  # knots whose positions the controls of a plan can't change, or hardly
EARLY = 10  # knots in which a vehicle may leave a margin that it has entered
MARGIN_ROUNDING = 1e-9  # m, against rounding
MARGIN_LEFT = 0.25  # share of the clearance from contact that an entered margin leaves


@dataclass(frozen=True)
class BiasedPlanning(QuadrotorPlanning):
    """The planning model with an acceleration that is added to v'."""

    bias: Tensor = torch.zeros(1, 3, device="cpu")  # (B, 3), m/s^2

    batched: ClassVar[tuple[str, ...]] = ("bias",)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        rates, bias = super().field(x, u), self.bias.view(-1, *([1] * (x.dim() - 2)), 3)
        return torch.cat((rates[..., :3], rates[..., 3:6] + bias.to(x.dtype), rates[..., 6:]), dim=-1)


def airframe_of(dynamics: Dynamics) -> Airframe:
    """The vehicle of a planning model.

    Raises:
        InputError: dynamics on which no mission can fly.
    """
    if not isinstance(dynamics, QuadrotorPlanning | QuadrotorThrusts):
        raise InputError("model", "quadrotor, or rotors in a race", type(dynamics).__name__)
    return dynamics.airframe


def biased(dynamics: Dynamics, bias: Tensor) -> BiasedPlanning:
    """The planning model with a bias (B, 3), m/s^2."""
    options = {f.name: getattr(dynamics, f.name) for f in fields(QuadrotorPlanning)}
    return BiasedPlanning(**options, bias=bias)


def settled(problem: Problem) -> Problem:
    """The problems of all plans of a loop, whose code is looked at here and not again: see `continued`.

    Where a user's code is part of it, which may read what changes meanwhile, every plan looks again.
    """
    return problem if problem.users else current(problem.renewed())


def continued(
    problem: Problem, x0: Tensor, constraints: Sequence[Constraint] | None = None, dynamics: Dynamics | None = None
) -> Problem:
    """Problems that may be `settled`, from other states x0 (B, n), with other parts of the same kinds and code."""
    if problem.known.current:
        return problem.moved_to(x0, constraints, dynamics)
    return problem.started_at(x0, problem.constraints if constraints is None else constraints, dynamics=dynamics)


def planning_state(x: Tensor, airframe: Airframe) -> Tensor:
    """States (..., 14) of the planning model for plants x (..., 17): thrusts become their acceleration."""
    return torch.cat((x[..., :13], x[..., 13:].sum(-1, keepdim=True) / airframe.mass), dim=-1).contiguous()


def acceleration(x: Tensor, airframe: Airframe) -> Tensor:
    """v' (B, 3) of the planning model for plants x (B, 17), m/s^2."""
    _, v, q, w, F = x.split((3, 3, 4, 3, 4), dim=-1)
    lift = F.sum(-1) / airframe.mass
    return torch.stack(airframe.pose_rates(v.unbind(-1), q.unbind(-1), w.unbind(-1), lift)[3:6], dim=-1)


@dataclass(frozen=True)
class Margin:
    """Distance that plans keep from obstacles in addition to their radii, (B,), m.

    It holds at the knots. Between two of them a straight step of length s leads up to s^2 / (8 r) into a surface of
    radius r, such as the edge of a box around which the vehicle's radius is laid: the margin is larger by this.

    Of a body the balls' steps count, and how far a ball leaves its straight step as the vehicle turns.

    size, growth  m, and m per second of the horizon, in four steps
    step          the longest that is expected between two knots, (B,), m
    before        states (B, N+1, 14) of the previous plan, whose steps are expected; None: there is none
    """

    size: float
    growth: float
    step: Tensor
    before: Tensor | None = None

    def of(self, obstacles: Obstacles) -> Tensor:
        """The margin (B,) at the beginning of the horizon, m."""
        if self.size == 0 or obstacles.absent.shape[1] == 0:
            return torch.full_like(self.step, self.size)
        step, off = self.step, torch.zeros_like(self.step)
        if obstacles.body is not None and self.before is not None:
            step = obstacles.places(self.before).diff(dim=1).norm(dim=-1).flatten(1).amax(-1)
            off = obstacles.even_bulge(self.before).flatten(1).amax(-1)
        radius = torch.where(obstacles.absent, torch.inf, obstacles.margins).amin(-1)
        return self.size + torch.minimum(step.square() / (8.0 * radius), 0.5 * step) + off

    def between(self, problem: Problem) -> Tensor:
        """The largest part of the margins (B,) that is for what happens between two knots, m."""
        parts = [self.of(obstacles) for obstacles in problem.constraints if isinstance(obstacles, Obstacles)]
        return torch.stack([torch.full_like(self.step, self.size), *parts]).amax(0) - self.size

    def around(self, obstacles: Obstacles, N: int, dt: float, depth: Tensor, start: Tensor) -> list[Constraint]:
        """Obstacles with the margin: less by `depth` (B,) at the early knots, more at late ones where it grows.

        Nowhere is it so large that the start (B, 14) would be in contact with the grown obstacles.
        """
        early, size = min(EARLY, N), self.of(obstacles)
        parts: list[Constraint] = [obstacles.grown(size - depth).with_knots(slice(1, early + 1))]
        if early == N:
            return parts
        room = torch.full_like(depth, torch.inf)
        if obstacles.absent.shape[1] > 0:
            distance = obstacles.distances_of(start.unsqueeze(1), start.new_zeros(1))[:, 0]
            room = ((distance + (1.0 - CONTACT_FACTOR) * obstacles.margins) / CONTACT_FACTOR).amin(-1) - MARGIN_ROUNDING
        for knots in torch.arange(early + 1, N + 1).chunk(MARGIN_PARTS if self.growth > 0 else 1):
            first, last = int(knots[0]), int(knots[-1]) + 1
            by = size + self.growth * 0.5 * (first + last - 1) * dt
            parts.append(obstacles.grown(torch.minimum(by, room)).with_knots(slice(first, last)))
        return parts

    def unavoidable_depth(self, problem: Problem, t: float, U: Tensor) -> Tensor:
        """How deep vehicles get into the margin before any control has an effect, (B,), m.

        At most to where a quarter of the clearance from contact is left. Obstacles of `problem` are as at time 0, its
        states as at time t, s; U are the controls (B, N, m) of the previous plan.
        """
        X = open_loop(problem, U)[:, : BLIND + 1]
        times = torch.arange(X.shape[1], dtype=X.dtype) * float(problem.dynamics.dt)
        depth = torch.zeros_like(X[:, 0, 0])
        for obstacles in problem.constraints:
            if isinstance(obstacles, Obstacles) and obstacles.absent.shape[1] > 0:
                size = self.of(obstacles).unsqueeze(-1)
                distance = obstacles.later(t).distances_of(X, times).amin(1) - size  # (B, M)
                most = size + (1.0 - MARGIN_LEFT) * (1.0 - CONTACT_FACTOR) * obstacles.margins
                depth = torch.maximum(depth, torch.minimum(-distance, most).clamp(min=0.0).amax(-1))
        return depth


def follows(first: Any, second: Any) -> bool:
    """Whether two groups of `Margin.around` are of the same obstacles, the second from the knot after the first."""
    return first.knots.stop == second.knots.start and torch.equal(first.absent, second.absent)


def first_step(problem: Problem, x: Tensor) -> FirstStepRates:
    """The body rates that the rotors lead to in the first period, as far as the planning model can follow."""
    model, reachable = problem.dynamics, None
    assert isinstance(model, QuadrotorPlanning)
    for bounds in bounds_of(problem.constraints, "u"):
        w = x[:, 10:13]
        share = model.dt / torch.as_tensor(model.rate_time_constant, dtype=x.dtype).reshape(-1, 1)
        lower, upper = (w + share * (bound[:, 0, :3] - w) for bound in bounds.by_knot)
        reachable = lower, upper
    return FirstStepRates(x[:, 13:], model.dt, model.airframe, reachable)
