"""Gates as the page draws them: rings across the way, and the frames of squares."""

from __future__ import annotations

import numpy as np

from torchgco.constraints.gates import GateSquares, gates_of
from torchgco.problem.problem import Problem
from torchgco.view.packing import number

CORNERS = 32  # of a ring


def outlines_of(problem: Problem, b: int) -> list[list[list[float | None]]]:
    """Closed lines, each a list of corners (d,), m, of the gates of problem b in their order."""
    gates = gates_of(problem)
    if gates is None:
        return []
    centers, sizes = (part[b].detach().cpu().double().numpy() for part in (gates.centers, gates.sizes))
    if isinstance(gates, GateSquares):
        found = [_square(*one) for one in zip(centers, sizes, gates.axes[b].cpu().double().numpy(), strict=True)]
    else:
        start = problem.x0[b, problem.position].detach().cpu().double().numpy()
        end = centers[-1] if problem.goal is None else problem.goal.position[b].detach().cpu().double().numpy()
        stops = np.concatenate((start[None], centers, end[None]))
        found = [_ring(*one) for one in zip(centers, sizes, stops[2:] - stops[:-2], strict=True)]
    return [[[number(value) for value in corner] for corner in outline] for outline in found]


def _ring(center: np.ndarray, radius: float, along: np.ndarray) -> np.ndarray:
    """Corners (V, d) of a circle; in space across the direction `along`."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    if len(center) == 2:
        return center + radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    size = np.linalg.norm(along)
    normal = along / size if size > 0 else np.array([1.0, 0.0, 0.0])
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    return center + radius * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(normal, side))


def _square(center: np.ndarray, half: float, axes: np.ndarray) -> np.ndarray:
    """Corners (V, d) of a square whose sides are the rows of axes (d, d) after the first; in the plane both ends."""
    if len(center) == 2:
        return center + half * np.array([[-1.0], [1.0]]) * axes[1]
    return center + half * (np.array([[-1.0, -1], [-1, 1], [1, 1], [1, -1]]) @ axes[1:])
