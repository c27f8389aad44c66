"""python -m benchmarks.families.unknown: missions in worlds that the vehicle sees on the way, at rest and moving.

Every case is a study of missions below outputs/unknown, so that a run that was stopped resumes where it was. Missions
fly alone, one after the other, in one thread. With --write the tables are put into results/maps.md, with date and
commit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.page import chosen, filed, machine, markdown, origin, put, tally
from benchmarks.lib.studies import flown, named
from torchgco.missions.outcome import Outcome


@dataclass(frozen=True)
class Case:
    """A kind of world.

    Args:
        overrides: of `torchgco experiment=mission_unknown`.
        count: missions that the table flies.
        at_rest: whether nothing moves, so that plans can be safe.
    """

    overrides: tuple[str, ...]
    count: int
    at_rest: bool = True


# About the rays of the published set-ups' lidar: 20,000 in a scan, over 59 degrees.
DENSE = ("mission.lidar.rays=[480,40]", "mission.lidar.field_of_view=[360,60]")
# Doors in ceilings lie straight above: rays in all directions.
ALL_AROUND = ("mission.lidar.rays=[240,64]", "mission.lidar.field_of_view=[360,180]")
START = ("mission.goal_radius=0.5", "scenario.start=[0,0,3]", "scenario.goal=[305,0,3]")


def _flat(count: int) -> tuple[str, ...]:
    """SANDO's static forests."""
    region = "mission.explorer.region=[[-5,110],[-21,21],[0,4]]"
    return "scenario=cylinders", "mission.goal_radius=0.5", region, f"scenario.num_obstacles={count}", *DENSE


def _moving(count: int, movers: str) -> tuple[str, ...]:
    """SANDO's fields of trefoils. Behind each body lies space that was never seen: it counts as empty."""
    region = "mission.explorer.region=[[-5,110],[-12,12],[0,6]]"
    known = (f"mission.explorer.movers={movers}", "mission.duration=50", "mission.unknown=free")
    return "scenario=trefoils", f"scenario.num_obstacles={count}", "mission.goal_radius=0.5", region, *known


CASES = {
    **{f"{count} cylinders": Case(_flat(count), 6) for count in (41, 81, 162)},
    "300 m, 569 cylinders": Case(
        (
            "scenario=cylinders", "scenario.num_obstacles=569", "scenario.region=[[5,305],[-20,20]]", *START, *DENSE,
            "mission.explorer.region=[[-5,310],[-21,21],[0,6]]", "mission.explorer.speed=4", "mission.duration=150",
        ), 2,
    ),
    "forest, 30 spheres": Case(("scenario=forest_mission",), 8),
    "walls": Case(("scenario=walls", "scenario.start=[1,1,0]"), 8),
    "mazes, 3 walls": Case(("scenario=mazes", "mission.duration=90"), 6),
    "rooms with doors": Case(
        (
            "scenario=rooms", "mission.duration=90", "mission.explorer.speed=3",
            "mission.explorer.region=[[-2,18],[-2,14],[-1.5,4.5]]", *ALL_AROUND,
        ), 4,
    ),
    **{f"{count} moving, known": Case(_moving(count, "known"), 32, at_rest=False) for count in (50, 100, 200)},
    **{f"{count} moving, seen": Case(_moving(count, "tracked"), 32, at_rest=False) for count in (50, 100, 200)},
}  # fmt: skip
HEAD = (
    "world", "n", *(outcome.name for outcome in Outcome), "safe periods", "flight time", "clearance", "speed",
    "acceleration", "jerk", "kept plans", "above 50 ms",
)  # fmt: skip
PERIOD = 0.05  # s


