"""The interface of all kinds of obstacles: distances of the vehicle from them, for solver, search and polish."""

from __future__ import annotations

import warnings
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torchgco.base.errors import ScaleWarning
from torchgco.constraints.base import Constraint, Sense
from torchgco.obstacles.box_geometry import Cuboids

CONTACT_FACTOR = 0.95  # bodies touch at this share of r_obs + r_veh; planners keep the full distance (Table 3)


ADMITTED = 1e-3  # m: the violation up to which solvers and judge call a trajectory feasible, unless options say else


class Inflated(NamedTuple):
    """Static obstacles grown by the vehicle's radius, in the forms that the roadmap knows."""

    centers: Tensor  # (B, M, d) of spheres, m
    inflated_radii: Tensor  # (B, M): r_obs + r_veh, m; negative where absent
    boxes: Cuboids | None = None


class Obstacles(Constraint):
    """Obstacles that the vehicle's position keeps clear of, M per problem, once bound.

    Each kind of obstacles is a subclass, which defines a constraint's methods and the abstract ones below. Distances
    count from the full surface, the obstacle's own grown by the vehicle's radius: positive outside, negative inside,
    infinite where an obstacle is absent. The judge and the certificate measure distances by separate code; a new kind
    is added to it in `judge.CLEARANCES` and `certificate.CHORDS`.
    """

    sense: ClassVar[Sense] = "inequality"
    geometric: ClassVar[bool] = True

    centers: Tensor  # (B, M, d) at t = 0, m
    absent: Tensor  # (B, M) bool
    vehicle_radius: Tensor  # (B,), m
    position: slice
    dt: float

    @property
    def moving(self) -> bool:
        """Whether any of them may move."""
        return False

    @property
    def margins(self) -> Tensor:
        """Lengths (B, M), m: bodies touch at (1 - CONTACT_FACTOR) times these beneath the full surface."""
        raise NotImplementedError

    @property
    def sizes(self) -> Tensor:
        """The smallest distance from an obstacle's centre to its full surface, (B, M), m."""
        return self.margins

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        """Distances (B, K, M), m, of points p (B, K, d), m, at times t (K,), s."""
        raise NotImplementedError

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        """Smallest distances (B, E, M), m, of the straight segments from a to b (B, E, d), from obstacles at t = 0.

        A lower bound will do where it exceeds the smallest of the problem by more than its largest margin.
        """
        raise NotImplementedError

    def inflated(self) -> Inflated | None:
        """The obstacles in the roadmap's form; None where it has no form for them, and no path is sought."""
        return None

    def chord_clearance(self, X: Tensor) -> Tensor:
        """Smallest distance (B,) from the straight lines between knots to where bodies touch, m; negative in contact.

        Infinite where there is no obstacle. Obstacles that move override this.
        """
        p = X[..., self.position]
        touch = (1.0 - CONTACT_FACTOR) * self.margins
        return least(self.segment_clearance(p[:, :-1], p[:, 1:]) + touch.unsqueeze(1))

    def start_is_clear(self, x0: Tensor) -> Tensor:
        """False where the vehicle touches an obstacle at the start, (B,)."""
        distance = self.signed_distance(x0[:, None, self.position], x0.new_zeros(1))[:, 0]
        return (distance >= (CONTACT_FACTOR - 1.0) * self.margins).all(-1)

    def times(self, X: Tensor) -> Tensor:
        """t = k dt (K,) at the constraint's knots, s."""
        return torch.arange(X.shape[1], dtype=X.dtype, device=X.device)[self.knots] * self.dt


def warn_of_small(obstacles: Obstacles, field: str) -> None:
    """A ScaleWarning where an admitted violation is over 5 % of an obstacle's size: lengths may not be in metres."""
    sizes = obstacles.sizes[~obstacles.absent]
    sizes = sizes[sizes > 0]  # a point that is marked, not an obstacle
    if sizes.numel() > 0 and (1.0 - CONTACT_FACTOR) * float(sizes.min()) < ADMITTED:
        text = f"an obstacle of {float(sizes.min()):.3g} m is too small for violations of up to {ADMITTED:g} m"
        text += ", which count as feasible: scale the problem, or are its lengths not in metres?"
        warnings.warn(f"{field}: {text}", ScaleWarning, stacklevel=6)


def least(distances: Tensor) -> Tensor:
    """The smallest of distances (B, K, M) per problem, (B,); infinite where there is none."""
    if distances.shape[1] == 0 or distances.shape[2] == 0:
        return distances.new_full(distances.shape[:1], torch.inf)
    return distances.flatten(1).amin(-1)
