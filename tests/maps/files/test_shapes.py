"""Worlds, meshes, scans and grids of other programs, and parts of maps, against what is known of the shapes in them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.maps.files import samples
from torchgco import InputError
from torchgco.maps import DistanceField, OccupancyGrid, PointCloud, read

WORLD = """<?xml version="1.0"?>
<sdf version="1.7"><world name="yard">
  <include><uri>model://sun</uri></include>
  <model name="ground"><static>1</static><link name="l"><collision name="c"><geometry>
    <plane><normal>0 0 1</normal></plane></geometry></collision></link></model>
  <model name="yard"><static>true</static><pose>1 -2 0.5 0 0 0.7</pose>
    <link name="l"><pose>0.5 0 0 0.2 -0.4 0</pose>
      <collision name="a"><pose>0 1 0 0 0 0.3</pose><geometry><box><size>2 0.6 1</size></box></geometry></collision>
      <collision name="b"><pose>-2 0 0 0 1.2 0</pose>
        <geometry><cylinder><radius>0.4</radius><length>1.5</length></cylinder></geometry></collision>
    </link>
    <model name="inner"><pose>0 -2 0 0 0 0</pose><link name="l"><collision name="c">
      <geometry><sphere><radius>0.7</radius></sphere></geometry></collision></link></model>
  </model>
  <model name="robot"><link name="l"><collision name="c"><geometry>
    <sphere><radius>9</radius></sphere></geometry></collision></link></model>
</world></sdf>
"""


def turn(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


def surfaces() -> np.ndarray:
    """Points drawn in the three bodies of WORLD, placed by SciPy's rotations."""
    draws = np.random.default_rng(0)
    cube = draws.uniform(-1, 1, (40_000, 3))
    disc = cube[:, :2][np.linalg.norm(cube[:, :2], axis=1) <= 1]
    ball = cube[np.linalg.norm(cube, axis=1) <= 1]
    model, link = turn(0, 0, 0.7), turn(0.2, -0.4, 0)
    box = cube * [1, 0.3, 0.5] @ turn(0, 0, 0.3).T + [0, 1, 0]
    post = np.column_stack([0.4 * disc, 0.75 * cube[: len(disc), 2]]) @ turn(0, 1.2, 0).T + [-2, 0, 0]
    of_link = np.concatenate([box, post]) @ link.T + [0.5, 0, 0]
    return np.concatenate([of_link, 0.7 * ball + [0, -2, 0]]) @ model.T + [1, -2, 0.5]


def test_the_cells_of_a_world_are_those_near_its_shapes(tmp_path: Path) -> None:
    (tmp_path / "yard.world").write_text(WORLD)
    grid, points = read(tmp_path / "yard.world", resolution=0.2), surfaces()
    assert isinstance(grid, OccupancyGrid)
    held = set(map(tuple, np.argwhere(grid.is_occupied).tolist()))
    assert set(map(tuple, grid.cell(points).tolist())) <= held
    centers = grid.origin + 0.2 * (np.array(sorted(held)) + 0.5)
    gaps = np.linalg.norm(centers[:, None] - points[None, ::20], axis=-1).min(1)
    assert gaps.max() < 0.5 * 3**0.5 * 0.2 + 0.1  # half a diagonal, and how far apart the points are
    layer = read(tmp_path / "yard.world", resolution=0.2, layer=(0.4, 0.6))
    assert isinstance(layer, OccupancyGrid) and layer.d == 2
    bottoms = grid.origin[2] + 0.2 * np.arange(grid.shape[2])
    assert (layer.occupied == grid.occupied[..., (bottoms < 0.6) & (bottoms + 0.2 > 0.4)].any(-1)).all()


