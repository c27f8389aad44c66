"""Grids from files: a known cell lies at a known place, in metres."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.maps.files import samples
from tests.maps.files.samples import ROOM, WHITE_ROOM, png, yaml
from torchgco import InputError
from torchgco.maps import OccupancyGrid, read
from torchgco.scenarios.maps import MapFile

POST = (2, 1)  # the room's post, in cells from the lower left


def grid_of(path: Path, **options: Any) -> OccupancyGrid:
    """The grid as the file has it, without a rim."""
    grid = read(path, **{"outside": "free"} | options)
    assert isinstance(grid, OccupancyGrid)
    return grid


def at(grid: OccupancyGrid, *place: float) -> float:
    """The value of the cell that holds a place, m."""
    return grid.occupied[tuple(grid.cell(place))].item()


@pytest.mark.parametrize(("name", "corner"), [
    ("grid.npz", (-1, 2)), ("cells.npy", (0, 0)), ("plan.png", (0, 0)), ("plan.pgm", (0, 0)), ("map.yaml", (-1, 2)),
])  # fmt: skip
def test_cells_lie_where_the_format_says(name: str, corner: tuple[int, int], tmp_path: Path) -> None:
    grid = grid_of(samples.write(tmp_path, name), **samples.SAMPLES[name][1])
    x, y = corner
    assert grid.shape == (6, 4) and grid.resolution == 0.5 and grid.origin.tolist() == [x, y]
    assert at(grid, x + 0.5 * POST[0] + 0.25, y + 0.5 * POST[1] + 0.25) == 1
    assert at(grid, x + 2.75, y + 0.75) == 0  # the door, to the right, in the second row from below
    assert (grid.is_occupied == ROOM[::-1].T).all() and not grid.is_unknown.any()


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.0])
def test_what_lies_outside_of_a_map_servers_map_is_occupied(yaw: float, tmp_path: Path) -> None:
    """By its yaml file, and by its image, of which that tells; other plans and heights have no rim."""
    path = described(tmp_path)
    (tmp_path / "map.yaml").write_text(path.with_suffix(".yaml").read_text().replace("2.0, 0]", f"2.0, {yaw}]"))
    for name, options in (("map.yaml", {}), ("map.pgm", {}), ("map.pgm", {"resolution": 0.05})):
        open_, closed = (read(tmp_path / name, outside=how, **options) for how in ("free", "occupied"))
        usual = read(tmp_path / name, **options)
        for grid in (usual, closed):
            assert isinstance(open_, OccupancyGrid) and isinstance(grid, OccupancyGrid)
            np.testing.assert_array_equal(grid.occupied, open_.enclosed().occupied)
            np.testing.assert_allclose(grid.origin, open_.origin - 0.05)
    assert grid_of(path, resolution=0.1, height=2.0).shape[:2] == read(path, resolution=0.1, height=2.0).shape[:2]
    path.with_suffix(".yaml").unlink()
    assert grid_of(path, resolution=0.05).shape == (6, 4) == read(path, resolution=0.05).shape
    cloud = samples.write(tmp_path, "points.xyz")
    with pytest.raises(InputError, match=r"^map.outside: expected free: a cloud of points has no edge"):
        read(cloud, radius=0.1, outside="occupied")


def test_an_origin_can_be_given(tmp_path: Path) -> None:
    grid = grid_of(samples.write(tmp_path, "plan.png"), resolution=0.1, origin=(3, -1))
    assert grid.origin.tolist() == [3, -1] and at(grid, 3.25, -0.85) == 1


@pytest.mark.parametrize("mode", ["I", "1", "P", "L", "LA", "RGB", "RGBA"])
def test_all_kinds_of_images_are_read(mode: str, tmp_path: Path) -> None:
    """Written by Pillow, as they come."""
    from PIL import Image

    image = Image.fromarray(WHITE_ROOM.astype(np.uint16) * 257 if mode == "I" else WHITE_ROOM)
    (image if mode == "I" else image.convert(mode)).save(tmp_path / "plan.png")
    assert (grid_of(tmp_path / "plan.png", resolution=1).is_occupied == ROOM[::-1].T).all()


def test_transparent_paper_is_free(tmp_path: Path) -> None:
    black = np.zeros((2, 2, 4), np.uint8)
    black[0, 0, 3] = 255
    (tmp_path / "plan.png").write_bytes(png(black))
    assert np.argwhere(grid_of(tmp_path / "plan.png", resolution=1).occupied).tolist() == [[0, 1]]


def test_a_photo_lies_as_viewers_show_it(tmp_path: Path) -> None:
    """A camera on its side stores rows that are columns of the picture, and says so."""
    shown = np.full((16, 32), 255, np.uint8)
    shown[:8, :8] = 0  # the upper left corner
    photo, turned = Image.fromarray(np.rot90(shown).copy()), Image.Exif()
    turned[0x0112] = 6  # to be turned by a quarter, clockwise
    for name in ("photo.jpg", "photo.png", "photo.tif"):
        photo.save(tmp_path / name, exif=turned.tobytes())
        occupied = grid_of(tmp_path / name, resolution=1).occupied
        assert occupied.shape == (32, 16) and occupied[:8, 8:].all() and occupied.sum() == 64


@pytest.mark.parametrize(("mode", "photometric", "said"), [("I", 1, "got .*another kind"), ("I;16", 0, "white at 0")])
def test_tif_images_whose_white_is_unknown(mode: str, photometric: int, said: str, tmp_path: Path) -> None:
    pixels = np.array([[0, 255]], np.int32 if mode == "I" else np.uint16)
    Image.fromarray(pixels).save(tmp_path / "a.tif", tiffinfo={262: photometric})
    with pytest.raises(InputError, match=said):
        read(tmp_path / "a.tif", resolution=1)


def server(folder: Path, pixels: list[int] | np.ndarray, **keys: Any) -> np.ndarray:
    """Values of a map of one row, as map_server reads it."""
    pixels = np.asarray(pixels, np.uint8)
    (folder / "row.png").write_bytes(png(pixels[None]))
    (folder / "row.yaml").write_bytes(yaml("row.png", **keys))
    return grid_of(folder / "row.yaml").occupied[:, 0]


def test_map_server_has_three_kinds_of_cells(tmp_path: Path) -> None:
    """Its own example: black, grey of 205 and white of 254 are occupied, unknown and free."""
    np.testing.assert_array_equal(server(tmp_path, [0, 205, 254, 89, 90]), [1, np.nan, 0, 1, np.nan])
    np.testing.assert_array_equal(server(tmp_path, [0, 205, 254], negate=1), [0, 1, 1])
    np.testing.assert_array_equal(server(tmp_path, [0, 200, 254], negate="true", free_thresh=0.1), [0, 1, 1])


def test_map_server_averages_colours_and_in_trinary_mode_opacity(tmp_path: Path) -> None:
    colours = np.array([[0, 0, 0, 255], [0, 0, 0, 0], [255, 255, 255, 255], [255, 255, 255, 0], [160, 160, 160, 255]])
    np.testing.assert_array_equal(server(tmp_path, colours), [1, 1, 0, np.nan, np.nan])
    np.testing.assert_array_equal(server(tmp_path, colours[:4], mode="scale"), [1, 1, 0, 0])
    assert server(tmp_path, [[255, 0, 0]]) == [1] and np.isnan(server(tmp_path, [[255, 255, 0]]))


def test_map_server_scales_between_the_thresholds(tmp_path: Path) -> None:
    found = server(tmp_path, [255, 204, 153, 102, 51], mode="scale", free_thresh=0.1, occupied_thresh=0.7)
    darkness = np.array([0, 0.2, 0.4, 0.6, 0.8])
    between = (1 + 98 * (darkness - 0.1) / 0.6) / 100
    np.testing.assert_allclose(found, [0, *between[1:4], 1], atol=1e-6)


def test_map_server_reads_raw_percents(tmp_path: Path) -> None:
    np.testing.assert_allclose(server(tmp_path, [0, 50, 100, 101, 255], mode="raw"), [0, 0.5, 1, np.nan, np.nan])


@pytest.mark.parametrize("quarters", [1, 2, 3, -1, 4])
def test_quarter_turns_of_the_origin_are_exact(quarters: int, tmp_path: Path) -> None:
    samples.write(tmp_path, "map.yaml")
    (tmp_path / "map.yaml").write_bytes(yaml("plan.pgm", origin=[-1.0, 2.0, quarters * math.pi / 2]))
    grid = grid_of(tmp_path / "map.yaml")
    check_turned(grid, quarters * math.pi / 2)
    assert grid.occupied.size == 24 and grid.is_occupied.sum() == ROOM.sum()


@pytest.mark.parametrize("yaw", [0.3, -1.0, 2.5, 0.785, -0.01])
def test_turned_maps_keep_what_is_occupied_and_grow_by_less_than_a_cell(yaw: float, tmp_path: Path) -> None:
    samples.write(tmp_path, "map.yaml")
    (tmp_path / "map.yaml").write_bytes(yaml("plan.pgm", origin=[-1.0, 2.0, yaw]))
    grid = grid_of(tmp_path / "map.yaml")
    check_turned(grid, yaw)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    centers = grid.origin + 0.5 * (np.argwhere(grid.is_occupied) + 0.5)
    before = (centers - [-1, 2]) @ turn / 0.5  # in cells
    walls = np.argwhere(ROOM[::-1].T) + 0.5
    apart = np.abs(before[:, None] - walls).max(2).min(1)
    assert apart.max() < 1.5


def check_turned(grid: OccupancyGrid, yaw: float) -> None:
    """Every place of the map, by the definition of its frame: occupied places are, and no unknown one is free."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    i, j = np.meshgrid(np.arange(-1, 7, 0.124) + 0.013, np.arange(-1, 5, 0.124) + 0.017, indexing="ij")
    own = np.stack([i.ravel(), j.ravel()], 1)
    inside = ((own > 0) & (own < [6, 4])).all(1)
    known = own[inside].astype(int)
    occupied = np.zeros(len(own), bool)
    occupied[inside] = ROOM[::-1].T[tuple(known.T)] == 1
    cells = grid.cell([-1, 2] + 0.5 * own @ turn.T)
    held = ((cells >= 0) & (cells < grid.shape)).all(1)
    assert held[inside].all()
    values = np.full(len(own), np.nan)
    values[held] = grid.occupied[tuple(cells[held].T)]
    assert (values[occupied] == 1).all()
    assert not (values[~inside] == 0).any()  # nothing beyond the map is free
    if (free := (values == 0)).any():
        assert not occupied[free].any()


