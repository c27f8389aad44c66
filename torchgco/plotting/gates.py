"""Gates in pictures: circles, and squares seen from above or from the side."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from torchgco.constraints.gates import GateBalls, GateSquares, gates_of
from torchgco.plotting.style import INK
from torchgco.problem.problem import Problem

Outline = tuple[np.ndarray, float]  # corners (V, d), m; one corner and a radius of a ball


def outlines(problem: Problem, b: int) -> list[Outline]:
    """The gates of problem b, in their order."""
    gates = gates_of(problem.take(torch.tensor([b], device=problem.x0.device)))
    if gates is None:
        return []
    centers, sizes = (array[0].detach().cpu().double().numpy() for array in (gates.centers, gates.sizes))
    if isinstance(gates, GateBalls):
        return [(center[None], float(size)) for center, size in zip(centers, sizes, strict=True)]
    assert isinstance(gates, GateSquares)
    axes, shapes = gates.axes[0].cpu().double().numpy(), []
    for center, size, directions in zip(centers, sizes, axes, strict=True):
        signs = np.array([s for s in product((-1.0, 1.0), repeat=len(directions) - 1)])
        if len(directions) == 3:
            signs = signs[[0, 1, 3, 2]]  # around the square
        shapes.append((center + size * signs @ directions[1:], 0.0))
    return shapes


def draw_gates(ax: Axes, gates: list[Outline], plane: tuple[int, int]) -> None:
    """Draw them with their numbers; gates at one place are one gate with several."""
    numbers = dict[tuple[bytes, float], list[int]]()
    for number, (corners, radius) in enumerate(gates, start=1):
        numbers.setdefault((corners.tobytes(), radius), []).append(number)
    for group in numbers.values():
        corners, radius = gates[group[0] - 1]
        seen = corners[:, list(plane)]
        if radius > 0:
            ax.add_patch(Circle((seen[0, 0], seen[0, 1]), radius, fill=False, color=INK, linewidth=1.2, zorder=3))
        else:
            ax.add_patch(Polygon(seen, closed=True, fill=False, color=INK, linewidth=1.6, zorder=3))
        ax.annotate(
            ", ".join(map(str, group)),
            seen.max(axis=0),
            fontsize=7,
            color=INK,
            xytext=(2, 2),
            textcoords="offset points",
        )
