"""Clouds from files: the points that were written, in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.maps.files import samples
from tests.maps.files.samples import PACKED_POINTS, POINTS
from torchgco import InputError
from torchgco.maps import PointCloud, read


def points_of(path: Path) -> np.ndarray:
    cloud = read(path, radius=0.1)
    assert isinstance(cloud, PointCloud) and cloud.radius == 0.1
    return cloud.points


@pytest.mark.parametrize(
    "name", ["points.npy", "points.xyz", "ascii.pcd", "binary.pcd", "ascii.ply", "little.ply", "big.ply"]
)
def test_all_formats_hold_the_same_points(name: str, tmp_path: Path) -> None:
    np.testing.assert_array_equal(points_of(samples.write(tmp_path, name)), POINTS)


def test_points_packed_by_lzf(tmp_path: Path) -> None:
    np.testing.assert_array_equal(points_of(samples.write(tmp_path, "packed.pcd")), PACKED_POINTS)


@pytest.mark.parametrize(
    "text", ["1 2\n3 4", "1,2\n\n# none\n3, 4\n", "1;2\n 3;4", "\t1 2 # first\n3 4\r\n", "1 2 0\n3 4 0"]
)
def test_text_in_many_hands(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text(text)
    found = points_of(tmp_path / "a.xyz")
    assert found[:, :2].tolist() == [[1, 2], [3, 4]] and found.shape[1] == (3 if "0" in text else 2)


def test_missing_returns_are_no_points(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(samples.npy(np.array([[np.nan, 1, 1], [1, 2, 3], [np.inf, 0, 0]])))
    assert points_of(tmp_path / "a.npy").tolist() == [[1, 2, 3]]
    (tmp_path / "a.xyz").write_text("nan 0 0\n1 2 3\n")
    assert points_of(tmp_path / "a.xyz").tolist() == [[1, 2, 3]]


def test_fortran_order_and_other_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(samples.npy(np.asfortranarray(POINTS.astype(">f4"))))
    np.testing.assert_array_equal(points_of(tmp_path / "a.npy"), POINTS)


@pytest.mark.parametrize(("name", "data", "said"), [
    ("a.xyz", b"", "no line of numbers"),
    ("a.xyz", b"1\n2\n", "1 in the first line"),
    ("a.xyz", b"1 2 3\n4 five 6\n", "'4 five 6' in line 2"),
    ("a.xyz", b"# x y z\n\n1 2 3\n4 5\n", "'4 5' in line 4"),
    ("a.xyz", b"2,0477;0,8897;-1,5103\n", "commas beside other separators; for decimal commas: sed"),
    ("a.xyz", b"640 480\n1 2 3\n4 5 6\n", "2 in the first line, which may be a heading, and 3 in the last"),
    ("a.xyz", b"2 0 1\n0,5 1,5 2\n", "commas beside other separators"),
    ("a.xyz", b"0,1, 0,2, 0,3\n", "commas beside other separators"),
    ("a.xyz", b"1,2,3\n0.1,,0.3,7\n", "a line without one of its first numbers"),
    ("a.xyz", b"nan nan nan\n", "none of them finite"),
    ("a.xyz", b"1 2 3e8\n", "coordinates within 1e\\+07 m, got .*3e\\+08"),
    ("a.npy", b"", "an npy file"),
    ("a.npy", samples.npy(np.zeros(3)), "points \\(P, 2 or 3\\)"),
    ("a.npy", samples.npy(np.zeros((2, 3), complex)), "complex128"),
    ("a.npy", samples.npy(np.zeros((4, 3)))[:-1], "an npy file of numbers.*greater than file size"),
    ("a.pcd", b"VERSION 0.7\n", "none in line 2, byte 12"),
    ("a.pcd", samples.pcd("ascii").replace(b"FIELDS intensity x", b"FIELDS intensity u"), "fields intensity u y z rgb"),
    ("a.pcd", samples.pcd("ascii").replace(b"9 1.25", b"9 one"), "'9 one 3.0 -0.5 1 2 3' in line 13"),
    ("a.pcd", samples.pcd("ascii")[:-20], "4 points, got .*3"),
    ("a.pcd", samples.pcd("binary")[:-1], "84 bytes of 4 points at byte 159, got .*83 bytes there"),
    ("a.pcd", samples.pcd("binary").replace(b"WIDTH 4", b"WIDTH 400000000"), "POINTS 400000000 as WIDTH"),
    ("a.pcd", samples.pcd("binary").replace(b"WIDTH 4", b"WIDTH 400000000").replace(b"POINTS 4", b"POINTS 400000000"),
     "at most 33,554,432 points, got .*400,000,000"),
    ("a.pcd", samples.pcd("binary").replace(b"SIZE 2 4", b"SIZE 3 4"), "TYPE F, U or I of 1, 2, 4 or 8 bytes"),
    ("a.pcd", samples.pcd("binary").replace(b"COUNT 1 1", b"COUNT 1 2"), "one x, y and z per point"),
    ("a.pcd", samples.pcd("binary").replace(b"1 1 1 1 3", b"1 1 1 1 9999999"), "at most 256 numbers per point"),
    ("a.pcd", samples.pcd("binary_compressed")[:-1], "59 bytes of compressed points"),
    ("a.pcd", samples.pcd("binary_compressed")[:-58] + bytes(58), "480 bytes packed by LZF"),
    ("a.ply", b"solid\n", "a header that ends with end_header, got .*solid"),
    ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "0 points, none of them finite"),
    ("a.ply", samples.ply("ascii").replace(b"property uchar red", b"property list uchar int red"), "without lists"),
    ("a.ply", samples.ply("ascii").replace(b"1.25", b"one"), "a ply file of points with x, y and z"),
    ("a.ply", samples.ply("ascii").replace(b"1.25", b""), "a ply file of points with x, y and z"),
    ("a.ply", samples.ply("ascii").replace(b"property float x", b"property float u"), "points with x, y and z"),
    ("a.ply", samples.ply("middle_endian"), "in format ascii or binary"),
    ("a.ply", samples.ply("binary_little_endian")[:-30], "a ply file of points with x, y and z"),
    ("a.ply", samples.ply("binary_big_endian").replace(b"vertex 4", b"vertex 99999999999"), "at most 33,554,432 rows"),
])  # fmt: skip
def test_wrong_clouds(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    samples.write(tmp_path, name, data)
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / name, radius=0.1)
    assert error.value.field == "map.path" and str(tmp_path / name) in str(error.value)


def test_no_pickle_is_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{}], object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", occupied=np.array([{}], object), origin=[0], resolution=1)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(InputError, match="without pickles"):
            read(tmp_path / name, radius=0.1)