def test_models_of_a_saved_world_stand_where_its_state_has_them(tmp_path: Path) -> None:
    """Gazebo leaves the older poses in the models, and writes where they are by now into the state, in the world."""
    state = """<state world_name="yard"><sim_time>7 0</sim_time>
      <model name="ground"><pose>0 0 0 0 0 0</pose></model>
      <model name="yard"><pose>4 3 0.25 0 0 -1.57</pose><scale>1 1 1</scale>
        <link name="l"><pose>5 2 1 0.1 0.2 0.3</pose><velocity>0 0 0 0 0 0</velocity></link>
        <model name="inner"><pose frame="">-1 -1 0.5 0 0 0</pose></model></model></state>"""
    place = "<model name='{}'><static>1</static><pose>{}</pose>{}</model>"
    alone = WORLD[WORLD.index('<collision name="a">') : WORLD.index("</link>\n    <model")]
    inner = "<link name='l'><collision name='c'><geometry><sphere><radius>0.7</radius></sphere></geometry></collision>"
    now = place.format("a", "5 2 1 0.1 0.2 0.3", f"<link name='l'>{alone}</link>")
    now += place.format("b", "-1 -1 0.5 0 0 0", f"{inner}</link>")
    (tmp_path / "saved.world").write_text(WORLD.replace("</world>", f"{state}</world>"))
    (tmp_path / "now.world").write_text(f"<sdf><world>{now}</world></sdf>")
    saved, expected = (read(tmp_path / f"{name}.world", resolution=0.2) for name in ("saved", "now"))
    assert isinstance(saved, OccupancyGrid) and isinstance(expected, OccupancyGrid)
    assert saved.origin.tolist() == expected.origin.tolist() and (saved.occupied == expected.occupied).all()


@pytest.mark.parametrize(("old", "new", "said"), [
    ("<sphere><radius>0.7</radius></sphere>", "<mesh><uri>a.dae</uri></mesh>", "cylinders or spheres, got .*mesh"),
    ("<radius>0.7</radius>", "<radius>-1</radius>", "sizes above 0"),
    ("<size>2 0.6 1</size>", "<size>2 0.6</size>", "<size> of 3 numbers, got .*2 0.6"),
    ("<size>2 0.6 1</size>", "<size>2 0.6 nan</size>", "<size> of 3 numbers"),
    ("<size>2 0.6 1</size>", "<size>2e6 2e6 2e6</size>", "at most 134,217,728 cells"),
    ("model://sun", "model://warehouse", "gz sdf -p"),
    ("<pose>0 -2 0 0 0 0</pose>", "<pose relative_to='map'>0 -2 0 0 0 0</pose>", "relative to"),
    ("<world name", "<world><world name", "mismatched tag"),
    ("<?xml version=\"1.0\"?>", "<!DOCTYPE a [<!ENTITY b 'c'>]>", "without definitions"),
    ("sdf", "html", "<html>"),
    ("<static>true</static>", "", "in a static model, got .*none"),
    ("</world>", "<population name='a'/></world>", "models stand in the file, got .*population"),
    ("</world>", "<state><insertions><model name='a'/></insertions></state></world>", "got .*insertions"),
    ("</world>", "<state><model name='yard'><scale>1 2 1</scale></model></state></world>", "saved, got .*1 2 1"),
    ("<model name=\"inner\">", "<model name=\"inner\" placement_frame=\"l\">", "got .*placement_frame"),
])  # fmt: skip
def test_worlds_that_are_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.sdf").write_text(WORLD.replace(old, new))
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / "a.sdf", resolution=0.2)
    assert error.value.field == "map.path"