def test_heights_fill_the_space_below(tmp_path: Path) -> None:
    heights = np.array([[0.2, 1.0, np.nan], [-0.6, 0.7, 0.0]])
    (tmp_path / "ground.npy").write_bytes(samples.npy(heights))
    grid = grid_of(tmp_path / "ground.npy", resolution=0.5, height=1, origin=(10, 20))
    assert grid.origin.tolist() == [10, 20, -1] and grid.shape == (2, 3, 5)
    assert at(grid, 10.2, 20.2, 0.1) == 1 and at(grid, 10.2, 20.2, 0.6) == 0  # 0.2 m reaches into the cell from 0 m
    assert at(grid, 10.2, 20.7, 0.9) == 1 and at(grid, 10.2, 20.7, 1.1) == 0
    assert at(grid, 10.7, 20.2, -0.7) == 1 and at(grid, 10.7, 20.2, -0.2) == 0
    assert np.isnan(at(grid, 10.2, 21.2, 0.1)) and not grid.is_occupied[..., -1].any()


def test_an_image_of_heights(tmp_path: Path) -> None:
    pixels = np.array([[0, 65535], [32768, 0]], np.uint16)
    (tmp_path / "ground.png").write_bytes(png(pixels))
    grid = grid_of(tmp_path / "ground.png", resolution=1, height=4)
    assert grid.shape == (2, 2, 5) and grid.is_occupied.sum(2).tolist() == [[3, 0], [0, 4]]


