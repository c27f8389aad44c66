"""python -m benchmarks.outside.barn_data CLONE: the 300 worlds of the BARN challenge as arrays.

Reads a local clone of github.com/Daffan/the-barn-challenge (MIT, Copyright (c) 2022 Zifan Xu) and writes two files of
benchmarks/data: barn.npz, a layout file with the cylinders, start and goal of each world, and barn.csv with the length
of the challenge's own path through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from benchmarks.lib import DATA
from benchmarks.lib.command import parser_of
from torchgco.scenarios import Layouts

WORLDS, TEST = range(300), range(0, 300, 6)  # test.sh there
RADIUS = 0.075  # of the cylinders, m: the worlds' only size
START, GOAL = (-2.25, 3.0), (-2.25, 13.0)  # m; run.py there
HEADING = np.pi / 2  # at the start, rad; 1.57 there
GOAL_RADIUS = 1.0  # m, within which a run has arrived


def cylinders(world: str) -> np.ndarray:
    """Centres (M, 2) of the cylinders in the XML of a world, m.

    Raises:
        ValueError: no cylinders, or other radii than the challenge's.
    """
    models = [m for m in ElementTree.fromstring(world).iterfind("world/model") if m.find(".//cylinder") is not None]
    radii = {float(model.findtext(".//collision//radius", "nan")) for model in models}
    if radii != {RADIUS}:
        raise ValueError(f"expected cylinders of radius {RADIUS}, got radii {sorted(radii)}")
    poses = [model.findtext("pose", "").split() for model in models]
    return np.array([[float(pose[0]), float(pose[1])] for pose in poses])


def path_length(cells: np.ndarray) -> float:
    """Length of the challenge's path from start to goal, m, over its cells (P, 2): pairs of column and row."""
    first = np.array([-RADIUS - 60 * RADIUS, RADIUS + 5.0])  # m, the middle of cell (0, 0)
    corners = np.vstack((START, first + 2 * RADIUS * cells, GOAL))
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("clone", type=Path, help="folder of the repository Daffan/the-barn-challenge")
    asked = parser.parse_args(words)
    folder = asked.clone / "jackal_helper" / "worlds" / "BARN"
    worlds = [cylinders((folder / f"world_{number}.world").read_text()) for number in WORLDS]
    centers = np.full((len(worlds), max(len(world) for world in worlds), 2), np.nan)
    for row, world in zip(centers, worlds, strict=True):
        row[: len(world)] = world
    Layouts(
        centers=centers,
        radii=np.where(np.isnan(centers[..., 0]), np.nan, RADIUS),
        start=np.array([*START, HEADING, 0.0]),
        goal=np.array([*GOAL, 0.0, 0.0]),
        goal_radius=GOAL_RADIUS,
        ids=np.array(WORLDS),
    ).save(DATA / "barn.npz")
    lengths = [path_length(np.load(folder / "path_files" / f"path_{number}.npy")) for number in WORLDS]
    table = pd.DataFrame({"world": WORLDS, "cylinders": [len(world) for world in worlds], "path_length": lengths})
    table.to_csv(DATA / "barn.csv", index=False, float_format="%.6f")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