@pytest.mark.slow
def test_rooms_between_walls_of_a_closed_mesh_stay_free(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = lambda size, at=(0, 0, 0): trimesh.creation.box(
        extents=size, transform=trimesh.transformations.translation_matrix(at)
    )
    outer, room = box([4.1, 3.1, 2.1]), box([2.9, 1.9, 0.9])
    filled = trimesh.util.concatenate([outer, room])
    room.invert()
    hollow = trimesh.util.concatenate([outer, room])
    turned = hollow.copy()
    turned.invert()
    mixed = hollow.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    sides = [box([0.2, 3.1, 2.1], (x, 0, 0)) for x in (-1.9, 0, 1.9)] + [
        box([4.1, 0.2, 2.1], (0, y, 0)) for y in (-1.4, 1.4)
    ]
    walls = trimesh.util.concatenate([*sides, box([4.1, 3.1, 0.2], (0, 0, -0.9)), box([4.1, 3.1, 0.2], (0, 0, 0.9))])
    for name, mesh, is_solid, in_room in (
        ("hollow", hollow, True, False), ("turned", turned, True, False), ("mixed", mixed, True, False),
        ("filled", filled, True, True), ("walls", walls, False, False),
    ):  # fmt: skip
        mesh.export(tmp_path / f"{name}.stl")
        grid = read(tmp_path / f"{name}.stl", resolution=0.1)
        assert isinstance(grid, OccupancyGrid)
        at = lambda *point, grid=grid: bool(grid.occupied[tuple(grid.cell(np.array([point]))[0])])
        assert at(1.65, 0.0, 0.65) == is_solid and at(1.0, 0.5, 0.1) == in_room, name


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_a_closed_mesh_is_solid(ending: str, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    place = np.array([[1, 0, 0, 3.05], [0, 1, 0, -1.05], [0, 0, 1, 0.55], [0, 0, 0, 1]])
    trimesh.creation.box(extents=[1.8, 0.8, 1.4], transform=place).export(tmp_path / f"a.{ending}")
    grid = read(tmp_path / f"a.{ending}", resolution=0.1)
    assert isinstance(grid, OccupancyGrid)
    assert np.allclose(grid.origin, [2.1, -1.5, -0.2]) and grid.shape == (19, 9, 15) and grid.is_occupied.all()
    shell = read(tmp_path / f"a.{ending}", resolution=0.1, solid=False)
    assert isinstance(shell, OccupancyGrid)
    assert shell.is_occupied.sum() == 19 * 9 * 15 - 17 * 7 * 13  # no hole in it
    part = read(tmp_path / f"a.{ending}", resolution=0.1, box=[[2.55, -1.5, -0.2], [2.85, -1.2, 9.0]])
    assert isinstance(part, OccupancyGrid) and part.shape == (4, 3, 15) and np.allclose(part.origin, [2.5, -1.5, -0.2])


def test_seams_of_textures_and_normals_open_no_mesh(tmp_path: Path) -> None:
    """Modellers write corners once per face, with a normal and a place on the texture of each."""
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box(extents=[2, 1, 1])
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"vn {x} {y} {z}" for x, y, z in box.face_normals]
    lines += [f"vt {i / 36} 0.5" for i in range(36)]
    for i, corners in enumerate(box.faces):
        lines.append("f " + " ".join(f"{v + 1}/{3 * i + j + 1}/{i + 1}" for j, v in enumerate(corners)))
    (tmp_path / "a.obj").write_text("\n".join(lines))
    grid = read(tmp_path / "a.obj", resolution=0.1)
    assert isinstance(grid, OccupancyGrid) and grid.is_occupied.all()


@pytest.mark.parametrize("first", range(8))
def test_a_wall_whose_door_is_cut_out_of_one_face_is_refused(first: int, tmp_path: Path) -> None:
    """Divided into a fan of triangles the face would cover its door; a face without inner corners is read."""
    wall = [(0, 0), (1.5, 0), (1.5, 1.5), (2.5, 1.5), (2.5, 0), (4, 0), (4, 2), (0, 2)]
    corners = "".join(f"v {x} 0.05 {z}\n" for x, z in wall[first:] + wall[:first])
    (tmp_path / "a.obj").write_text(corners + "f 1 2 3 4 5 6 7 8\n")
    with pytest.raises(InputError, match="faces with inner corners"):
        read(tmp_path / "a.obj", resolution=0.25)


def test_faces_of_many_corners_are_read(tmp_path: Path) -> None:
    around = [(1 + np.cos(k), 1 + np.sin(k)) for k in np.linspace(0, 2 * np.pi, 9)[:-1]]
    corners = "".join(f"v {x} {y} {z}\n" for z in (0, 2) for x, y in around)
    sides = "".join(f"f {k + 1} {(k + 1) % 8 + 1} {(k + 1) % 8 + 9} {k + 9}\n" for k in range(8))
    (tmp_path / "a.obj").write_text(f"{corners}f 8 7 6 5 4 3 2 1\nf 9 10 11 12 13 14 15 16\n{sides}")
    grid = read(tmp_path / "a.obj", resolution=0.1)
    assert grid.occupied[10, 10].all() and not grid.occupied[0, 0].any()


def test_an_open_mesh_is_a_surface(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    vertices = [[0, 0, 0], [4, 0, 0], [4, 3, 2], [0, 3, 2]]
    trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "roof.stl")
    grid = read(tmp_path / "roof.stl", resolution=0.25)
    assert isinstance(grid, OccupancyGrid)
    x, y = np.meshgrid(np.linspace(0.01, 3.99, 200), np.linspace(0.01, 2.99, 200))
    on_it = np.stack([x, y, 2 / 3 * y], -1).reshape(-1, 3)
    cells = grid.cell(on_it)
    missed = ~grid.is_occupied[tuple(cells.T)]
    middle = np.abs(on_it - (grid.origin + 0.25 * (cells + 0.5))).max(-1)
    assert (middle[missed] > 0.06).all()  # only corners of cells are left out
    assert missed.mean() < 0.1 and grid.is_occupied.mean() < 0.2
    with pytest.raises(InputError, match="a closed surface, or solid=False"):
        read(tmp_path / "roof.stl", resolution=0.25, solid=True)
    trimesh.Trimesh(np.array(vertices) * [1, 1, 0], [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "floor.stl")
    with pytest.raises(InputError, match="larger cells"):
        read(tmp_path / "floor.stl", resolution=1e-3)


def test_a_mesh_reads_no_other_file(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    corners = "\n".join(f"v {x} {y} 0" for x, y in ((0, 0), (1, 0), (0, 1)))
    (tmp_path / "a.obj").write_text(f"mtllib ../../etc/passwd\n{corners}\nusemtl a\nf 1 2 3\n")
    grid = read(tmp_path / "a.obj", resolution=0.5)
    assert isinstance(grid, OccupancyGrid) and grid.is_occupied.any()


def test_scans_from_the_air(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    points = np.random.default_rng(1).uniform(-50, 50, (100, 3)).round(3) + np.array([4e5, 5e6, 100])
    file = laspy.create(point_format=0, file_version="1.2")
    file.header.offsets, file.header.scales = points.min(0), np.full(3, 1e-3)
    file.x, file.y, file.z = points.T
    for name in ("a.las", "a.laz"):
        file.write(tmp_path / name)
        cloud = read(tmp_path / name, radius=0.2)
        assert isinstance(cloud, PointCloud) and np.abs(cloud.points - points).max() < 1e-3
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-500])
        with pytest.raises(InputError, match="a las or laz file"):
            read(tmp_path / name, radius=0.2)


def test_grids_of_the_movingai_benchmarks(tmp_path: Path) -> None:
    rows = ["@@@@", "@.GT", "WSO."]
    (tmp_path / "a.map").write_text("type octile\nheight 3\nwidth 4\nmap\n" + "\n".join(rows) + "\n")
    grid = read(tmp_path / "a.map", resolution=0.5, origin=[1.0, 2.0])
    assert isinstance(grid, OccupancyGrid) and grid.origin.tolist() == [1.0, 2.0]
    expected = [[row[x] not in ".GS" for row in reversed(rows)] for x in range(4)]
    assert grid.occupied.tolist() == expected
    for old, new, said in (("GT", "G", "3 characters in line 6"), ("GT", "GX", "in line 6, column 4"),
                           ("height 3", "height 4", "4 rows of 4"), ("map", "mop", "in line 4")):  # fmt: skip
        (tmp_path / "b.map").write_text((tmp_path / "a.map").read_text().replace(old, new))
        with pytest.raises(InputError, match=said):
            read(tmp_path / "b.map", resolution=0.5)


@pytest.mark.parametrize("ending", ["jpg", "tif", "ppm"])
def test_further_images(ending: str, tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.kron(255 * (1 - samples.ROOM), np.ones((8, 8))).astype(np.uint8)).save(tmp_path / f"a.{ending}")
    grid = read(tmp_path / f"a.{ending}", resolution=0.1)
    assert isinstance(grid, OccupancyGrid)
    assert (grid.occupied == np.kron(samples.ROOM, np.ones((8, 8)))[::-1].T).all()


@pytest.mark.parametrize("name", ["a.bt", "a.ot"])
def test_a_part_of_a_tree(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(samples.b64decode(samples.BT if name == "a.bt" else samples.OT))
    whole = read(tmp_path / name)
    box = [[-0.5, 0.6, -0.3], [0.3, 1.0, 0.5]]
    found = read(tmp_path / name, box=box)
    assert isinstance(whole, OccupancyGrid) and isinstance(found, OccupancyGrid)
    at = np.stack(np.meshgrid(*(np.arange(a, b, 0.05) for a, b in np.array(box).T), indexing="ij"), -1).reshape(-1, 3)
    inside = (found.cell(at) >= 0).all(-1) & (found.cell(at) < found.shape).all(-1)
    expected = whole.occupied[tuple(whole.cell(at).T)]
    assert np.array_equal(found.occupied[tuple(found.cell(at[inside]).T)], expected[inside], equal_nan=True)
    assert np.isnan(expected[~inside]).all()  # the grid is as small as what is known
    with pytest.raises(InputError, match="known cells in the box"):
        read(tmp_path / name, box=[[5, 5, 5], [6, 6, 6]])


def test_a_tree_that_is_larger_than_a_grid_is_read_in_part(tmp_path: Path) -> None:
    # Two leaves in opposite corners of the space: the root's first child occupied, its last one free.
    word = 2 | 1 << 14
    head = b"# Octomap OcTree binary file\nid OcTree\nsize 3\nres 0.1\ndata\n"
    (tmp_path / "a.bt").write_bytes(head + word.to_bytes(2, "little"))
    with pytest.raises(InputError, match="read a part by `box` or `layer`"):
        read(tmp_path / "a.bt")
    grid = read(tmp_path / "a.bt", box=[[-1, -1, -1], [1, 1, 1]])
    assert isinstance(grid, OccupancyGrid) and grid.shape == (20, 20, 20)
    known = grid.occupied[~grid.is_unknown]
    assert known.size == 2000 and grid.is_occupied[:10, :10, :10].all() and not grid.is_occupied[10:, 10:, 10:].any()
    with pytest.raises(InputError, match="box: expected corners of 3 coordinates"):
        read(tmp_path / "a.bt", box=[[-1, -1], [1, 1]])


def test_points_in_a_box(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", [[0.0, 0.0], [1.05, 0.0], [1.2, 0.0]])
    cloud = read(tmp_path / "a.npy", radius=0.1, box=[[-1, -1], [1, 1]])
    assert isinstance(cloud, PointCloud) and cloud.points.tolist() == [[0.0, 0.0], [1.05, 0.0]]
    for box, said in (([[1, 1], [0, 2]], "low < high"), ([[5, 5], [6, 6]], "a point in the box"), (3, "two corners")):
        with pytest.raises(InputError, match=said):
            read(tmp_path / "a.npy", radius=0.1, box=box)


def test_what_converts_another_format_is_named(tmp_path: Path) -> None:
    for name, said in (("a.glb", "trimesh"), ("a.pdf", "pdftoppm"), ("a.e57", "pdal"), ("a.html", "ends with .npz")):
        with pytest.raises(InputError, match=said):
            read(tmp_path / name)


def test_costmaps_and_messages_of_ros() -> None:
    costs = np.array([[0, 100, 253], [254, 255, 0]], np.uint8)  # rows of y
    grid = OccupancyGrid.from_costmap(costs, [1.0, 2.0], 0.05)
    assert grid.is_occupied.tolist() == [[False, True], [False, False], [False, False]]
    assert grid.is_unknown.tolist() == [[False, False], [False, True], [False, False]]
    assert OccupancyGrid.from_costmap(costs, [1.0, 2.0], 0.05, occupied_from=253).is_occupied.sum() == 2
    with pytest.raises(InputError, match="0 to 255, got -1 to 7"):
        OccupancyGrid.from_costmap([[-1, 7]], [0.0, 0.0], 0.05)
    level = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    place = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=0.0), orientation=level)
    info = SimpleNamespace(width=3, height=2, resolution=0.05, origin=place)
    message = SimpleNamespace(info=info, data=[0, 49, 50, 100, -1, 0])
    same = OccupancyGrid.from_ros(message)
    assert same.is_occupied.tolist() == [[False, True], [False, False], [True, False]]
    assert same.is_unknown.sum() == 1 and same.is_unknown[1, 1] and same.origin.tolist() == [1.0, 2.0]
    with pytest.raises(InputError, match="2 x 3 whole numbers"):
        OccupancyGrid.from_ros(SimpleNamespace(info=info, data=[0, 1]))
    with pytest.raises(InputError, match="isn't turned"):
        level.z = 0.1
        OccupancyGrid.from_ros(message)
    with pytest.raises(InputError, match="with info and data"):
        OccupancyGrid.from_ros(costs)


def test_a_distance_field_of_another_program() -> None:
    x, y = np.meshgrid(0.1 * (np.arange(40) + 0.5), 0.1 * (np.arange(30) + 0.5), indexing="ij")
    distances = np.hypot(x - 2.0, y - 1.5) - 0.6
    distances[0] = np.nan
    grid = OccupancyGrid.from_esdf(distances, [0.0, 0.0], 0.1)
    assert grid.is_unknown.sum() == 30 and np.array_equal(grid.is_occupied, distances <= 0)
    found = DistanceField.of(grid, unknown="free").distance(np.array([[1.0, 1.5], [3.5, 1.5]]))
    assert np.abs(found.numpy() - [0.4, 0.9]).max() < 0.1
    for wrong in (np.ones((3, 3), int), -np.ones((3, 3))):
        with pytest.raises(InputError, match="above 0 in free cells"):
            OccupancyGrid.from_esdf(wrong, [0.0, 0.0], 0.1)
