"""python -m benchmarks.families.unknown: missions in worlds that the vehicle sees through a lidar alone.

Every case is a study of missions below outputs/unknown, so that a run that was stopped resumes where it was. Missions
fly alone, one after the other. With --write the tables are put into results/unknown.md, with date and commit.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.page import put_between
from benchmarks.lib.provenance import provenance
from torchgco.experiments.statistics.statistics import wilson
from torchgco.missions.outcome import Outcome

FLAT = ["scenario=cylinders", "mission.goal_radius=0.5", "mission.explorer.region=[[-5,110],[-21,21],[0,4]]"]
CASES = {
    "41 cylinders": [*FLAT, "scenario.num_obstacles=41"],
    "81 cylinders": [*FLAT, "scenario.num_obstacles=81"],
    "162 cylinders": [*FLAT, "scenario.num_obstacles=162"],
    "forest, 30 spheres": ["scenario=forest_mission"],
    "walls": ["scenario=walls", "scenario.start=[1,1,0]"],
    "mazes, 3 walls": ["scenario=mazes", "mission.duration=90"],
    "rooms": [
        "scenario=rooms", "mission.duration=120", "mission.explorer.speed=3",
        "mission.explorer.region=[[-2,18],[-2,14],[-1.5,4.5]]",
    ],
}  # fmt: skip
HEAD = (
    "world", "n", *(outcome.name for outcome in Outcome), "safe periods", "flight time", "clearance", "speed",
    "acceleration", "jerk", "kept plans",
)  # fmt: skip
PERIOD = 0.05  # s


def fly(case: str, count: int, outputs: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The trials of one case and the rows of their control periods, flown now or read."""
    folder = outputs / f"{''.join(letter if letter.isalnum() else '-' for letter in case)}-{count}"
    command = [
        sys.executable, "-m", "torchgco", "experiment=mission_unknown", *CASES[case], f"study.layouts={count}",
        "study.workers=1", "study.shard_size=1", "study.figures=false", "device.threads=1", f"hydra.run.dir={folder}",
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    trials, log = pd.read_parquet(folder / "trials.parquet"), pd.read_parquet(folder / "mission.parquet")
    return trials.assign(case=case), log.assign(case=case)


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
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    for case, rows in trials.groupby("case", sort=False):
        steps, cells = log[log["case"] == case], [case, len(rows)]
        for outcome in Outcome:
            count = int((rows["outcome"] == outcome.name).sum())
            low, high = wilson(count, len(rows))
            cells.append(f"{count} [{100 * low:.0f}, {100 * high:.0f}]" if count else "0")
        reached, (speed, acceleration, jerk) = rows[rows["outcome"] == Outcome.REACHED.name], largest(steps)
        cells += [f"{int(steps['safe'].sum())} of {len(steps)}", f"{reached['flight_time'].median():.1f} s"]
        cells += [f"{rows['clearance'].min():.3f} m", f"{speed:.2f}", f"{acceleration:.1f}", f"{jerk:.0f}"]
        cells.append(f"{rows['shifted_plans'].mean():.1f}")
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def misses(trials: pd.DataFrame, log: pd.DataFrame) -> str:
    """Markdown: a row per mission that missed its goal, and per mission with a period without a safe plan."""
    lines = [
        "| world | number | outcome | after | clearance | from the goal | periods without a safe plan |",
        "|---" * 7 + "|",
    ]
    for row in trials.itertuples():
        steps = log[(log["case"] == row.case) & (log["mission"] == row.layout)]
        without = int((steps["safe"] == 0).sum())
        if row.outcome != Outcome.REACHED.name or without:
            lines.append(
                f"| {row.case} | {row.layout} | {row.outcome} | {row.flight_time:.1f} s | {row.clearance:.3f} m | "
                f"{row.goal_distance:.1f} m | {without} of {len(steps)} |"
            )
    return (
        "\n".join(lines) if len(lines) > 2 else "Every mission reached its goal, and held a safe plan in every period."
    )


def times(log: pd.DataFrame) -> str:
    """Markdown: milliseconds of the planner and of its parts, over the periods of all missions but their first."""
    later, lines = log[log["step"] > 0], ["| milliseconds | median | 90 % | 99 % | longest |", "|---" * 5 + "|"]
    names = {
        "map: a scan's cells": "map_seconds", "field: distances and corridors": "field_seconds",
        "search for paths": "search_seconds", "planner, all of it": "planner_seconds",
    }  # fmt: skip
    for label, name in names.items():
        values = 1000.0 * later[name].to_numpy()
        lines.append(
            f"| {label} | " + " | ".join(f"{np.quantile(values, q):.1f}" for q in (0.5, 0.9, 0.99, 1.0)) + " |"
        )
    over = int((later["planner_seconds"] > PERIOD).sum())
    return "\n".join([*lines, "", f"{over} of {len(later)} periods took longer than 50 ms."])


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.families.unknown", description="Fly what isn't known.")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES), metavar="NAME")
    parser.add_argument("--count", type=int, default=8, help="missions of a case")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "unknown")
    parser.add_argument("--write", action="store_true", help="put the tables into benchmarks/results/unknown.md")
    asked = parser.parse_args(words)
    flown = [fly(case, asked.count, asked.outputs) for case in asked.cases]
    trials, log = (pd.concat(parts, ignore_index=True) for parts in zip(*flown, strict=True))
    origin = provenance("cpu")
    head = (
        f"Flown on {origin['date']} at commit {origin['commit']}, seed 0, 95 % Wilson intervals in percent; one\n"
        f"thread, {origin['processor']}, shared."
    )
    blocks = {"worlds": f"{head}\n\n{table(trials, log)}\n\n{misses(trials, log)}", "times": times(log)}
    for name, text in blocks.items():
        print(text)
        if asked.write:
            put_between(RESULTS / "unknown.md", f"<!-- {name} -->", f"<!-- end {name} -->", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
