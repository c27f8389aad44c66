"""Maps of space seen from above, as maps of the plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.maps.files import samples
from torchgco import InputError
from torchgco.maps import OccupancyGrid, PointCloud, read


def grid_of(folder: Path, occupied: np.ndarray, layer: Any) -> OccupancyGrid:
    raw = samples.npz(occupied=occupied, origin=[1.0, 2.0, -1.0])
    grid = read(samples.write(folder, "grid.npz", raw), layer=layer)
    assert isinstance(grid, OccupancyGrid)
    return grid


@pytest.mark.parametrize(("layer", "shown"), [
    ((-1, 0), [1, 1, 0]), ((-0.9, -0.6), [1, 0, 0]), ((-0.4, 0.1), [0, 1, 1]), ((0.0, 9), [0, 0, 1]),
    ((-0.5, 0), [0, 1, 0]),
])  # fmt: skip
def test_cells_that_touch_the_layer(layer: tuple[float, float], shown: list[int], tmp_path: Path) -> None:
    """Three columns from -1 m, of which the lowest, middle or highest half metre is occupied."""
    grid = grid_of(tmp_path, np.eye(3, dtype=bool)[:, None], layer)
    assert grid.occupied[:, 0].tolist() == shown and grid.origin.tolist() == [1, 2] and grid.resolution == 0.5


def test_unknown_is_worse_than_free(tmp_path: Path) -> None:
    cells = np.array([[[0.0, np.nan]], [[np.nan, 0.9]], [[0.2, 0.4]]])
    np.testing.assert_allclose(grid_of(tmp_path, cells, (-1, 0)).occupied[:, 0], [np.nan, 0.9, 0.4])


def test_points_whose_balls_touch_the_layer(tmp_path: Path) -> None:
    cloud = read(samples.write(tmp_path, "points.npy"), radius=0.6, layer=(-2, -1))
    assert isinstance(cloud, PointCloud) and cloud.points.tolist() == [samples.POINTS[1, :2].tolist()]


@pytest.mark.parametrize(("name", "layer", "field", "said"), [
    ("points.npy", (1, 0), "layer", "low < high"),
    ("points.npy", 3, "layer", "heights"),
    ("points.npy", (8, 9), "path", "points between 8 m and 9 m, got .*-0.5 m to 4 m"),
    ("tree.bt", (8, 9), "path", "known cells in the layer between 8 m and 9 m"),
    ("plan.png", (0, 1), "layer", "a map of the plane"),
])  # fmt: skip
def test_wrong_layers(name: str, layer: Any, field: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said) as error:
        read(samples.write(tmp_path, name), layer=layer, **samples.SAMPLES[name][1])
    assert error.value.field == f"map.{field}"
