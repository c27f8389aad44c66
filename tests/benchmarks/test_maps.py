"""Worlds as cells and as shapes, and their pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.causes.maps import main
from benchmarks.lib.families import EVERY
from benchmarks.lib.rasters import PASSAGE, rasterised
from tests.slow import mostly
from torchgco import compose


@pytest.mark.parametrize("name", mostly(["woods20", "mazes3", "walls", "planar_random"], "woods20", "walls"))
def test_a_map_has_the_shapes_and_a_way_around_them(name: str) -> None:
    setup = compose([*EVERY[name].generated, "seed=33"])
    task = setup.task(setup.scenario.draw([0], 33))
    small = name == "planar_random"  # a world of 2 m
    grid = rasterised(task.layouts, 0, 0.02 if small else 0.8, enclosed=False)
    centers = grid.origin + grid.resolution * (np.stack(np.indices(grid.shape), axis=-1) + 0.5)
    points = torch.from_numpy(centers).reshape(1, -1, grid.d)
    gaps = [part.signed_distance(points, torch.zeros(1)) for part in task.problem.obstacles]
    radius = task.problem.obstacles[0].vehicle_radius[0]
    gap = (torch.cat(gaps, -1).amin(-1) + radius).reshape(grid.shape).numpy()
    assert grid.is_occupied.any() and (gap[grid.is_occupied] <= 1e-6).all() and (gap[~grid.is_occupied] >= -1e-6).all()
    free = 0.9 * PASSAGE * (0.3 if small else 1.0)
    for axis in range(grid.d):
        filled = np.flatnonzero(grid.is_occupied.any(axis=tuple(i for i in range(grid.d) if i != axis)))
        beside = min(filled[0], grid.shape[axis] - 1 - filled[-1]) * grid.resolution
        assert beside >= free


@pytest.mark.slow
def test_a_world_in_the_plane_is_drawn(tmp_path: Path) -> None:
    assert main(["planar_random:0:0.2", "--path", str(tmp_path / "maps.png")]) == 0
    with Image.open(tmp_path / "maps.png") as picture:
        colors = picture.convert("RGB").getcolors(2**20)
    assert colors is not None and len(colors) > 20
