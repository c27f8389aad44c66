"""Layouts in the form that a map shows: seen from above, with every optional array filled in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchgco.plotting.boxes import Outline, outlines

Arrays = Mapping[str, np.ndarray]
SLACK = 0.5  # share of the scene's size by which paths may widen the map


@dataclass(frozen=True, eq=False)
class Scene:
    """L layouts from above, lengths in metres, nan rows for obstacles that are absent.

    centers   (L, M, 2); radii (L, M); heights (L, M) or None in the plane
    drift     (L, M, 2) displacement of each obstacle during the flight, 0 at rest
    start, goal
              (L, 2), nan where unknown
    margin    the vehicle's radius; goal_radius: nan where unknown
    ids       (L,) index of each layout in its file or generator
    boxes     the boxes present in each layout
    """

    centers: np.ndarray
    radii: np.ndarray
    heights: np.ndarray | None
    drift: np.ndarray
    start: np.ndarray
    goal: np.ndarray
    margin: float
    goal_radius: float
    ids: np.ndarray
    boxes: tuple[tuple[Outline, ...], ...]

    def shown_heights(self, count: int) -> np.ndarray:
        """Heights of all obstacles of the first `count` layouts, m; none in the plane."""
        if self.heights is None:
            return np.empty(0)
        boxes = [box.height for layout in self.boxes[:count] for box in layout]
        return np.concatenate([self.heights[:count][np.isfinite(self.heights[:count])], boxes])


def scene_of(layouts: Arrays, stages: int) -> Scene:
    """The scene of all layouts in the arrays of a layout file, for flights of N = `stages`.

    Without `dt` obstacles are drawn where they start, as it isn't known how far they move.
    """
    centers, radii = np.asarray(layouts["centers"], dtype=float), np.asarray(layouts["radii"], dtype=float)
    count = len(radii)
    duration = stages * float(layouts.get("dt", 0.0))
    velocities = np.asarray(layouts.get("velocities", np.zeros_like(centers)), dtype=float)

    def point(name: str) -> np.ndarray:
        states = np.asarray(layouts.get(name, np.full(2, np.nan)), dtype=float)
        return np.broadcast_to(states[..., :2], (count, 2))

    return Scene(
        centers=centers[..., :2],
        radii=radii,
        heights=centers[..., 2] if centers.shape[2] == 3 else None,
        drift=np.nan_to_num(velocities[..., :2]) * duration,
        start=point("start"),
        goal=point("goal"),
        margin=float(layouts.get("vehicle_radius", 0.0)),
        goal_radius=float(layouts.get("goal_radius", np.nan)),
        ids=np.asarray(layouts.get("layout", np.arange(count))),
        boxes=tuple(outlines(layouts, i) for i in range(count)),
    )


def map_box(scene: Scene, paths: list[np.ndarray], count: int) -> np.ndarray:
    """Lower and upper corner (2, 2), m, of a map of the first `count` layouts and their paths (N+1, 2).

    Starts, goals and obstacles make the scene. Paths widen it, but only by half its size: a diverged one would
    otherwise shrink all the rest to a dot.
    """
    outer = (scene.radii + scene.margin)[:count, :, None]
    centers = scene.centers[:count]
    ring = np.nan_to_num(scene.goal_radius)
    ends = [scene.start[:count], scene.goal[:count] - ring, scene.goal[:count] + ring]
    boxes = [box.grown(scene.margin) for layout in scene.boxes[:count] for box in layout]
    corners = _corners([(centers - outer).reshape(-1, 2), (centers + outer).reshape(-1, 2), *ends, *boxes])
    if corners is None:
        corners = _corners(paths)
    if corners is None:
        return np.array([[0.0, 0.0], [1.0, 1.0]])
    size = max(corners[1] - corners[0])
    reach = _corners([*paths, corners])
    assert reach is not None
    box = np.clip(reach, corners[0] - SLACK * size, corners[1] + SLACK * size)
    return box + 0.04 * size * np.array([[-1.0], [1.0]])


def _corners(points: list[np.ndarray]) -> np.ndarray | None:
    """Lower and upper corner of the finite ones among (., 2) points; None if there are none."""
    held = np.concatenate(points) if points else np.empty((0, 2))
    finite = held[np.isfinite(held).all(axis=1)]
    return np.stack([finite.min(axis=0), finite.max(axis=0)]) if len(finite) else None
