from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from torchgco.plotting import animation
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.bodies import Ball
from torchgco.plotting.course import Course

PERIOD = 0.05


def course(speed: float) -> Course:
    ball = Ball(np.array([3.0, 1.5, 0.0]), 0.24, np.array([0.0, speed, 0.0]))
    return Course((ball,), np.array([6.0, 0.0, 0.0]), 0.5)


def test_gates_lie_in_the_picture() -> None:
    """Balls and frames, also beside the way that is flown."""
    frame = np.array([[2.0, -4.0, 1.0], [2.0, -3.0, 1.0], [2.0, -3.0, 2.0], [2.0, -4.0, 2.0]])
    whole = replace(course(0.0), gates=((np.array([[8.0, 0.0, 0.0]]), 0.4), (frame, 0.0)))
    low, high = whole.limits(np.stack([np.linspace(0.0, 6.0, 9), np.zeros(9), np.zeros(9)], axis=-1))
    assert (low <= [0.0, -4.0, -0.4]).all() and (high >= [8.4, 0.4, 2.0]).all()


def flown(steps: int) -> tuple[pd.DataFrame, np.ndarray]:
    x = np.linspace(0.0, 6.0, steps)
    frame = pd.DataFrame({"t": PERIOD * np.arange(steps), "x0": x, "x1": 0.0 * x, "x2": 0.0 * x})
    ahead = np.minimum(x[:, None] + 0.5 * np.arange(5), 6.0)
    return frame, np.stack((ahead, 0.0 * ahead, 0.0 * ahead), axis=-1)


def pictures(path: Path) -> tuple[list[np.ndarray], int]:
    """The pictures of a GIF, (height, width, 3), and how long it runs, ms."""
    with Image.open(path) as gif:
        found, duration = [], 0
        for i in range(getattr(gif, "n_frames", 1)):
            gif.seek(i)
            duration += gif.info["duration"]
            found.append(np.asarray(gif.convert("RGB")))
    return found, duration


def changed(a: np.ndarray, b: np.ndarray) -> int:
    return int((a != b).any(axis=-1).sum())


def test_a_mission_plays_in_real_time_and_stands_at_its_end(tmp_path: Path) -> None:
    frame, plans = flown(21)
    found, duration = pictures(mission_animation(frame, plans, course(0.0), PERIOD, tmp_path / "new" / "a.gif"))
    assert len(found) == 6 and duration == 1200 + 1000
    assert all(changed(a, b) > 20 for a, b in pairwise(found))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("steps", [20, 30, 31, 100])
def test_a_long_mission_has_few_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    assert animation.MAX_FRAMES == 100
    monkeypatch.setattr(animation, "MAX_FRAMES", 10)
    frame, plans = flown(steps)
    found, duration = pictures(mission_animation(frame, plans, course(0.0), PERIOD, tmp_path / "a.gif"))
    assert 5 < len(found) <= 10 and duration <= 2000


def test_obstacles_that_move_are_seen_to_move(tmp_path: Path) -> None:
    frame, plans = flown(5)
    for name in ("x0", "x1", "x2"):
        frame[name] = 0.0
    plans = np.zeros_like(plans)
    rest, _ = pictures(mission_animation(frame, plans, course(0.0), PERIOD, tmp_path / "a.gif"))
    moving, _ = pictures(mission_animation(frame, plans, course(-5.0), PERIOD, tmp_path / "b.gif"))
    assert changed(moving[0], moving[-1]) > 2 * changed(rest[0], rest[-1])


def test_what_stays_is_drawn_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And each picture is what the axes drawn anew would show."""
    drawn = list[object]()
    whole = Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda self, renderer: drawn.append(self) or whole(self, renderer))
    frame, plans = flown(41)
    found, _ = pictures(mission_animation(frame, plans, course(0.5), PERIOD, tmp_path / "a.gif"))
    assert len(found) > 8 and len(drawn) <= 2
    alone, _ = pictures(mission_animation(frame, plans[-1:].repeat(41, 0), course(0.5), PERIOD, tmp_path / "b.gif"))
    assert changed(found[-1], alone[-1]) == 0 and changed(found[2], alone[2]) > 0  # nothing of a plan before is left


def test_colours_stay_those_of_the_drawing(tmp_path: Path) -> None:
    frame, plans = flown(3)
    (first, *_), _ = pictures(mission_animation(frame, plans, course(0.0), PERIOD, tmp_path / "a.gif"))
    colours = {tuple(colour) for colour in first.reshape(-1, 3).tolist()}
    assert {(255, 255, 255), (0x56, 0xB4, 0xE9)} <= colours  # paper, vehicle
