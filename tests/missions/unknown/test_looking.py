"""From where a vehicle sees what its sensor can't be turned to."""

import numpy as np
import pytest

from torchgco.missions.sensing import Depth, Lidar
from torchgco.missions.sensing.grid import FREE, OCCUPIED, UNKNOWN, SeenMap
from torchgco.missions.sensing.sensors import Sensor
from torchgco.missions.unknown.looking import Look, goes_there, in_view, states, unknown_near, viewpoint

KEEP = 0.5
AT = np.array([0.1, 0.1, -0.1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 2.5, 2.5, 2.5, 2.5])


def under_a_door() -> SeenMap:
    """A room of 8 x 8 x 3 m with a door of 1.6 m in its ceiling, above which nothing is known."""
    seen = SeenMap(np.array([-4.0, -4.0, -1.5]), (40, 40, 30), 0.2)
    seen.state[:, :, :15] = FREE
    seen.state[:, :, 15] = OCCUPIED
    seen.state[16:24, 16:24, 15] = FREE
    seen.measure(np.zeros(3), np.array(seen.shape))
    return seen


@pytest.mark.parametrize("sensor", [Lidar(), Lidar(field_of_view=(120.0, 60.0)), Depth()])
def test_the_field_of_view_is_that_of_the_rays(sensor: Sensor) -> None:
    rays, rng = sensor.pattern(np.zeros(2)), np.random.default_rng(0)
    assert sensor.views(rays).mean() > 0.9
    drawn = rng.normal(size=(400, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    away = np.linalg.norm(rays / np.linalg.norm(rays, axis=1, keepdims=True) - drawn[:, None], axis=-1).min(axis=1)
    assert (away[sensor.views(drawn)] < sensor.pitch).all() and 20 < sensor.views(drawn).sum() < 380
    assert (away[~sensor.views(drawn)] > 0.2 * sensor.pitch).mean() > 0.95


def test_cells_near_a_path_are_those_that_are_unknown() -> None:
    seen = under_a_door()
    cells = unknown_near(seen, np.array([[0.1, 0.1, 1.4]]), KEEP)
    assert len(cells) > 4 and (states(seen, cells) == UNKNOWN).all() and (cells[:, 2] > 1.6).all()
    away = np.maximum(np.abs(cells - [0.1, 0.1, 1.4]) - 0.1, 0.0)
    assert (np.linalg.norm(away, axis=1) < KEEP).all()
    assert len(unknown_near(seen, np.array([[0.1, 0.1, 0.0]]), KEEP)) == 0


def test_what_is_above_is_seen_from_aside() -> None:
    seen, sensor = under_a_door(), Lidar()
    cells = unknown_near(seen, np.array([[0.1, 0.1, 1.4]]), KEEP)
    assert not in_view(sensor, AT, AT[None, :3] + [0, 0, 1.2], cells).any()
    place = viewpoint(seen, sensor, AT, cells, KEEP, [])
    assert place is not None and in_view(sensor, AT, place[None], cells).any()
    assert seen.gaps(place[None], KEEP)[0] >= KEEP
    other = viewpoint(seen, sensor, AT, cells, KEEP, [place])
    assert other is not None and np.linalg.norm(other - place) > 0.5


def test_nothing_is_seen_through_a_ceiling() -> None:
    seen = under_a_door()
    seen.state[:, :, 15] = OCCUPIED
    assert viewpoint(seen, Lidar(), AT, np.array([[0.1, 0.1, 2.1]]), KEEP, []) is None


def test_a_look_ends_where_it_was_to_go_or_when_all_is_known() -> None:
    seen, sensor, look = under_a_door(), Lidar(), Look()
    cells = unknown_near(seen, np.array([[0.1, 0.1, 1.4]]), KEEP)
    assert not look.goes_on(seen, AT[:3], 60)
    assert look.begin(seen, sensor, AT, cells, KEEP) and look.place is not None
    assert look.goes_on(seen, AT[:3], 60) and not look.goes_on(seen, look.place + 0.1, 60)
    assert look.begin(seen, sensor, AT, cells, KEEP) and len(look.tried) == 2
    assert not [look.goes_on(seen, AT[:3], 3) for _ in range(4)][-1]
    assert look.begin(seen, sensor, AT, cells, KEEP)
    seen.state[:] = FREE
    assert not look.goes_on(seen, AT[:3], 60)


def test_a_vehicle_goes_on_to_the_end_of_what_is_known() -> None:
    seen = under_a_door()
    path = np.column_stack([np.full(10, 0.1), np.full(10, 0.1), np.arange(-0.1, 3.6, 0.4)])
    end = np.array([0.1, 0.1, 1.1])
    assert goes_there(seen, AT[:3], path, end, KEEP)
    assert goes_there(seen, path[1] + 0.05, path[1:], end, KEEP)
    assert not goes_there(seen, AT[:3], path, None, KEEP)
    assert not goes_there(seen, AT[:3] - [0, 0, 4.0], path, end, KEEP)
    assert not goes_there(seen, AT[:3], path, end - [0, 0, 0.6], KEEP)
    for state, layers in ((FREE, slice(16, 20)), (OCCUPIED, slice(24, 26))):
        seen = under_a_door()
        seen.state[:, :, layers] = state
        assert not goes_there(seen, AT[:3], path, end, KEEP)
