"""A vehicle's body of balls, as pictures show it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from scipy.spatial import ConvexHull

from torchgco.obstacles.body import BoundBody
from torchgco.plotting.bodies import RAYS, Plane
from torchgco.problem.problem import Problem

DRAWN = 9  # knots of a trajectory at which a body is drawn


@dataclass(frozen=True, eq=False)
class VehicleBody:
    """The balls of a vehicle, and the box that the first of them cover, where there is one; lengths in metres."""

    bound: BoundBody

    @classmethod
    def of(cls, problem: Problem) -> VehicleBody | None:
        """That of the first obstacles whose vehicle has one; None where it is a ball."""
        return next((cls(obstacles.body) for obstacles in problem.obstacles if obstacles.body is not None), None)

    @property
    def offsets(self) -> np.ndarray:
        """Of the balls fixed to its frame, (P, d)."""
        return self.bound.points.offsets[0, : self.bound.fixed].cpu().double().numpy()

    @property
    def radii(self) -> np.ndarray:
        """Of all balls, (P,)."""
        return self.bound.radii[0].cpu().double().numpy()

    @property
    def box(self) -> np.ndarray | None:
        """Two corners of the box that is covered, (2, d)."""
        return None if self.bound.box is None else np.array(self.bound.box)

    @property
    def reach(self) -> float:
        """Radius of the ball about the position that holds all of it."""
        return float(self.bound.reach[0])

    @property
    def inner(self) -> float:
        """Radius of the ball about the position that it holds."""
        return float(self.bound.inner.vehicle_radius[0])

    def balls(self, X: np.ndarray) -> np.ndarray:
        """Centers (K, P, d) of the balls in states X (K, n)."""
        here = torch.tensor([0], device=self.bound.points.offsets.device)
        return self.bound.points.take(here).at(self._states(X))[0].cpu().numpy()

    def rotations(self, X: np.ndarray) -> np.ndarray:
        """Rotations (K, d, d) of its frame in states X (K, n)."""
        points = self.bound.points
        return points.attitude(self._states(X)[..., : points.n])[0].cpu().double().numpy()

    def extent(self, X: np.ndarray) -> np.ndarray:
        """Points (., d) between which all of it lies in states X (K, n)."""
        centers, radii = self.balls(X), self.radii[:, None]
        return np.concatenate([(centers + sign * radii).reshape(-1, centers.shape[-1]) for sign in (-1.0, 1.0)])

    def outlines(self, X: np.ndarray, plane: Plane) -> list[np.ndarray]:
        """Outlines (., 2) in states X (K, n): of the box that is covered, and of each other ball."""
        boxed = 0 if self.box is None else self.bound.fixed
        rings = self.balls(X)[:, boxed:, None, list(plane)] + self.radii[boxed:, None, None] * RAYS
        balls = list(rings.reshape(-1, *RAYS.shape))
        if self.box is None:
            return balls
        corners = np.array(list(product(*self.box.T)))
        places = np.asarray(X)[:, None, self.bound.position] + (self.rotations(X) @ corners.T).swapaxes(-1, -2)
        seen = [vertices[:, list(plane)] for vertices in places]
        return [*(points[ConvexHull(points).vertices] for points in seen), *balls]

    def draw(self, ax: Axes, X: np.ndarray, plane: Plane, colour: Any, zorder: float = 2.8) -> None:
        """Draw it at some of the states X (K, n), the first and the last among them."""
        knots = np.unique(np.linspace(0, len(X) - 1, min(len(X), DRAWN)).round().astype(int)) if len(X) else []
        look: dict[str, Any] = {"facecolor": "none", "edgecolor": colour, "linewidth": 0.7, "alpha": 0.7}
        if self.box is not None:
            look = {"facecolor": (*to_rgb(colour), 0.06), "edgecolor": (*to_rgb(colour), 0.75), "linewidth": 0.9}
        ax.add_collection(PolyCollection(self.outlines(np.asarray(X)[knots], plane), zorder=zorder, **look), False)

    def _states(self, X: np.ndarray) -> torch.Tensor:
        offsets = self.bound.points.offsets
        return torch.as_tensor(np.array(X, dtype=float), dtype=offsets.dtype, device=offsets.device).unsqueeze(0)
