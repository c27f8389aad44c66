"""Pictures of what a vehicle knows."""

import numpy as np
import pytest
import torch

from benchmarks.causes.seen import seen_figure
from torchgco.base.errors import InputError
from torchgco.missions.log import MissionLog, SeenLog
from torchgco.plotting.bodies import Ball
from torchgco.plotting.course import Course

COURSE = Course((Ball(np.array([2.0, 0.0, 0.0]), 0.5, np.zeros(3)),), np.array([4.0, 0.0, 0.0]), 0.5, 0.2)


def flown() -> MissionLog:
    """Six control steps along x; in each, a slice of the map becomes free and one cell occupied."""
    log = MissionLog.blank(torch.zeros(1, 17).double(), 8, 5, 0.05, 4)
    seen = SeenLog(np.array([-1.0, -1.0, -1.0]), (20, 8, 8), 0.25)
    index = np.arange(20 * 8 * 8).reshape(20, 8, 8)
    for k in range(6):
        log.x[0, k] = 0.0
        log.x[0, k, 0, 0], log.planner_seconds[0, k] = 0.2 * k, 0.01
        cells = np.append(index[3 * k : 3 * k + 3].ravel(), index[3 * k, 4, 4])
        seen.changes.append((cells.astype(np.int32), np.append(np.ones(len(cells) - 1), 2).astype(np.uint8)))
        seen.safe.append(np.linspace([0.2 * k, 0, 0], [0.2 * k + 1, 0.3, 0], 4))
    log.seen.append(seen)
    return log


def test_a_figure_shows_the_map_of_its_step() -> None:
    for step in (0, 4):
        (ax,) = seen_figure(flown(), 0, COURSE, step, 3.0).axes
        (image,) = ax.get_images()
        shown = np.asarray(image.get_array())  # (y, x)
        assert shown.shape == (8, 20)
        assert (shown[:, : 3 * step + 3] > 0).all() and (shown[:, 3 * step + 3 :] == 0).all()
        assert shown[4, 3 * step] == 2
        lines = [line.get_xydata() for line in ax.get_lines()]
        assert any(np.allclose(np.asarray(line)[-1], [0.2 * step + 1, 0.3]) for line in lines)


def test_what_was_not_flown_or_seen_is_refused() -> None:
    with pytest.raises(InputError, match="one of the 6 control steps"):
        seen_figure(flown(), 0, COURSE, 6)
    log = MissionLog.blank(torch.zeros(1, 17).double(), 2, 5, 0.05, 4)
    with pytest.raises(InputError, match="a mission with a sensor"):
        seen_figure(log, 0, COURSE, 0)
