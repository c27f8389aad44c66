"""Pictures of layouts with trajectories that are straight from knot to knot."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchgco.plotting import layouts as drawing
from torchgco.plotting import scene as scenes
from torchgco.plotting import study_figure as printed
from torchgco.plotting.ways import Way


def ways(states: Any, dt: float = 0.0) -> list[Way]:
    """States (L, N+1, n) with dt seconds between knots."""
    counts = [np.arange(len(X)) for X in states]
    none = np.empty((0, 0))
    return [Way(k, dt * k, np.asarray(X, float), (), 1, none) for k, X in zip(counts, states, strict=True)]


def _of(layouts: Mapping[str, np.ndarray], states: Mapping[str, Any]) -> dict[str, list[Way]]:
    return {name: ways(X, float(layouts.get("dt", 0.0))) for name, X in states.items()}


def layout_grid(layouts: Mapping[str, np.ndarray], states: Mapping[str, Any], *words: Any, **more: Any) -> Figure:
    return drawing.layout_grid(layouts, _of(layouts, states), *words, **more)


def study_figure(layouts: Mapping[str, np.ndarray], states: Mapping[str, Any], *words: Any, **more: Any) -> Figure:
    return printed.study_figure(layouts, _of(layouts, states), *words, **more)


def contacts(scene: scenes.Scene, i: int, path: np.ndarray, dt: float = 0.5) -> np.ndarray:
    return scenes.contacts(scene, i, path, dt * np.arange(len(path)))
