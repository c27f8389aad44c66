"""What sensors measure: their rays, their draws, noise and missed returns."""

import numpy as np
import pytest

from torchgco.base.errors import InputError
from torchgco.exploration.sensing import Depth, Lidar, World
from torchgco.exploration.sensing.sensors import Motion, turned

NOWHERE, LEVEL = np.zeros(3), np.array([1.0, 0, 0, 0])


def shell(radius: float) -> World:
    """A room of six thick walls around the origin, so that every ray meets something."""
    rows = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            center, half = np.zeros(3), np.full(3, radius + 2.0)
            center[axis], half[axis] = side * (radius + 1.0), 1.0
            rows.append(np.concatenate([center, np.eye(3).ravel(), half, [0.0]]))
    return World(np.array(rows), Motion.steady(np.zeros((6, 3))))


def test_a_lidar_without_noise_measures_the_walls() -> None:
    scan = Lidar(noise=0.0, rays=(90, 20)).scan(shell(3.0), NOWHERE, LEVEL, 0.0, (0, 0, 0))
    ends = scan.directions * scan.distances[:, None]
    assert len(scan.distances) == 1800
    assert np.allclose(np.abs(ends).max(axis=1), 3.0)
    elevation = np.degrees(np.arcsin(scan.directions[:, 2]))
    assert -47.5 < elevation.min() < -40 and 40 < elevation.max() < 47.5
    assert np.allclose(scan.directions.mean(axis=0)[:2], 0.0, atol=1e-9)  # all around


def test_a_field_of_view_in_azimuth_is_straight_ahead() -> None:
    lidar = Lidar(field_of_view=(90.0, 10.0), rays=(90, 4))
    scan = lidar.scan(shell(3.0), NOWHERE, LEVEL, 0.0, (0, 0, 0))
    azimuth = np.degrees(np.arctan2(scan.directions[:, 1], scan.directions[:, 0]))
    assert np.abs(azimuth).max() < 46 and azimuth.max() > 43 and azimuth.min() < -43


def test_rays_turn_with_the_vehicle() -> None:
    yaw = np.array([np.cos(0.4), 0, 0, np.sin(0.4)])  # by 0.8 rad
    ahead = Depth(rays=(41, 31)).scan(shell(3.0), NOWHERE, yaw, 0.0, (0, 0, 0)).directions.mean(axis=0)
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(0.8, abs=0.03)
    assert np.allclose(turned(yaw) @ turned(yaw).T, np.eye(3))
    assert np.allclose(turned(np.array([np.cos(0.1), np.sin(0.1), 0, 0])) @ [0, 1, 0], [0, np.cos(0.2), np.sin(0.2)])


def test_a_depth_camera_sees_its_field_of_view_alone() -> None:
    d = Depth(field_of_view=(90.0, 60.0)).scan(shell(3.0), NOWHERE, LEVEL, 0.0, (0, 0, 0)).directions
    across, down = np.abs(d[:, 1] / d[:, 0]).max(), np.abs(d[:, 2] / d[:, 0]).max()
    assert 0.97 < across < 1.02 and 0.56 < down < 0.60


def test_draws_depend_on_their_key_alone() -> None:
    lidar, world = Lidar(missed=0.1, rays=(60, 8)), shell(3.0)
    first = lidar.scan(world, NOWHERE, LEVEL, 0.0, (3, 5, 7))
    again = lidar.scan(world, NOWHERE, LEVEL, 0.0, (3, 5, 7))
    assert np.array_equal(first.distances, again.distances)
    for key in ((4, 5, 7), (3, 6, 7), (3, 5, 8)):
        assert not np.array_equal(lidar.scan(world, NOWHERE, LEVEL, 0.0, key).distances, first.distances)


def test_noise_and_missed_returns_have_their_sizes() -> None:
    world = shell(3.0)
    exact = Lidar(noise=0.0).scan(world, NOWHERE, LEVEL, 0.0, (0, 0, 0)).distances
    noisy = Lidar(noise=0.05, missed=0.2).scan(world, NOWHERE, LEVEL, 0.0, (0, 0, 0)).distances
    seen = np.isfinite(noisy)
    assert np.std(noisy[seen] - exact[seen]) == pytest.approx(0.05, rel=0.05)
    assert (~seen).mean() == pytest.approx(0.2, rel=0.1)
    depth = Depth(noise=0.01)
    assert np.allclose(depth.spread(np.array([1.0, 2.0])), [0.01, 0.04])


def test_nothing_comes_back_from_beyond_the_range() -> None:
    assert np.isinf(Lidar(range=2.9, rays=(20, 2)).scan(shell(3.0), NOWHERE, LEVEL, 0.0, (0, 0, 0)).distances).all()


@pytest.mark.parametrize(
    ("kind", "options", "field"),
    [
        (Lidar, {"range": 0.0}, "lidar.range"),
        (Lidar, {"field_of_view": (361.0, 30.0)}, "lidar.field_of_view"),
        (Lidar, {"missed": 1.5}, "lidar.missed"),
        (Depth, {"rays": (0, 10)}, "depth.rays"),
        (Depth, {"rate": 0.0}, "depth.rate"),
        (Depth, {"field_of_view": (180.0, 30.0)}, "depth.field_of_view"),
    ],
)
def test_options_out_of_range_are_named(kind: type, options: dict, field: str) -> None:
    with pytest.raises(InputError, match=field):
        kind(**options)
