"""Grids and clouds are checked where they are made."""

from typing import Any

import numpy as np
import pytest
import torch

from torchgco import InputError
from torchgco.maps import OccupancyGrid, PointCloud


def test_a_grid_says_where_its_cells_lie() -> None:
    occupied = np.zeros((4, 3), bool)
    occupied[2, 1] = True
    grid = OccupancyGrid(occupied, [-1.0, 2.0], 0.5)
    assert (grid.d, grid.batch, grid.shape) == (2, None, (4, 3))
    assert grid.upper.tolist() == [1.0, 3.5]
    assert grid.cell([[-0.9, 2.1], [0.2, 2.7], [-1.1, 3.6]]).tolist() == [[0, 0], [2, 1], [-1, 3]]
    assert grid.is_occupied[2, 1] and grid.is_occupied.sum() == 1 and not grid.is_unknown.any()


def test_an_enclosed_grid_has_a_rim_of_occupied_cells() -> None:
    unknown = np.array([[0.2, np.nan], [0.9, 0.0]])
    for cells in (unknown, np.stack([unknown, unknown]), unknown > 0.5):
        grid = OccupancyGrid(cells, [1.0, 2.0], 0.5) if cells.ndim == 2 else OccupancyGrid(cells, [[1.0, 2.0]] * 2, 0.5)
        closed = grid.enclosed()
        inner = closed.occupied[..., 1:-1, 1:-1]
        np.testing.assert_array_equal(inner, grid.occupied)
        assert closed.is_occupied.sum() - grid.is_occupied.sum() == 12 * (grid.batch or 1)
        np.testing.assert_allclose(closed.origin, grid.origin - 0.5)


def test_numbers_are_probabilities_and_a_third_value_is_unknown() -> None:
    grid = OccupancyGrid([[0.1, 0.5], [np.nan, 1.0]], [0, 0], 1)
    assert grid.is_occupied.tolist() == [[False, True], [False, True]]
    assert grid.is_unknown.tolist() == [[False, False], [True, False]]
    whole = OccupancyGrid(np.array([[0, 1], [-1, 1]], np.int8), [0, 0], 1)
    assert whole.is_occupied.tolist() == grid.is_occupied.tolist()
    assert whole.is_unknown.tolist() == grid.is_unknown.tolist()
    assert OccupancyGrid(np.zeros((2, 2), bool), [0, 0], 1).is_unknown.shape == (2, 2)


def test_a_grid_per_problem_may_have_its_own_origin() -> None:
    grid = OccupancyGrid(torch.zeros(2, 4, 5, 6, dtype=torch.bool), np.array([[0.0, 0, 0], [1, 0, 0]]), 0.5)
    assert (grid.d, grid.batch, grid.shape) == (3, 2, (4, 5, 6))
    assert grid.cell(np.array([[1.2, 0, 0], [1.2, 0, 0]])).tolist() == [[2, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((np.zeros((2, 2), bool), [0, 0], 0.0), "grid.resolution"),
        ((np.zeros((2, 2), bool), [0, 0], np.nan), "grid.resolution"),
        ((np.zeros((2, 2), bool), [0, 0], "small"), "grid.resolution"),
        ((np.zeros((2, 2), bool), [0, 0], [1, 1]), "grid.resolution"),
        ((np.zeros((2, 2), bool), [0, np.inf], 1), "grid.origin"),
        ((np.zeros((2, 2), bool), [0], 1), "grid.origin"),
        ((np.zeros((2, 2), bool), "here", 1), "grid.origin"),
        ((np.zeros((2, 2), bool), [0, 0, 0], 1), "grid.occupied"),
        ((np.zeros((2, 2, 2, 2, 2), bool), [0, 0, 0], 1), "grid.occupied"),
        ((np.zeros((0, 2), bool), [0, 0], 1), "grid.occupied"),
        ((np.full((2, 2), 1.5), [0, 0], 1), "grid.occupied"),
        ((np.full((2, 2), 100, np.int8), [0, 0], 1), "grid.occupied"),
        ((np.full((2, 2), "x"), [0, 0], 1), "grid.occupied"),
        (([[0, 1], [0]], [0, 0], 1), "grid.occupied"),
        ((np.zeros((2, 2), bool), [[0, 0], [0, 0]], 1), "grid.origin"),
        ((np.zeros((3, 2, 2), bool), [[0, 0], [0, 0]], 1), "grid.origin"),
    ],
)
def test_a_wrong_grid_is_refused(arguments: Any, field: str) -> None:
    with pytest.raises(InputError) as error:
        OccupancyGrid(*arguments)
    assert error.value.field == field


def test_points_that_are_no_returns_are_none() -> None:
    cloud = PointCloud([[0.0, 0, 0], [np.inf, 1, 2], [1, np.nan, 0], [1, 1, 1]], 0.1)
    assert (cloud.d, cloud.batch) == (3, None)
    assert cloud.clouds()[0].tolist() == [[0, 0, 0], [1, 1, 1]]
    many = PointCloud(np.zeros((2, 5, 2)), 0)
    assert many.batch == 2 and [len(points) for points in many.clouds()] == [5, 5]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (([[0.0, 0, 0, 0]], 0.1), "cloud.points"),
        (([0.0, 0.0], 0.1), "cloud.points"),
        (([["a", "b"]], 0.1), "cloud.points"),
        (([], 0.1), "cloud.points"),
        (([[0.0, 0.0]], -0.1), "cloud.radius"),
        (([[0.0, 0.0]], np.inf), "cloud.radius"),
        (([[0.0, 0.0]], None), "cloud.radius"),
    ],
)
def test_a_wrong_cloud_is_refused(arguments: Any, field: str) -> None:
    with pytest.raises(InputError) as error:
        PointCloud(*arguments)
    assert error.value.field == field


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("side", [0.07, 0.3])
def test_the_cells_of_a_cloud(d: int, side: float) -> None:
    """A cell is occupied where the nearest point of its box lies in a ball: by hand, cell by cell."""
    points = np.random.default_rng(d).uniform(-0.4, 0.5, (6, d))
    points[2] = np.nan
    grid = PointCloud(points, 0.15).rasterised(side)
    wanted = np.zeros(grid.shape, bool)
    for cell in np.ndindex(*grid.shape):
        low = grid.origin + side * np.array(cell)
        nearest = np.minimum(np.maximum(points, low), low + side)
        wanted[cell] = (np.linalg.norm(nearest - points, axis=1) <= 0.15).any()
    assert np.array_equal(grid.occupied, wanted) and wanted.any() and not wanted.all()
    assert (grid.origin <= np.nanmin(points, 0) - 0.15).all() and (grid.upper >= np.nanmax(points, 0) + 0.15).all()


def test_cells_of_clouds_that_have_none() -> None:
    assert not PointCloud(np.full((3, 2), np.nan), 0.1).rasterised(0.1).occupied.any()
    for cloud, resolution, field in (
        (PointCloud([[0.0, 0.0]], 0.1), 0.0, "resolution"),
        (PointCloud([[0.0, 0.0], [1e6, 1e6]], 0.1), 0.01, "resolution"),
        (PointCloud([[[0.0, 0.0]], [[1.0, 1.0]]], 0.1), 0.1, "cloud.points"),
    ):
        with pytest.raises(InputError) as error:
            cloud.rasterised(resolution)
        assert error.value.field == field
