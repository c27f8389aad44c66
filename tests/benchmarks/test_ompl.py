"""OMPL's planar scenes: where nodes put triangles, and what becomes of them as a map."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from benchmarks.outside.ompl import CELL, SIZE, rastered, triangles

SCENE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema">
<library_geometries><geometry id="wall"><mesh>
<source id="places"><float_array id="a" count="12">0 0 0 4 0 0 4 0 1 0 0 1</float_array></source>
<source id="normals"><float_array id="b" count="3">0 1 0</float_array></source>
<vertices id="corners"><input semantic="POSITION" source="#places"/></vertices>
<triangles count="2"><input offset="1" semantic="NORMAL" source="#normals"/>
<input offset="0" semantic="VERTEX" source="#corners"/><p>0 0 1 0 2 0 0 0 2 0 3 0</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="all"><node id="outer">
<matrix>10 0 0 -20 0 10 0 0 0 0 10 0 0 0 0 1</matrix>
<node id="inner"><matrix>1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#wall"/></node>
</node></visual_scene></library_visual_scenes></COLLADA>"""
PROBLEM = """[problem]
world = scene.dae
start.x = -50
start.y = 5.0
goal.x = 50.0
goal.y = 5
volume.min.x = -55
volume.min.y = -55
volume.max.x = 55
volume.max.y = 55
"""


def test_triangles_stand_where_all_nodes_put_them() -> None:
    (faces,) = triangles(ElementTree.fromstring(SCENE))
    assert faces[:, :, 0].tolist() == [[-10, 30, 30], [-10, 30, -10]]
    assert faces[:, :, 2].tolist() == [[0, 0, 10], [0, 10, 10]]


def test_a_scene_is_drawn_in_a_tenth_of_its_size(tmp_path: Path) -> None:
    scenes = tmp_path / "resources" / "2D"
    scenes.mkdir(parents=True)
    (scenes / "scene.dae").write_text(SCENE)
    (scenes / "one.cfg").write_text(PROBLEM)
    owned = rastered(tmp_path, "one", tmp_path)
    assert np.allclose(owned.start, (0.5, 6.0)) and np.allclose(owned.goal, (10.5, 6.0)) and owned.outside == "occupied"
    with Image.open(tmp_path / owned.file) as picture:
        cells = np.array(picture)[::-1] == 0  # the first row is the lowest
    assert cells.shape == (round(SIZE / CELL),) * 2
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) * CELL for axis in (1, 0))
    assert np.allclose((rows.min(), rows.max()), (5.5, 6.5), atol=2 * CELL)
    assert np.allclose((columns.min(), columns.max()), (4.5, 8.5), atol=2 * CELL)
