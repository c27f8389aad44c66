"""A vehicle's body: balls fixed to it, which turn with it and keep clear of obstacles of every kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Number
from torchgco.base.options import check_value
from torchgco.base.shapes import Dimensions, check_finite, check_shape, space_of, tensor
from torchgco.base.tree import PerElement, passed_on
from torchgco.constraints.base import CONTACT_FACTOR, Lowered
from torchgco.obstacles.attitude import Attitude, attitude_of, directions
from torchgco.obstacles.base import Obstacles, Solids, places_of
from torchgco.obstacles.measured import Distances

if TYPE_CHECKING:
    from torchgco.constraints.base import Constraint

Chain = tuple[tuple[Attitude, Tensor], ...]
COUNTED_SHARE = 0.97  # of the largest ball along BALL_RAYS that a body holds: between two rays it may be thinner
PIECES = 4  # of a step, between which the balls move on straight lines


@dataclass(frozen=True)
class Body:
    """The shape of a vehicle: P balls at fixed places in its own frame, discs in the plane.

        car = Body([[0.3, 0], [1.3, 0], [2.3, 0]], [1.1, 1.1, 1.1])
        trees = Spheres(centers, radii, vehicle_radius=car)

    It stands where a number stands for the vehicle's radius, in obstacles of every kind: each ball then keeps clear of
    each obstacle, with center p + R(x) offset, where p is the vehicle's position. A number is a body of one ball at
    the position.

    Args:
        offsets: (P, d), the balls' centers in the vehicle's frame, from its position, m.
        radii: number or (P,), m, at least 0.
        attitude: what turns the vehicle's frame into that of space. In the plane an angle: the model's state of this
            name, rad, or of several the sum, as of joints that follow each other; "quaternion": the model's states qw,
            qx, qy, qz, in space, divided by their norm; or a function of states (..., n) that returns rotation
            matrices (..., d, d).
        box: corners (lower, upper), (d,) each, of a box that the balls cover, m, which pictures show in their place.
        parts: further bodies that hang on this one, such as a trailer or the links of an arm, each with an attitude of
            its own, by which it turns around its hinge.
        hinge: of a part, (d,): where its own frame begins in the frame of what it hangs on, m; None: where that does.

    Raises:
        InputError: offsets or radii that aren't finite numbers of these shapes, no ball, a negative radius, another
            attitude; on `Problem(...)`: a body of another space than the position's, a model without the attitude, a
            function that doesn't return rotation matrices.
    """

    offsets: Any
    radii: Any
    attitude: str | Sequence[str] | Callable[[Tensor], Tensor] = "heading"
    box: Any = None
    parts: Sequence[Body] = ()
    hinge: Any = None

    def __post_init__(self) -> None:
        offsets = numbers(self.offsets, "body.offsets")
        radii = numbers(self.radii, "body.radii")
        if offsets.dim() != 2 or offsets.shape[0] < 1 or offsets.shape[1] not in (2, 3):
            raise InputError("body.offsets", "shape (P, 2) or (P, 3) of at least one ball", tuple(offsets.shape))
        if radii.dim() == 0:
            radii = radii.expand(len(offsets))
        check_shape(radii, (len(offsets),), "body.radii")
        check_finite(offsets, "body.offsets")
        if not bool(((radii >= 0) & torch.isfinite(radii)).all()):
            raise InputError("body.radii", "finite radii of at least 0 m", radii.tolist())
        names = (self.attitude,) if isinstance(self.attitude, str) or callable(self.attitude) else self.attitude
        texts = isinstance(names, Sequence) and len(names) > 0 and all(isinstance(name, str) for name in names)
        if not texts and not callable(self.attitude):
            expected = (
                "'heading', 'quaternion', names of angles, or a function of states that returns rotation matrices"
            )
            raise InputError("body.attitude", expected, shown(self.attitude))
        check_value(self.parts, Sequence[Body], "body.parts")
        hinge = torch.zeros_like(offsets[0]) if self.hinge is None else numbers(self.hinge, "body.hinge")
        check_shape(hinge, (offsets.shape[1],), "body.hinge")
        check_finite(hinge, "body.hinge")
        object.__setattr__(self, "hinge", hinge)
        if self.box is not None:
            object.__setattr__(self, "box", _corners(self.box, offsets.shape[1]))
        object.__setattr__(self, "offsets", offsets.clone())
        object.__setattr__(self, "radii", radii.clone())

    @classmethod
    def covering(
        cls, lower: Any, upper: Any, cells: Sequence[int], attitude: str | Callable[[Tensor], Tensor] = "heading"
    ) -> Body:
        """Balls that cover a box, each one of equal cells: `covering([-0.7, -0.9], [3.3, 0.9], [6, 3])`.

        They do so where bodies touch, at `CONTACT_FACTOR` of their radii: where `judge` finds the body clear, the box
        is. The more cells, the less the body exceeds it: by a little over half a cell's diagonal less half its side.

        Args:
            lower, upper: corners of the box in the vehicle's frame, (d,), m.
            cells: how many along each axis, d whole numbers.
            attitude: as of the class.

        Raises:
            InputError: corners or counts of other shapes, a side that isn't above 0, a count below 1.
        """
        low, high = (numbers(corner, f"body.{name}") for corner, name in ((lower, "lower"), (upper, "upper")))
        check_shape(high, tuple(low.shape), "body.upper")
        if low.dim() != 1 or len(low) not in (2, 3) or not bool((high > low).all()):
            raise InputError("body.upper", "a corner (2,) or (3,) above `lower`", high.tolist())
        if len(cells) != len(low) or any(not isinstance(n, int) or n < 1 for n in cells):
            raise InputError("body.cells", f"{len(low)} whole numbers of at least 1", shown(cells))
        size = (high - low) / low.new_tensor(cells)
        each = [low[a] + size[a] * (torch.arange(n, dtype=low.dtype, device="cpu") + 0.5) for a, n in enumerate(cells)]
        return cls(torch.cartesian_prod(*each), float(0.5 * size.norm()) / CONTACT_FACTOR, attitude, (low, high))

    @property
    def inscribed_radius(self) -> float:
        """The radius of a ball about the position that the body holds, m, close to the largest; 0 if it holds none."""
        alone = float((self.radii - self.offsets.norm(dim=-1)).max())
        return max(0.0, alone, COUNTED_SHARE * float(self._way_out(directions(self.offsets.shape[1])).min()))

    @property
    def reach(self) -> float:
        """The radius of a ball about the position that holds the body, m, without parts the smallest."""
        hung = [float(part.hinge.norm()) + part.reach for part in self.parts]
        return max(float((self.radii + self.offsets.norm(dim=-1)).max()), *hung, 0.0)

    def _way_out(self, along: Tensor) -> Tensor:
        """How far rays from the position along unit vectors (R, d) stay in the body, (R,), m."""
        middle = along @ self.offsets.mT  # (R, P)
        square = self.radii.square() - self.offsets.square().sum(-1) + middle.square()
        half = square.clamp(min=0.0).sqrt()
        enter, leave = (torch.where(square >= 0, middle + sign * half, -math.inf) for sign in (-1.0, 1.0))
        reached = torch.zeros_like(middle[:, 0])
        for _ in range(len(self.radii)):  # from ball to ball, at most through all of them
            further = torch.where(enter <= reached.unsqueeze(-1), leave, 0.0).amax(-1)
            reached = torch.maximum(reached, further)
        return reached

    def around(self, obstacles: Any, dims: Dimensions) -> Constraint:
        """Obstacles (`Spheres`, ...) that have this body as their `vehicle_radius`, bound to a problem."""
        d = space_of(dims, "body.offsets")
        if self.offsets.shape[1] != d:
            got = f"{self.offsets.shape[1]}-D"
            raise InputError("body.offsets", f"{d}-D offsets, as the vehicle's position is {d}-D", got)
        if len(self.offsets) == 1 and not bool(self.offsets.any()) and not self.parts:
            return of_ball(obstacles, float(self.radii[0]), dims)
        attitude, chains = attitude_of(self.attitude, d, dims), self._chains(d, dims)
        frames = list(dict.fromkeys([attitude, *(frame for _, chain in chains for frame, _ in chain)]))
        arms = torch.zeros(len(frames), len(chains), d, dtype=torch.float64, device="cpu")
        for i, (_, chain) in enumerate(chains):
            for frame, arm in chain:
                arms[frames.index(frame), i] += arm
        offsets, *more = (arm.to(dims.like).expand(dims.B, -1, -1).contiguous() for arm in arms)
        assert dims.position is not None  # as space has d dimensions
        inner = of_ball(obstacles, self.inscribed_radius, dims)
        points = BodyPoints(offsets, attitude, dims.n, dims.position, inner.knots, tuple(more), tuple(frames[1:]))
        ball_dims = replace(dims, n=d, position=slice(0, d))
        balls = tuple(of_ball(obstacles, radius, ball_dims) for radius, _ in chains)
        return BoundBody(balls, inner, points, self.box, len(self.offsets))

    def _chains(self, d: int, dims: Dimensions, before: Chain = ()) -> list[tuple[float, Chain]]:
        """Each ball's radius, and the arms (d,) that lead to its center, each with the attitude that turns it.

        Args:
            before: the arms to where this body's frame begins.
        """
        if self.offsets.shape[1] != d:
            raise InputError("body.parts", f"{d}-D parts", f"{self.offsets.shape[1]}-D")
        frame = attitude_of(self.attitude, d, dims)
        balls = zip(self.offsets, self.radii.tolist(), strict=True)
        chains: list[tuple[float, Chain]] = [(radius, (*before, (frame, offset))) for offset, radius in balls]
        for part in self.parts:
            chains += part._chains(d, dims, (*before, (frame, part.hinge)))
        return chains


def numbers(value: Any, field: str) -> Tensor:
    """A body's own numbers, float64 on the CPU, whatever the problems' type and device are."""
    if isinstance(value, Tensor) and (value.is_floating_point() or value.dtype == torch.int64):
        value = value.to("cpu", torch.float64)
    return tensor(value, field, torch.empty(0, dtype=torch.float64, device="cpu"))


def _corners(box: Any, d: int) -> tuple[tuple[float, ...], ...]:
    """The corners of a box, as numbers."""
    if not isinstance(box, Sequence) or len(box) != 2:
        raise InputError("body.box", "two corners, (lower, upper)", shown(box))
    low, high = (numbers(corner, "body.box") for corner in box)
    shaped = low.shape == high.shape == (d,)
    if not shaped or not bool((torch.isfinite(low) & torch.isfinite(high) & (high > low)).all()):
        raise InputError("body.box", f"two finite corners ({d},), the second above the first", shown(box))
    return tuple(low.tolist()), tuple(high.tolist())


def check_no_body(problem: Any, field: str, expected: str) -> None:
    """Raise InputError naming `field` where a problem's vehicle is a body of several balls."""
    if any(obstacles.body for obstacles in problem.obstacles):
        raise InputError(field, expected, "a Body of several balls")


