"""The page of missions in unknown space: how outcomes, safe periods and limits are counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.causes import unknown as causes
from benchmarks.families.unknown import CASES, largest, misses, table, times
from tests.slow import mostly
from torchgco.experiments.config.build import compose

WORLD, MOVING = "walls", "50 moving, known"


def frames(case: str, safe: list[int], outcomes: list[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two missions of two periods each."""
    trials = pd.DataFrame(
        {
            "case": case, "layout": [0, 1], "outcome": outcomes, "flight_time": [4.0, 6.0], "clearance": [0.5, 0.25],
            "goal_distance": [0.5, 7.0], "shifted_plans": [0, 3],
        }
    )  # fmt: skip
    log = pd.DataFrame({"case": case, "mission": [0, 0, 1, 1], "step": [0, 1, 0, 1], "safe": safe})
    for name, value in (("x3", [0.0, 1.0, 0.0, 0.5]), ("x4", 0.0), ("x5", 0.0)):
        log[name] = value
    for name in ("map_seconds", "field_seconds", "search_seconds"):
        log[name] = 0.001
    return trials, log.assign(planner_seconds=[9.0, 0.02, 9.0, 0.06])


def test_a_row_counts_outcomes_safe_periods_and_late_ones() -> None:
    trials, log = frames(WORLD, [1, 1, 1, 0], ["REACHED", "TIMEOUT"])
    row = table(trials, log).splitlines()[-1].split(" | ")
    assert row[0] == f"| {WORLD}" and row[1] == "2" and row[2].startswith("1 [") and row[3] == "0"
    assert row[6:9] == ["3 of 4", "4.0 s", "0.250 m"] and row[-1] == "50.0 % |"
    lines = misses(trials, log).splitlines()
    assert len(lines) == 3 and "TIMEOUT" in lines[2] and lines[2].endswith("| 1 of 2 |")
    assert times(log).endswith("1 of 2 periods took longer than 50 ms.")


def test_among_moving_bodies_no_period_counts_as_safe() -> None:
    trials, log = frames(MOVING, [0, 0, 0, 0], ["REACHED", "REACHED"])
    assert table(trials, log).splitlines()[-1].split(" | ")[6] == "-"
    assert misses(trials, log).startswith("Every mission reached its goal")


def test_a_miss_among_moving_bodies_says_nothing_of_safe_plans() -> None:
    trials, log = frames(MOVING, [0, 0, 0, 0], ["COLLISION", "TIMEOUT"])
    assert [line.split(" | ")[-1] for line in misses(trials, log).splitlines()[2:]] == ["- |", "- |"]
    assert table(trials, log).splitlines()[-1].split(" | ")[7] == "-"  # none reached: no flight time


def test_limits_are_those_of_each_mission_by_itself() -> None:
    _, log = frames(WORLD, [1, 1, 1, 1], ["REACHED", "REACHED"])
    speed, acceleration, jerk = largest(log)
    assert (speed, acceleration, jerk) == (1.0, pytest.approx(20.0), 0.0)
    steady = log.assign(x3=np.repeat([1.0, 3.0], 2))
    assert largest(steady) == (3.0, 0.0, 0.0)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", mostly(CASES, *list(CASES)[1::2]))
def test_a_case_is_a_mission_that_can_be_composed(name: str) -> None:
    setup = compose(["experiment=mission_unknown", *CASES[name].overrides])
    assert setup.mission is not None and setup.mission.sensor == "lidar"


@pytest.mark.slow
def test_a_mission_is_drawn_at_a_time(tmp_path: Path) -> None:
    target = tmp_path / "one.png"
    assert causes.main(["walls:0:0.5", "--path", str(target)]) == 0
    with Image.open(target) as image:
        assert image.width == causes.WIDTH and image.height > 100