@pytest.mark.parametrize("name", ["tree.bt", "tree.ot"])
def test_octomap(name: str, tmp_path: Path) -> None:
    """The places at which OctoMap was told of them."""
    grid = grid_of(samples.write(tmp_path, name))
    assert grid.resolution == 0.25 and grid.d == 3
    cube = [(x, y, z) for x in (0.1, 0.4) for y in (0.6, 0.9) for z in (-0.4, -0.1)]
    sure = pytest.approx(1.0 if name == "tree.bt" else 0.7)
    assert all(at(grid, *place) == sure for place in cube) and at(grid, -0.375, 0.625, 0.375) == sure
    assert at(grid, 0.625, 0.625, -0.125) == pytest.approx(0.0 if name == "tree.bt" else 0.4)
    assert grid.is_occupied.sum() == 9 and (~grid.is_unknown).sum() == 10


def test_trees_with_colours_and_times(tmp_path: Path) -> None:
    """The same nodes with three or four bytes more each."""
    data = samples.SAMPLES["tree.ot"][0]
    head, nodes = data[: data.index(b"data\n") + 5], data[data.index(b"data\n") + 5 :]
    plain = grid_of(samples.write(tmp_path, "tree.ot"))
    for kind, more in ((b"ColorOcTree", b"rgb"), (b"OcTreeStamped", b"time")):
        longer = b"".join(nodes[i : i + 4] + more + nodes[i + 4 : i + 5] for i in range(0, len(nodes), 5))
        (tmp_path / "other.ot").write_bytes(head.replace(b"id OcTree", b"id " + kind) + longer)
        np.testing.assert_array_equal(grid_of(tmp_path / "other.ot").occupied, plain.occupied)


