"""python -m benchmarks.outside.ompl CLONE: the planar scenes of OMPL.app's benchmarks, for a small disc that drives.

Reads a local clone of github.com/ompl/omplapp (its scenes aren't part of this project). OMPL plans ways of a rigid body
there, without dynamics or cost; here a unicycle drives from its start to its goal, in a tenth of the size, so that the
limits of `conf/model/unicycle.yaml` fit. `path_pursuit` follows a grid's shortest path. With --write the table goes
into benchmarks/results/floors.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from configparser import ConfigParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from PIL import Image, ImageDraw

from benchmarks.families.floors import MAP_HEAD, PEER, Owned, map_rows
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.page import markdown, measured, put

COMMIT = "9c67afb"
SCENES = ("Barriers", "BugTrap_planar", "Maze_planar", "RandomPolygons_planar", "UniqueSolutionMaze")
SIZE = 11.0  # m, to which the longer side of a scene is brought: a tenth of most
CELL = 0.02  # m
RADIUS = 0.05  # m, of the disc
NAMES = {"c": "http://www.collada.org/2005/11/COLLADASchema"}


def triangles(scene: ElementTree.Element) -> Iterator[np.ndarray]:
    """The triangles (K, 3, 3) of each geometry in a COLLADA document, where its nodes put them."""
    geometries = {"#" + one.get("id", ""): one for one in scene.iterfind(".//c:geometry", NAMES)}

    def below(node: ElementTree.Element, outer: np.ndarray) -> Iterator[np.ndarray]:
        for matrix in node.iterfind("c:matrix", NAMES):
            outer = outer @ np.array((matrix.text or "").split(), dtype=float).reshape(4, 4)
        for instance in node.iterfind("c:instance_geometry", NAMES):
            for corners in _corners(geometries[instance.get("url", "")]):
                yield corners @ outer[:3, :3].T + outer[:3, 3]
        for instance in node.iterfind("c:instance_node", NAMES):
            known = scene.find(f".//c:library_nodes/c:node[@id='{instance.get('url', '')[1:]}']", NAMES)
            if known is not None:
                yield from below(known, outer)
        for inner in node.iterfind("c:node", NAMES):
            yield from below(inner, outer)

    for root in scene.iterfind(".//c:visual_scene", NAMES):
        yield from below(root, np.eye(4))


def _corners(geometry: ElementTree.Element) -> Iterator[np.ndarray]:
    """The corners (K, 3, 3) of the triangles of a geometry."""
    arrays = {
        "#" + source.get("id", ""): np.array((source.findtext("c:float_array", "", NAMES)).split(), dtype=float)
        for source in geometry.iterfind(".//c:source", NAMES)
    }
    position = geometry.find(".//c:vertices/c:input[@semantic='POSITION']", NAMES)
    assert position is not None
    points = arrays[position.get("source", "")].reshape(-1, 3)
    for group in geometry.iterfind(".//c:triangles", NAMES):
        offsets = {one.get("semantic"): int(one.get("offset", 0)) for one in group.iterfind("c:input", NAMES)}
        indices = np.array((group.findtext("c:p", "", NAMES)).split(), dtype=int)
        rows = indices.reshape(-1, max(offsets.values()) + 1)[:, offsets["VERTEX"]]
        yield points[rows].reshape(-1, 3, 3)


def rastered(clone: Path, name: str, folder: Path) -> Owned:
    """A scene as a picture below a folder, black where walls are, with start and goal, m from its lower left corner."""
    scenes = clone / "resources" / "2D"
    config = ConfigParser(strict=False)
    config.read(scenes / f"{name}.cfg")
    asked = config["problem"]
    low, high, start, goal = (
        np.array([asked.getfloat(f"{what}.x"), asked.getfloat(f"{what}.y")])
        for what in ("volume.min", "volume.max", "start", "goal")
    )
    scale = SIZE / (high - low).max()
    shape = np.ceil((high - low) * scale / CELL).astype(int)
    picture = Image.new("L", tuple(shape.tolist()), 255)
    pen = ImageDraw.Draw(picture)
    scene = ElementTree.parse(scenes / asked["world"]).getroot()
    for faces in triangles(scene):
        for face in (faces[..., [0, 2]] - low) * scale / CELL:  # the third coordinate is the plane's second
            pen.polygon([(float(x), float(shape[1] - y)) for x, y in face], fill=0)
    file = f"{name}.png"
    picture.save(folder / file)
    ends = ((point - low) * scale for point in (start, goal))
    begin, end = (tuple(point.tolist()) for point in ends)
    return Owned(file, begin, end, RADIUS, f"ompl/omplapp {COMMIT}", CELL, outside="occupied")


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/floors.md")
    parser.add_argument("clone", type=Path, help="folder of the repository ompl/omplapp")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES, metavar="NAME")
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the scenes as maps")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    asked.pictures.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in asked.scenes:
        rows += map_rows(asked.pictures, rastered(asked.clone, name, asked.pictures), ["gco", PEER])
        print(markdown(MAP_HEAD, rows[-2:]), flush=True)
    if asked.write:
        put(RESULTS / "floors.md", "ompl", f"{measured('each solved alone')}\n\n{markdown(MAP_HEAD, rows)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
