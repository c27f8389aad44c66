"""A vehicle with a `Body` as maps show it: the box that its balls cover, else the balls."""

from __future__ import annotations

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


def body_of(problem: Problem) -> BoundBody | None:
    """Obstacles whose vehicle is a body, the first ones; None where there are none."""
    return next((obstacles.body for obstacles in problem.obstacles if obstacles.body is not None), None)


def balls_at(body: BoundBody, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centers (K, P, d) and radii (P,) of the balls in states X (K, n), m."""
    offsets = body.points.offsets
    centers = body.points.take(torch.tensor([0], device=offsets.device)).at(_states(body, X))[0]
    return centers.cpu().numpy(), body.radii[0].cpu().double().numpy()


def extent(body: BoundBody, X: np.ndarray) -> np.ndarray:
    """Points (., d), m, between which all of the body in states X (K, n) lies."""
    centers, radii = balls_at(body, X)
    return np.concatenate([(centers + sign * radii[:, None]).reshape(-1, centers.shape[-1]) for sign in (-1.0, 1.0)])


def silhouettes(body: BoundBody, X: np.ndarray, plane: Plane) -> list[np.ndarray]:
    """Outlines (., 2), m, of the body in states X (K, n): of the box that is covered, and of each other ball."""
    (centers, radii), boxed = balls_at(body, X), 0 if body.box is None else body.fixed
    rings = centers[:, boxed:, None, list(plane)] + radii[boxed:, None, None] * RAYS
    balls = list(rings.reshape(-1, *RAYS.shape))
    if body.box is None:
        return balls
    corners = np.array(list(product(*zip(*body.box, strict=True))))
    turned = rotations(body, X) @ corners.T
    places = np.asarray(X)[:, None, body.position] + turned.swapaxes(-1, -2)
    seen = [vertices[:, list(plane)] for vertices in places]
    return [*(points[ConvexHull(points).vertices] for points in seen), *balls]


def rotations(body: BoundBody, X: np.ndarray) -> np.ndarray:
    """Rotations (K, d, d) of the vehicle's frame in states X (K, n)."""
    return body.points.attitude(_states(body, X)[..., : body.points.n])[0].cpu().double().numpy()


def draw_body(ax: Axes, body: BoundBody, X: np.ndarray, plane: Plane, colour: Any, zorder: float = 2.8) -> None:
    """Draw the body at some of the states X (K, n), the first and the last among them."""
    knots = np.unique(np.linspace(0, len(X) - 1, min(len(X), DRAWN)).round().astype(int)) if len(X) else []
    look: dict[str, Any] = {"facecolor": "none", "edgecolor": colour, "linewidth": 0.7, "alpha": 0.7}
    if body.box is not None:
        look = {"facecolor": (*to_rgb(colour), 0.06), "edgecolor": (*to_rgb(colour), 0.75), "linewidth": 0.9}
    ax.add_collection(PolyCollection(silhouettes(body, np.asarray(X)[knots], plane), zorder=zorder, **look), False)


def _states(body: BoundBody, X: np.ndarray) -> torch.Tensor:
    offsets = body.points.offsets
    return torch.as_tensor(np.array(X, dtype=float), dtype=offsets.dtype, device=offsets.device).unsqueeze(0)
