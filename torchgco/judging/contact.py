"""Where trajectories touch obstacles, by the distances of judge and certificate: what pictures mark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.maps.distance import DistanceField
from torchgco.maps.measured import path_distances
from torchgco.obstacles.base import ADMITTED, Obstacles

BETWEEN = 4  # pieces of a stage, each of which has a contact of its own or none
SAME_DEPTH = 1e-9  # m: depths that differ less are one, as of a way through equal cells


def contacts(
    obstacles: Sequence[Obstacles], path: np.ndarray, dt: float, states: np.ndarray | None = None
) -> np.ndarray:
    """Places (C, d) where a path (K, d), m, touches obstacles of a batch of one: the deepest of each contact.

    Bodies touch where the judge has it; between the knots, `dt` seconds apart, the path is straight, and the states
    (K, n) change evenly, which the attitude of a `Body` depends on.

    Raises:
        InputError: a body without states.
    """
    places, _ = pieces(path)
    depth = np.full(max(len(places) - 1, 0), -np.inf)
    for obstacle in obstacles if len(places) else ():
        along = None
        if obstacle.body is not None:
            if states is None:
                raise InputError("states", "those of a body's attitude", "none")
            along = pieces(states)[0]
        depth = np.maximum(depth, _depth(obstacle, places, dt / BETWEEN if len(path) > 1 else 0.0, along))
    return deepest(places, depth)


def pieces(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ends (P+1, d) of the pieces of a path (K, d), and which knots they are, (P+1,), whole numbers at knots.

    The path of a single knot is one piece without length.
    """
    path = np.array(path, dtype=float)  # a table's own array may not be written to, which PyTorch warns of
    if len(path) == 1:
        return path.repeat(2, axis=0), np.zeros(2)
    knots = np.linspace(0, len(path) - 1, BETWEEN * (len(path) - 1) + 1) if len(path) else np.zeros(0)
    columns = [np.interp(knots, np.arange(len(path)), column) for column in path.T] if len(path) else path.T
    return np.stack(list(columns), axis=-1), knots


def map_depth(field: DistanceField, places: np.ndarray, radius: float) -> np.ndarray:
    """How deep (P,), m, a vehicle of this radius is in contact with a map on the pieces between places (P+1, d)."""
    return radius - ADMITTED - path_distances(field, 0, torch.from_numpy(places)).numpy()


def deepest(places: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The deepest places (C, d) of each run of pieces, with ends (P+1, d), whose depth (P,) is above 0."""
    middle, touching = 0.5 * (places[1:] + places[:-1]), np.flatnonzero(depth > 0)
    runs = np.split(touching, np.flatnonzero(np.diff(touching) > 1) + 1)
    points = [middle[run[depth[run] > depth[run].max() - SAME_DEPTH]].mean(axis=0) for run in runs if len(run)]
    return np.array(points).reshape(-1, places.shape[1])


def _depth(obstacle: Obstacles, places: np.ndarray, dt: float, states: np.ndarray | None) -> np.ndarray:
    """How deep (P,), m, the pieces between places (P+1, d), `dt` seconds apart, are in contact with a part.

    Args:
        states: (P+1, n) there, of which the places are a part; None: only places are known.
    """
    timed = obstacle.with_step(dt) if obstacle.moving else obstacle
    X = torch.zeros(len(places), obstacle.position.stop, dtype=torch.float64, device="cpu")
    X[:, obstacle.position] = torch.from_numpy(places)
    if states is not None:
        X = torch.from_numpy(np.array(states, dtype=float))
    beneath = _beneath(timed, X) - obstacle.contact_depths[0].double().cpu()
    beneath = beneath.masked_fill(obstacle.absent[0].cpu(), -torch.inf)
    return beneath.amax(-1).numpy() if beneath.shape[-1] else np.full(len(places) - 1, -np.inf)


def _beneath(body: Obstacles, X: Tensor) -> Tensor:
    """The same (P, M) beneath the full surfaces; of a kind that can't be judged, by its own distances at the ends."""
    X = X.to(body.vehicle_radius.device, body.vehicle_radius.dtype)
    try:
        ways, bulge = body.measured(X.unsqueeze(0))[1][0], body.even_bulge(X.unsqueeze(0))[0]
        gaps = (ways.unflatten(-1, (bulge.shape[-1], -1)) - bulge.unsqueeze(-1)).flatten(1)
    except InputError:
        ends = body.signed_distance(X[None, :, body.position], body.dt * torch.arange(len(X), device="cpu").to(X))[0]
        gaps = torch.minimum(ends[:-1], ends[1:])
    return -gaps.detach().double().cpu()