def of_ball(obstacles: Any, radius: float, dims: Dimensions) -> Any:
    """The same obstacles of a vehicle that is a ball, bound to a problem."""
    radii = dims.like.new_full((dims.B,), radius)  # as users' kinds may read it
    if hasattr(obstacles, "vehicle_radius"):
        return replace(obstacles, vehicle_radius=radii).bind(dims)
    return replace(obstacles, boxes=replace(obstacles.boxes, vehicle_radius=radii)).bind(dims)


@dataclass(frozen=True)
class BodyPoints(PerElement):
    """The centers of a body's balls as functions of the state."""

    offsets: Tensor  # (B, P, d), m, in the vehicle's frame
    attitude: Attitude
    n: int  # states of the model, with which those of a form of the problem begin
    position: slice
    knots: Any
    arms: tuple[Tensor, ...] = ()  # likewise in the frames of further parts, which add up
    frames: tuple[Attitude, ...] = ()

    batched: ClassVar[tuple[str, ...]] = ("offsets", "arms")

    @property
    def lengths(self) -> Tensor:
        """How far centers get from the position, at most, (B, P), m."""
        return sum((arm.norm(dim=-1) for arm in self.arms), self.offsets.norm(dim=-1))

    def at(self, x: Tensor) -> Tensor:
        """Centers (B, ..., P, d) of states (B, ..., n)."""
        x = x[..., : self.n]
        centers = x[..., None, self.position]
        for attitude, offsets in zip((self.attitude, *self.frames), (self.offsets, *self.arms), strict=True):
            aligned = offsets.view(len(offsets), *([1] * (x.dim() - 2)), *offsets.shape[1:])
            centers = centers + (attitude(x).unsqueeze(-3) * aligned.unsqueeze(-2)).sum(-1)
        return centers

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        """The same at the knots, (B, K, P d), for X (B, N+1, n), as rows of a constraint."""
        return self.at(X[:, self.knots]).flatten(-2)

    def jacobian(self, X: Tensor) -> Tensor:
        """Derivatives (B, K, P, d, n) of the centers at states X (B, K, n)."""
        (slopes,) = jacobian(lambda x: self.at(x).flatten(-2), X)
        return slopes.unflatten(-2, (self.offsets.shape[1], self.offsets.shape[2]))

    def bulge(self, X: Tensor) -> Tensor:
        """How far centers leave their chords where all frames turn evenly from each state of X (B, N+1, n) to the next,
        and the position moves straight: the sum of |arm| (1 - cos(half the turn)), (B, N, P), m."""
        bulge = torch.zeros_like(X[:, 1:, :1])
        for attitude, offsets in zip((self.attitude, *self.frames), (self.offsets, *self.arms), strict=True):
            half = (0.5 * attitude.turns(X[..., : self.n])).clamp(max=math.pi)
            bulge = bulge + (1.0 - half.cos()).unsqueeze(-1) * offsets.norm(dim=-1).unsqueeze(1)
        return bulge