@pytest.mark.sampled(8)
@pytest.mark.parametrize(("changed", "said"), [
    ({"resolution": None}, "no resolution"),
    ({"resolution": 0}, "resolution > 0"),
    ({"resolution": ".nan"}, "resolution, a finite number"),
    ({"resolution": "wide"}, "resolution, a finite number"),
    ({"resolution": 1e-7}, "cells of at least 1e-06 m"),
    ({"resolution": 1e9}, "within 1e\\+07 m"),
    ({"origin": [0, 0]}, "origin \\[x, y, yaw\\]"),
    ({"origin": [0, 0, 90]}, "yaw of the origin in radians"),
    ({"origin": [1e9, 0, 0]}, "within 1e\\+07 m"),
    ({"mode": "binary"}, "mode, one of trinary, scale, raw"),
    ({"mode": "raw", "negate": 1}, "negate 0 with mode raw"),
    ({"negate": 2}, "negate 0 or 1"),
    ({"free_thresh": 0.9}, "free_thresh <= occupied_thresh"),
    ({"image": "[]"}, "image, the path"),
    ({"image": "gone.png"}, "gone.png: No such file"),
    ({"image": "map.yaml"}, "a png, pgm, ppm, bmp, jpg or tif image"),
    ({"image": "."}, "a folder"),
    ({"image": "/dev/zero"}, "no regular file"),
    ({"image": '"a\\0b"'}, "null"),
    ({"more": "!!python/object/apply:os.system [ls]"}, "could not determine a constructor"),
    ({"more": "&a [1]\nmuch: [*a, *a]"}, "an alias"),
    ({"more": "[" * 2000}, "recursion"),
])  # fmt: skip
def test_wrong_map_server_files(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    samples.write(tmp_path, "map.yaml", yaml(**{"image": "plan.pgm"} | changed))
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / "map.yaml")
    assert error.value.field == "map.path" and (str(tmp_path) in str(error.value) or "/dev/zero" in str(error.value))


@pytest.mark.parametrize(("name", "options", "field", "said"), [
    ("plan.png", {}, "resolution", "the side of a pixel, m"),
    ("plan.png", {"resolution": -1}, "resolution", "a length from 1e-06"),
    ("plan.png", {"resolution": 1, "radius": 1}, "radius", "holds cells, no points"),
    ("plan.png", {"resolution": 1, "origin": (0, 0, 0)}, "path", "grid.occupied"),
    ("plan.png", {"resolution": 1, "origin": "here"}, "origin", "numbers"),
    ("plan.png", {"resolution": 1, "topic": "/map"}, "topic", "a .png file has no use for it"),
    ("plan.png", {"resolution": 1, "height": 0}, "height", "a length"),
    ("cells.npy", {}, "resolution", "the side of a cell, m"),
    ("heights.npy", {"height": 1}, "resolution", "the side of a cell, m"),
    ("map.yaml", {"resolution": 1}, "resolution", "no use for it"),
    ("points.xyz", {}, "radius", "the radius of the ball"),
    ("points.xyz", {"radius": float("nan")}, "radius", "a length from 0"),
])  # fmt: skip
def test_options_that_are_missing_or_wrong(
    name: str, options: dict[str, Any], field: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said) as error:
        read(samples.write(tmp_path, name), field="scenario", **options)
    assert error.value.field == f"scenario.{field}"


