"""Gates as the page draws them: rings across the way, and the frames of squares."""

from __future__ import annotations

import numpy as np

from torchgco.plotting.gates import outlines
from torchgco.problem.problem import Problem
from torchgco.view.packing import number

CORNERS = 32  # of a ring


def outlines_of(problem: Problem, b: int) -> list[list[list[float | None]]]:
    """Closed lines, each a list of corners (d,), m, of the gates of problem b in their order."""
    gates = outlines(problem, b)
    start = problem.x0[b, problem.position].detach().cpu().double().numpy()
    centers = [corners.mean(axis=0) for corners, _ in gates]
    ends = centers[-1:] if problem.goal is None else [problem.goal.position[b].detach().cpu().double().numpy()]
    ways = [after - before for before, after in zip([start, *centers], [*centers[1:], *ends], strict=False)]
    rows = zip(gates, centers, ways, strict=True)
    found = [_ring(center, radius, way) if radius > 0 else corners for (corners, radius), center, way in rows]
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
