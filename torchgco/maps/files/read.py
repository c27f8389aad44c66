"""A map from a file, by the ending of its name."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_value
from torchgco.maps.distance import Unknown
from torchgco.maps.files.arrays import read_npy, read_npz
from torchgco.maps.files.gazebo import read_world
from torchgco.maps.files.images import read_image
from torchgco.maps.files.las import read_las
from torchgco.maps.files.map_server import beside, read_described, read_map_server
from torchgco.maps.files.meshes import read_mesh
from torchgco.maps.files.movingai import read_movingai
from torchgco.maps.files.octomap import read_octomap
from torchgco.maps.files.part import Box, checked_box, checked_layer, flat, part
from torchgco.maps.files.pcd import read_pcd
from torchgco.maps.files.ply import read_ply
from torchgco.maps.files.source import FARTHEST_AT, LEAST_CELL, Source
from torchgco.maps.files.text import read_xyz
from torchgco.maps.grid import OccupancyGrid, PointCloud, coordinates, number


@dataclass(frozen=True)
class Format:
    """How the files of one ending are read.

    Args:
        reader: returns a grid, or points (P, d).
        options: those of `read` that the reader takes.
    """

    reader: Callable[..., OccupancyGrid | np.ndarray]
    options: tuple[str, ...] = ()


def _read_bag(source: Source, topic: str | None) -> OccupancyGrid | np.ndarray:
    """Imported late: some builds of Python lack what packed bags and SQLite need."""
    from torchgco.maps.files.bags import read_bag

    return read_bag(source, topic)


def _read_image(
    source: Source, resolution: float | None, origin: np.ndarray | None, height: float | None
) -> OccupancyGrid:
    """An image, as a yaml file of map_server beside it describes it, where there is one."""
    described = None if height is not None else beside(source)
    if described is not None:
        return read_described(source, described, resolution, origin)
    return read_image(source, resolution, origin, height)


def _read_octomap(source: Source, layer: tuple[float, float] | None, box: Box | None) -> OccupancyGrid:
    """What `layer` and `box` leave of a tree, which may be larger than a grid can be."""
    box = Box(np.full(3, -np.inf), np.full(3, np.inf)) if box is None else box.of(source, 3)
    return read_octomap(source, box if layer is None else box.between(*layer))


METADATA = "metadata.yaml"  # is in the folder of each bag of ROS 2
BAG = Format(_read_bag, ("topic",))
IMAGES = ".png", ".pgm", ".ppm", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff"
FORMATS = {
    ".npz": Format(read_npz),
    ".npy": Format(read_npy, ("resolution", "origin", "height")),
    **dict.fromkeys((".yaml", ".yml"), Format(read_map_server)),
    **dict.fromkeys(IMAGES, Format(_read_image, ("resolution", "origin", "height"))),
    ".map": Format(read_movingai, ("resolution", "origin")),
    **dict.fromkeys((".world", ".sdf"), Format(read_world, ("resolution",))),
    **dict.fromkeys((".stl", ".obj"), Format(read_mesh, ("resolution", "solid"))),
    ".xyz": Format(read_xyz),
    ".pcd": Format(read_pcd),
    ".ply": Format(read_ply, ("resolution", "solid")),
    **dict.fromkeys((".las", ".laz"), Format(read_las)),
    **dict.fromkeys((".bt", ".ot"), Format(_read_octomap, ("layer", "box"))),
    **dict.fromkeys((".bag", ".mcap", ".db3"), BAG),
}
# What other formats become ones that are read by: a tool of theirs, and its line.
_BY_TRIMESH = "an stl: `python -c \"import trimesh; trimesh.load('IN', force='mesh').export('OUT.stl')\"` writes one"
CONVERTED = {
    **dict.fromkeys((".dae", ".glb", ".gltf", ".off", ".3mf"), _BY_TRIMESH),
    ".pdf": "an image: `pdftoppm -png -r 100 IN OUT` writes one",
    ".svg": "an image: `rsvg-convert -o OUT.png IN` writes one",
    ".webp": "an image: `python -c \"from PIL import Image; Image.open('IN').save('OUT.png')\"` writes one",
    ".gif": "an image: `python -c \"from PIL import Image; Image.open('IN').save('OUT.png')\"` writes one",
    ".e57": "a cloud of points: `pdal translate IN OUT.las` writes one",
    ".urdf": "a world in SDF: `gz sdf -p IN > OUT.sdf` writes one",
    ".xacro": "a world in SDF: `xacro IN > OUT.urdf; gz sdf -p OUT.urdf > OUT.sdf` writes one",
    ".csv": "points as text, `.xyz`: lines of x, y, z without a heading",
    ".txt": "points as text, `.xyz`: lines of x, y, z without a heading",
}


def read(
    path: str | os.PathLike[str],
    *,
    resolution: float | None = None,
    radius: float | None = None,
    origin: Any = None,
    height: float | None = None,
    topic: str | None = None,
    layer: Any = None,
    box: Any = None,
    solid: bool | None = None,
    outside: Unknown | None = None,
    field: str = "map",
) -> OccupancyGrid | PointCloud:
    """The map in a file: a grid, or a cloud where the file holds points. What has no unit is in metres.

    Args:
        path: a file of one of `FORMATS`; of ROS 2 also a bag's folder; `~` is your home.
        resolution: side of a cell, m: for images, MovingAI's maps, and cells or heights in npy files, which don't state
            theirs; for worlds and meshes, which become cells. An image that a map_server's yaml file of the same stem
            beside it describes is read as that says, unknown cells too.
        radius: of the ball around each point, m: for files of points.
        origin: lowest corner of the first cell, m, by default 0: for images, MovingAI's maps, and cells or heights in
            npy files.
        height: makes an image or numbers (X, Y) in an npy file a heightmap: metres of white above black, or of 1.
        topic: of a bag's map; not needed where only one topic has maps.
        layer: heights (low, high), m: of a map of space, what lies between them is seen from above, as a map of the
            plane.
        box: two corners (low, high), each of as many coordinates as the map has, m: what lies outside isn't read. Cells
            that touch the box are kept whole.
        solid: of a mesh, whether its inside is occupied, too; None: where its surface is closed.
        outside: what lies around a grid's cells: "free", or "occupied", a rim of one cell. None: as unknown cells are,
            "occupied", around a map_server's map; "free" around others.
        field: what errors call the file and these arguments: `<field>.path`, `<field>.resolution`.

    Raises:
        InputError: another ending, no such file, one that is damaged or too large, an argument that is missing, out of
            range, or not for this kind of file.
    """
    source, format = _find(path, field)
    options = {"resolution": resolution, "origin": origin, "height": height, "topic": topic, "solid": solid}
    for name, value in options.items():
        if value is not None and name not in format.options:
            raise InputError(f"{field}.{name}", f"none: a {source.path.suffix} file has no use for it", shown(value))
    cell = ("resolution", resolution, LEAST_CELL)
    _check_lengths(field, cell, ("radius", radius, 0.0), ("height", height, LEAST_CELL))
    if origin is not None:
        options["origin"] = origin = coordinates(origin, f"{field}.origin")
        if origin.shape not in ((2,), (3,)) or not (np.abs(origin) <= FARTHEST_AT).all():
            raise InputError(f"{field}.origin", f"2 or 3 coordinates within {FARTHEST_AT:g} m", shown(origin.tolist()))
    if solid is not None and not isinstance(solid, bool):
        raise InputError(f"{field}.solid", "True, False or None", shown(solid))
    check_value(outside, Unknown | None, f"{field}.outside")
    options["layer"] = layer = None if layer is None else checked_layer(layer, f"{field}.layer")
    options["box"] = box = None if box is None else checked_box(box, f"{field}.box")
    content = format.reader(source, **{name: options[name] for name in format.options})
    content = content if box is None else part(source, content, box, radius)
    content = content if layer is None else flat(source, content, layer, radius)
    if isinstance(content, OccupancyGrid):
        if radius is not None:
            raise InputError(f"{field}.radius", f"none: {source.path} holds cells, no points", radius)
        return content.enclosed() if (outside or usual_outside(path, height, field)) == "occupied" else content
    if outside == "occupied":
        raise InputError(f"{field}.outside", "free: a cloud of points has no edge", outside)
    source.needs("radius", radius, "the radius of the ball around each point, m")
    return PointCloud(content, radius)


def _check_lengths(field: str, *lengths: tuple[str, Any, float]) -> None:
    """Check options by name, value and least length, m; None is none."""
    for name, value, least in lengths:
        if value is not None and not least <= number(value, f"{field}.{name}") <= FARTHEST_AT:
            raise InputError(f"{field}.{name}", f"a length from {least:g} to {FARTHEST_AT:g} m", shown(value))


def usual_outside(path: Any, height: float | None = None, field: str = "map") -> Unknown:
    """What lies around the cells of a file's map where `read` isn't given it; arguments and errors as there."""
    source, format = _find(path, field)
    image = format.reader is _read_image and height is None
    return "occupied" if format.reader is read_map_server or (image and beside(source) is not None) else "free"


def _find(path: Any, field: str) -> tuple[Source, Format]:
    if not isinstance(path, (str, os.PathLike)) or not str(path):
        raise InputError(f"{field}.path", "the path of a map", shown(path))
    source = Source(Path(os.path.expanduser(path)), field)
    ending = source.path.suffix.lower()
    format = FORMATS.get(ending) or (BAG if (source.path / METADATA).is_file() else None)
    if format is None:
        expected = CONVERTED.get(ending, f"a file that ends with {', '.join(FORMATS)}")
        raise InputError(f"{field}.path", expected, path)
    return source, format
