"""Which flights pass around all obstacles instead of between them, for the line below a figure of layouts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from torchgco.plotting.scene import Scene

PLANES = 4096  # of which one may separate a piece of a path from the obstacles
GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)


def around_words(scene: Scene, reached: Mapping[str, Iterable[tuple[int, np.ndarray]]]) -> str:
    """How many of the flights that reach the goal pass around all obstacles, on how long ways; "" where none does.

    Args:
        reached: by solver, the numbers of layouts that it reached and its paths (K, d) through them.
    """
    counts, detours = list[str](), list[float]()
    for solver, flights in reached.items():
        flown = list(flights)
        around = [path for i, path in flown if passes_around(scene, i, path)]
        counts += [f"{solver} in {len(around)} of {len(flown)}"] if around else []
        detours += [100.0 * (_length(path) / _length(path[[0, -1]]) - 1.0) for path in around]
    if not counts:
        return ""
    least, most = f"{min(detours):.0f}", f"{max(detours):.0f}"
    longer = least if least == most else f"{least} to {most}"
    return (
        f"Around all obstacles, outside of their convex hull: {', '.join(counts)} flights that reach the goal, on ways "
        f"{longer} % longer than straight lines."
    )


def passes_around(scene: Scene, i: int, path: np.ndarray) -> bool:
    """Whether a path (K, d) stays outside of the convex hull of the obstacles of layout i, several that rest.

    It does where each piece has both ends beyond a plane that all obstacles are behind. A finite number of planes is
    tried: no path through the hull is taken for one around it, but one that nearly touches it may be missed.
    """
    solids = scene.bodies[i]
    # Whoever passes a single obstacle flies around it, and what moves has no hull.
    if len(solids) < 2 or scene.map_of(i) is not None or scene.others(i) or any(body.moving for body in solids):
        return False
    normals = _directions(scene.dimension)
    reach = np.max([(body.corners @ normals.T).max(axis=0) + body.radius for body in solids], axis=0)
    beyond = path @ normals.T > reach
    return bool((beyond[:-1] & beyond[1:]).any(axis=1).all())


def _length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _directions(dimension: int) -> np.ndarray:
    """Unit vectors (PLANES, d), evenly spread: in space along a spiral from one pole to the other."""
    k = np.arange(PLANES)
    if dimension == 2:
        angle = 2.0 * np.pi * k / PLANES
        return np.column_stack([np.cos(angle), np.sin(angle)])
    z = 1.0 - (2.0 * k + 1.0) / PLANES
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(GOLDEN_ANGLE * k), across * np.sin(GOLDEN_ANGLE * k), z])