@dataclass(frozen=True)
class BoundBody(Obstacles):
    """Obstacles of one kind as each ball of a body meets them: rows of the first ball, then of the second, ..."""

    balls: tuple[Obstacles, ...]  # the obstacles of each ball, whose states are its center alone
    inner: Obstacles  # those of the ball about the position that the body holds
    points: BodyPoints
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # corners of the box that the balls cover, m
    fixed: int = 0  # how many of the balls, the first, are in the vehicle's frame; others are of parts

    batched: ClassVar[tuple[str, ...]] = ("balls", "inner", "points")

    inscribed = property(lambda self: self.inner)  # type: ignore[assignment]
    body = property(lambda self: self)
    map = property(lambda self: self.inner.map)
    knots, position, dt, stops, moving = passed_on("inner", "knots", "position", "dt", "stops", "moving")
    # Of the largest ball: a length that tells the vehicle's size.
    vehicle_radius = property(lambda self: self.radii.amax(-1))  # type: ignore[assignment]
    absent = property(lambda self: self._joined("absent"))  # type: ignore[assignment]
    margins = property(lambda self: self._joined("margins"))  # type: ignore[assignment]
    contact_depths = property(lambda self: self._joined("contact_depths"))  # type: ignore[assignment]
    sizes = property(lambda self: self._joined("sizes"))  # type: ignore[assignment]
    radii = property(lambda self: torch.stack([ball.vehicle_radius for ball in self.balls], dim=-1))  # (B, P), m
    # Of the smallest ball about the position that holds the body, (B,), m.
    reach = property(lambda self: (self.points.lengths + self.radii).amax(-1))
    # How far it reaches out of the inscribed ball, (B,), m.
    overhang = property(lambda self: self.reach - self.inner.vehicle_radius)
    calls_function = property(lambda self: any(f.calls_function for f in (self.points.attitude, *self.points.frames)))

    def __repr__(self) -> str:
        return f"Body({len(self.balls)} balls among {self.inner!r})"

    def bind(self, dims: Dimensions) -> Self:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return torch.cat([ball.value(P, U) for ball, P in self.each(X)], dim=-1)

    def at(self, x: Tensor, k: int) -> Tensor:
        return torch.cat([ball.at(P, k) for ball, P in self.each(x)], dim=-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, last, d = self.points.n, X.shape[-1], self.points.offsets.shape[-1]
        slopes, P = self.points.jacobian(X[..., :n]), len(self.balls)
        parts = zip(self.each(X), g.tensor_split(P, dim=-1), h.tensor_split(P, dim=-1), strict=True)
        for i, ((ball, p), g_i, h_i) in enumerate(parts):
            at_ball = H.new_zeros(*X.shape[:2], d + 1, d + 1)
            ball.accumulate(p, U[..., :0], g_i, h_i, at_ball)
            J = slopes[:, :, i]
            gradient = (at_ball[..., d : d + 1, :d] @ J).squeeze(-2)
            H[..., :n, last] += gradient
            H[..., last, :n] += gradient
            H[..., :n, :n] += J.mT @ at_ball[..., :d, :d] @ J

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Depth beneath the full surfaces, (B, K, P M), m."""
        return torch.cat([ball.violation(P, U) for ball, P in self.each(X)], dim=-1)

    def distances(self, X: Tensor) -> Tensor:
        return torch.cat([ball.distances(P) for ball, P in self.each(X)], dim=-1)

    def distances_of(self, X: Tensor, t: Tensor) -> Tensor:
        return torch.cat([ball.signed_distance(P, t) for ball, P in self.each(X)], dim=-1)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        raise InputError("body", "states, whose `distances` are measured", "positions alone, which have no attitude")

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        raise InputError("body", "states, whose `chord_clearance` is measured", "positions alone")

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        """As of all obstacles, of states that change evenly between the knots."""
        near = self._nearest(X, share)
        chosen, X = (self if near is None else self.chosen(near)).finer(X)
        by_ball = [ball.chord_clearance(P, share) for ball, P in chosen.each(X)]
        return (torch.stack(by_ball, dim=-1) - chosen.points.bulge(X).amax(1)).amin(-1)

    def places(self, X: Tensor) -> Tensor:
        return self.points.at(X)

    def even_bulge(self, X: Tensor) -> Tensor:
        return self.points.bulge(X)

    def measured(self, X: Tensor) -> Distances:
        at_knots, ways = zip(*(ball.measured(P) for ball, P in self.each(X)), strict=True)
        return torch.cat(at_knots, dim=-1), torch.cat(ways, dim=-1)

    def clearances(self, X: Tensor) -> Distances:
        """As of all obstacles, between the knots from states a part of a step apart, which change evenly."""
        fine, states = self.finer(X)
        bulge = fine.points.bulge(states).amax(1)
        at_knots = torch.stack([ball.clearances(P)[0] for ball, P in self.each(X)]).amin(0)
        ways = [ball.clearances(P)[1] - bulge[:, i] for i, (ball, P) in enumerate(fine.each(states))]
        return at_knots, torch.minimum(at_knots, torch.stack(ways).amin(0))

    def _nearest(self, X: Tensor, share: float | None) -> Tensor | None:
        """Places (B, M') of those that may be the nearest to a ball on its way along X; None of a kind that can't say.

        A ball is no farther from an obstacle than at a knot, and no nearer than its reach around the position is.
        """
        inner, p = self.inner, X[..., self.position]
        bars = inner.moving or inner.stops is not None or inner.absent.numel() == 0
        if bars or type(inner).chosen is Obstacles.chosen:
            return None
        out = self.points.lengths
        away = inner.signed_distance(p, p.new_zeros(p.shape[1])).amin(1) + inner.vehicle_radius.unsqueeze(-1)  # (B, M)
        half = 0.5 * p.diff(dim=1).norm(dim=-1).amax(-1)  # a point of the way is so near to a knot
        least = away - ((out + self.radii).amax(-1) + half).unsqueeze(-1)
        deep = self.beneath(share).unflatten(-1, (len(self.balls), -1)).amax(1)
        most = away + deep + (out - self.radii).amin(-1).unsqueeze(-1)
        limit = most.amin(-1) + self.points.bulge(X).flatten(1).amax(-1)
        kept = ~(least > limit.unsqueeze(-1)) & ~inner.absent  # NaN may be near
        return places_of(kept)

    def finer(self, X: Tensor) -> tuple[BoundBody, Tensor]:
        """The same obstacles for X (B, PIECES N + 1, n), with `PIECES` steps in place of each of X (B, N+1, n).

        Between two knots the states change evenly.
        """
        share = torch.arange(PIECES, dtype=X.dtype, device=X.device).view(1, 1, -1, 1) / PIECES
        within = torch.lerp(X[:, :-1].unsqueeze(2), X[:, 1:].unsqueeze(2), share).flatten(1, 2)
        return self.in_pieces(PIECES), torch.cat((within, X[:, -1:]), dim=1)

    def in_pieces(self, count: int) -> Self:
        return self._of_each(lambda ball: ball.in_pieces(count))

    def start_is_clear(self, x0: Tensor) -> Tensor:
        return torch.stack([ball.start_is_clear(P) for ball, P in self.each(x0)]).all(0)

    def each(self, x: Tensor) -> list[tuple[Obstacles, Tensor]]:
        """The obstacles of each ball, and its centers (B, ..., d) as the states that they read."""
        centers = self.points.at(x)
        return [(ball, centers[..., i, :]) for i, ball in enumerate(self.balls)]

    def inflated(self) -> Solids | None:
        """The obstacles that the inscribed ball meets: a search for paths takes the body for that."""
        return self.inner.inflated()

    def chosen(self, at: Tensor) -> Self:
        """With the obstacles at places (B, M') alone, of all balls."""
        return self._of_each(lambda ball: ball.chosen(at))

    @property
    def kernel(self) -> str:
        """A function where its balls are of no other kind: C traces where they are, and computes their rows itself."""
        return "function" if self.balls[0].kernel == "function" else "body"

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        first, *more = self.balls
        of_ball = first.lowered(n, more)
        return replace(of_ball, plain={**of_ball.plain, "balls": len(self.balls)})

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return "ball {}, obstacle {}".format(*divmod(row, self.inner.absent.shape[1]))

    def by_obstacle(self, rows: Tensor) -> Tensor:
        return rows.unflatten(-1, (len(self.balls), -1)).any(-2)

    def numbers(self, where: str, index: int) -> list[Number]:
        return self.inner.numbers_of(where, index, self.balls)

    def remade(self) -> Self:
        return self._of_each(lambda ball: ball.remade())

    def grown(self, by: Tensor) -> Self:
        return self._of_each(lambda ball: ball.grown(by))

    def later(self, t: float) -> Self:
        return self._of_each(lambda ball: ball.later(t))

    def stopping_at(self, knots: Tensor) -> Self:
        return self._of_each(lambda ball: ball.stopping_at(knots))

    def with_step(self, dt: float) -> Self:
        return self._of_each(lambda ball: ball.with_step(dt))

    def with_knots(self, knots: slice) -> Self:
        points = replace(self.points, knots=knots)
        return replace(self._of_each(lambda ball: ball.with_knots(knots)), points=points)

    def _of_each(self, change: Callable[[Any], Any]) -> Self:
        return replace(self, balls=tuple(map(change, self.balls)), inner=change(self.inner))

    def _joined(self, name: str) -> Tensor:
        return torch.cat([getattr(ball, name) for ball in self.balls], dim=-1)