def described(folder: Path, image: str = "map.pgm") -> Path:
    """An image of map_server with a column of unknown cells (205), and its yaml file beside it."""
    from PIL import Image

    pixels = WHITE_ROOM.copy()
    pixels[:, -1] = 205
    Image.fromarray(pixels).save(folder / "map.pgm")
    text = f"image: {image}\nresolution: 0.05\norigin: [-1.0, 2.0, 0]\nnegate: 0\n"
    (folder / "map.yaml").write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    return folder / "map.pgm"


@pytest.mark.parametrize("image", ["map.pgm", "/elsewhere/map.pgm"])
def test_an_image_is_read_as_the_yaml_beside_it_says(image: str, tmp_path: Path) -> None:
    path = described(tmp_path, image)
    for options in ({}, {"resolution": 0.05}, {"resolution": 0.05, "origin": [-1, 2]}):
        grid = grid_of(path, **options)
        assert grid.origin.tolist() == [-1, 2] and grid.resolution == 0.05
        assert grid.is_unknown[-1].all() and grid.is_unknown.sum() == 4, "unknown cells stay unknown"
    source = MapFile(path=str(path), resolution=0.05).map.source
    assert isinstance(source, OccupancyGrid) and source.is_unknown.sum() == 4, "and so in scenario=map"
    for options, said in (({"resolution": 0.1}, "0.05, as .*map.yaml"), ({"origin": [0, 0]}, "-1.0, 2.0.* as .*yaml")):
        with pytest.raises(InputError, match=said) as error:
            read(path, field="scenario", **options)
        assert error.value.field == f"scenario.{next(iter(options))}"
    assert not grid_of(path, resolution=0.1, height=2.0).is_unknown.any(), "a map of heights is another thing"


def test_a_yaml_of_another_image_or_program_is_left_alone(tmp_path: Path) -> None:
    path = described(tmp_path, "other.pgm")
    assert not grid_of(path, resolution=1).is_unknown.any()
    for text in ("resolution: 0.05", "[1, 2", "", "image: [map.pgm]"):
        (tmp_path / "map.yaml").write_text(text)
        assert grid_of(path, resolution=1).resolution == 1
        with pytest.raises(InputError, match="the side of a pixel"):
            read(path)


def test_an_image_is_read_by_a_yaml_of_any_name_that_names_it(tmp_path: Path) -> None:
    path = described(tmp_path)
    (tmp_path / "map.yaml").rename(tmp_path / "floor.yml")
    (tmp_path / "big.yaml").write_bytes(b"image: map.pgm\n" + b"#" * 2**14)
    assert grid_of(path, resolution=0.05).is_unknown.sum() == 4
    (tmp_path / "other.yaml").write_bytes((tmp_path / "floor.yml").read_bytes())
    with pytest.raises(InputError, match=r"one yaml file describes.*floor.yml, other.yaml"):
        read(path, resolution=0.05)
    assert not grid_of(path, resolution=0.1, height=2.0).is_unknown.any()


def test_a_yaml_that_names_an_image_and_lacks_keys_is_refused(tmp_path: Path) -> None:
    path = described(tmp_path)
    more = "image: map.pgm\nresolution: 0.05"
    for text, said in (("image: map.pgm", "none of resolution"), (more, "none of origin")):
        (tmp_path / "map.yaml").write_text(text)
        with pytest.raises(InputError, match=said):
            read(path, resolution=0.05)


def test_a_number_without_end_is_one_line(tmp_path: Path) -> None:
    path = described(tmp_path).with_suffix(".yaml")
    path.write_text(path.read_text().replace("0.05", "1" + ":59" * 5000))  # of base 60, as YAML 1.1 writes it
    with pytest.raises(InputError, match="resolution, a finite number"):
        read(path)


@pytest.mark.parametrize("path", ["map.step", "map", "", None, 3, "gone.npz", "gone.pcd", "gone.yaml", "gone.png"])
def test_paths_that_lead_nowhere(path: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        read(path, resolution=1) if path == "gone.png" else read(path)
    assert error.value.field == "map.path"


def test_endings_in_capitals(tmp_path: Path) -> None:
    (tmp_path / "PLAN.PNG").write_bytes(samples.SAMPLES["plan.png"][0])
    assert grid_of(tmp_path / "PLAN.PNG", resolution=1).shape == (6, 4)