def fly(name: str, count: int, outputs: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The trials of one case and the rows of their control periods, flown now or read."""
    folder = outputs / named(f"{name}-{count}")
    trials = flown(
        folder, "experiment=mission_unknown", *CASES[name].overrides, f"study.layouts={count}", "study.workers=1",
        "study.shard_size=1", "study.figures=false", "device.threads=1",
    )  # fmt: skip
    return trials.assign(case=name), pd.read_parquet(folder / "mission.parquet").assign(case=name)


def largest(log: pd.DataFrame) -> tuple[float, float, float]:
    """The largest speed, m/s, acceleration, m/s^2, and jerk, m/s^3, along an axis, from the control periods' states.

    Acceleration and jerk are differences over a period, of missions one by one.
    """
    found = np.zeros(3)
    for _, rows in log.groupby("mission"):
        v = rows[["x3", "x4", "x5"]].to_numpy()
        for order in range(3):
            if len(v) > order:
                change = np.diff(v, n=order, axis=0) / PERIOD**order
                found[order] = max(found[order], float(np.abs(change).max()))
    return float(found[0]), float(found[1]), float(found[2])


def table(trials: pd.DataFrame, log: pd.DataFrame) -> str:
    """Markdown: a row per case, outcomes with 95 % Wilson intervals in percent."""
    lines = []
    for case, rows in trials.groupby("case", sort=False):
        steps, cells = log[log["case"] == case], [case, len(rows)]
        cells += [tally(int((rows["outcome"] == outcome.name).sum()), len(rows)) for outcome in Outcome]
        reached, (speed, acceleration, jerk) = rows[rows["outcome"] == Outcome.REACHED.name], largest(steps)
        safe = f"{int(steps['safe'].sum())} of {len(steps)}" if CASES[str(case)].at_rest else "-"
        late = steps["planner_seconds"][steps["step"] > 0] > PERIOD
        cells += [safe, f"{reached['flight_time'].median():.1f} s" if len(reached) else "-"]
        cells.append(f"{rows['clearance'].min():.3f} m")
        cells += [f"{speed:.2f}", f"{acceleration:.1f}", f"{jerk:.0f}", f"{rows['shifted_plans'].mean():.1f}"]
        cells.append(f"{100 * late.mean():.1f} %")
        lines.append(cells)
    return markdown(HEAD, lines)


def short(name: str, table: str, misses: str) -> str:
    """Both tables as files, and a short form of the first."""
    missed = filed(f"{name}-misses", misses) if misses.startswith("|") else misses
    few = chosen(table, (*HEAD[:5], "flight time", "clearance"))
    return f"{filed(name, table, few)}\n\nMissions that missed, or were without a safe plan:\n\n{missed}"


def misses(trials: pd.DataFrame, log: pd.DataFrame) -> str:
    """Markdown: a row per mission that missed its goal, and per mission at rest with a period without a safe plan."""
    lines = []
    for row in trials.itertuples():
        steps = log[(log["case"] == row.case) & (log["mission"] == row.layout)]
        at_rest, without = CASES[str(row.case)].at_rest, int((steps["safe"] == 0).sum())
        if row.outcome != Outcome.REACHED.name or (at_rest and without):
            lines.append(
                (
                    row.case, row.layout, row.outcome, f"{row.flight_time:.1f} s", f"{row.clearance:.3f} m",
                    f"{row.goal_distance:.1f} m", f"{without} of {len(steps)}" if at_rest else "-",
                )
            )  # fmt: skip
    head = ("world", "number", "outcome", "after", "clearance", "from the goal", "periods without a safe plan")
    none = "Every mission reached its goal, and among obstacles at rest every period held a safe plan."
    return markdown(head, lines) if lines else none


def times(log: pd.DataFrame) -> str:
    """Markdown: milliseconds of the planner and of its parts, over the periods of all missions but their first."""
    later = log[log["step"] > 0]
    names = {
        "map: a scan's cells": "map_seconds", "field: distances and corridors": "field_seconds",
        "search for paths": "search_seconds", "planner, all of it": "planner_seconds",
    }  # fmt: skip
    parts = {label: 1000.0 * later[name].to_numpy() for label, name in names.items()}
    rows = [
        (label, *(f"{np.quantile(values, q):.1f}" for q in (0.5, 0.9, 0.99, 1.0))) for label, values in parts.items()
    ]
    over = int((later["planner_seconds"] > PERIOD).sum())
    head = ("milliseconds", "median", "90 %", "99 %", "longest")
    whole = markdown(head, rows)
    few = chosen(whole, head, milliseconds=(rows[-1][0],))
    return filed("unknown-times", whole, few, f"{over} of {len(later)} periods took longer than 50 ms.")


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.families.unknown", description="Fly what isn't known.")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES), metavar="NAME")
    parser.add_argument("--count", type=int, help="missions of each case; by default its own number")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "unknown")
    parser.add_argument("--write", action="store_true", help="put the tables into benchmarks/results/maps.md")
    asked = parser.parse_args(words)
    for mark, file, at_rest in (("worlds", "unknown", True), ("moving", "unknown-moving", False)):
        names = [name for name in asked.cases if CASES[name].at_rest == at_rest]
        if not names:
            continue
        tables = [fly(name, asked.count or CASES[name].count, asked.outputs) for name in names]
        trials, log = (pd.concat(parts, ignore_index=True) for parts in zip(*tables, strict=True))
        head = f"{origin('Flown')}, seed 0, {machine()}."
        blocks = {mark: f"{head}\n\n{short(file, table(trials, log), misses(trials, log))}"}
        if at_rest:
            blocks["times"] = times(log)
        for name, text in blocks.items():
            print(text)
            if asked.write:
                put(RESULTS / "maps.md", name, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
