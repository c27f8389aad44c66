"""python -m benchmarks.families.missions: how often missions reach their goal, by planner, and how long planning takes.

Every case is a study of missions below outputs/missions, so that a run that was stopped resumes where it was. With
--write the tables are put into results/missions.md, with date and commit; with --times those of the times alone, which
takes a few minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.page import chosen, filed, machine, markdown, origin, put, tally
from benchmarks.lib.studies import flown, named
from torchgco import compose
from torchgco.experiments.statistics.statistics import wilson
from torchgco.missions.outcome import Outcome

START = "scenario.start=[1,1,0]"
CASES = {
    "forest, 30 spheres": [],
    "walls": ["scenario=walls", START],
    "8 spheres at 1 to 3 m/s": [
        "scenario=forest_moving", START, "scenario.num_obstacles=8", "scenario.slowest=1", "scenario.speed=3",
    ],
    "woods, 0.4 trunks per m^2": ["scenario=woods"],
    "mazes, 3 walls": ["scenario=mazes"],
    "forest, a quadrotor of 1.2 kg": ["vehicle.mass=1.2", "vehicle.arm=0.15", "vehicle.thrust_max=4.5"],
    "forest, mass +10 %, wind 0.5 N": ["plant.mass_error=0.1", "mission.disturbance.wind=0.5"],
    "the same with drag 0.1 N s/m": [
        "plant.drag=0.1", "plant.mass_error=0.1", "mission.disturbance.wind=0.5",
    ],
    "the same in drone-models": [
        "plant=drone_models", "plant.drag=0.1", "plant.mass_error=0.1", "mission.disturbance.wind=0.5",
    ],
    "forest, a body of 0.6 x 0.6 x 0.2 m": [
        "+model.vehicle.footprint=[[-0.3,-0.3,-0.1],[0.3,0.3,0.1]]", "+model.vehicle.cells=[2,2,1]",
    ],
}  # fmt: skip
# Planners and how many missions they fly: FATROP plans one problem after the other, and is built again in every period.
PLANNERS = {"gco": 128, "gco_paper": 32, "al_ilqr": 32, "fatrop": 4}
WITH_PEERS = list(CASES)[:3]
TOLERATED = 0.02  # m of violation in a plan: more leads to contact with a wall
SLOW = ("fatrop",)  # planners that fly the first case alone
TIMED = list(CASES)[:5]  # flown alone, for times
PERIOD, CALLS = 50.0, 5  # ms of a period, and calls of the tracker in it
AT_ONCE = 32  # missions planned together: what a stopped run loses at most
HEAD = ("missions", "planner", "n", *(outcome.name for outcome in Outcome), "flight time", "clearance", "kept plans")


def fly(case: str, solver: str, count: int, outputs: Path) -> pd.DataFrame:
    """The trials of one case, flown now or read."""
    folder = outputs / named(f"{case}-{solver}-{count}-0")
    trials = flown(
        folder, "experiment=mission_study", *CASES[case], f"solver={solver}", f"study.layouts={count}",
        "study.baselines=[]", "study.workers=1", f"study.shard_size={AT_ONCE}", "study.figures=false",
    )  # fmt: skip
    return trials.assign(case=case, cause=_causes(trials, pd.read_parquet(folder / "mission.parquet")))


def _causes(trials: pd.DataFrame, log: pd.DataFrame) -> list[str]:
    """Why each mission missed its goal, empty where it didn't: what was planned in its last half second."""
    last = {number: rows.tail(10) for number, rows in log.groupby("mission")}
    causes = []
    for row in trials.itertuples():
        steps = last.get(row.layout)
        if row.outcome == Outcome.REACHED.name:
            causes.append("")
        elif steps is None:
            causes.append("in contact at the start")
        elif row.outcome == Outcome.TIMEOUT.name:
            speed = float(np.linalg.norm(steps[["x3", "x4", "x5"]].to_numpy()[-1]))
            causes.append(f"still {row.goal_distance:.1f} m from the goal, at {speed:.1f} m/s")
        elif steps["violation"].max() > TOLERATED:
            causes.append(f"no plan without contact was found: violation up to {steps['violation'].max():.2f} m")
        else:
            causes.append("contact on a plan without contact: between its knots, or off the plan")
    return causes


def misses(trials: pd.DataFrame) -> str:
    """Markdown: a row per mission of `gco` that missed its goal, with the cause."""
    missed = trials[(trials["solver"] == "gco") & (trials["outcome"] != Outcome.REACHED.name)]
    if missed.empty:
        return "With `gco` no mission missed its goal."
    rows = (
        (row.case, row.layout, row.outcome, f"{row.flight_time:.2f} s", f"{row.clearance:.3f} m", row.cause)
        for row in missed.itertuples()
    )
    head = ("missions", "number", "outcome", "after", "clearance", "cause")
    return f"Every mission that missed its goal with `gco`:\n\n{markdown(head, rows)}"


def table(trials: pd.DataFrame) -> str:
    """Markdown: a row per case and planner, outcomes with 95 % Wilson intervals in percent."""
    lines = []
    for (case, solver), rows in trials.groupby(["case", "solver"], sort=False):
        cells: list[object] = [case, f"`{solver}`", len(rows)]
        cells += [tally(int((rows["outcome"] == outcome.name).sum()), len(rows)) for outcome in Outcome]
        reached = rows[rows["outcome"] == Outcome.REACHED.name]
        cells += [f"{reached['flight_time'].median():.2f} s", f"{reached['clearance'].min():.3f} m"]
        cells.append(f"{rows['shifted_plans'].mean():.1f}")
        lines.append(cells)
    return markdown(HEAD, lines)


def short(table: str, misses: str) -> str:
    """Both tables as files, and some columns of the first."""
    said, _, missed = misses.partition("\n\n")
    few = chosen(table, [name for name in HEAD if name not in ("DIVERGED", "kept plans")])
    return f"{filed('missions', table, few)}\n\n{said}\n\n{filed('missions-misses', missed) if missed else ''}".rstrip()


def many(count: int, outputs: Path) -> str:
    """Markdown: missions of the first case by `gco`, as many as it takes to bound the rate of collisions."""
    trials = fly(next(iter(CASES)), "gco", count, outputs)
    counts = {outcome.name: int((trials["outcome"] == outcome.name).sum()) for outcome in Outcome}
    hits = counts[Outcome.COLLISION.name]
    low, high = (100 * end for end in wilson(hits, count))
    row = (
        f"{count:,}", *(f"{held:,}" for held in counts.values()),
        f"{100 * hits / count:.3g} % [{low:.3g}, {high:.3g}]", f"{trials['flight_time'].median():.2f} s",
        f"{trials['seconds'].mean():.2f}",
    )  # fmt: skip
    head = ("missions", *counts, "rate of collisions", "flight time", "s per mission")
    lines = [
        f"Number {row.layout}: {row.outcome} after {row.flight_time:.2f} s, {row.clearance:.3f} m clear: {row.cause}."
        for row in trials[trials["outcome"] != Outcome.REACHED.name].itertuples()
    ]
    return "\n\n".join([markdown(head, [row]), *lines])


def timing(alone: int, together: int) -> str:
    """Markdown: what a period takes in missions that fly alone, a row per case, and seconds per mission of a batch."""
    head = (
        "missions, each alone", "n", "first plan, ms", "longest", "later periods", "median, ms", "90 %", "99 %",
        "longest", "tracker, ms a call", "missed",
    )  # fmt: skip
    rows, totals = [], []
    for case in TIMED:
        _periods(CASES[case], 0)  # compiles
        parts = [part for seed in range(alone) for part in _periods(CASES[case], seed)]
        totals += [float(part.sum()) / 1000.0 for part in parts if case == TIMED[0]]
        first, every = [float(part[0, 0]) for part in parts], np.concatenate([part[1:] for part in parts])
        missed = int((every.sum(1) > PERIOD).sum())
        cells = [f"{np.quantile(every[:, 0], q):.1f}" for q in (0.5, 0.9, 0.99, 1.0)]
        calls = f"{np.median(every[:, 1]) / CALLS:.2f}"
        begun = f"{np.median(first):.0f}", f"{max(first):.0f}"
        share = f"{missed} ({100 * missed / len(every):.2f} %)"
        rows.append((case, str(alone), *begun, f"{len(every):,}", *cells, calls, share))
    batch = float(np.mean([part.sum() for part in _periods(CASES[TIMED[0]], 0, together)])) / 1000.0
    text = [
        "A period of 50 ms is missed where the planner and the tracker's five calls take longer; elapsed times.",
        "The first plan, by the whole solver from rest, is counted apart: unless obstacles move, a vehicle can wait",
        "for it. `missed_deadlines` of a study counts it, too.",
        f"Planner and tracker take {np.mean(totals):.2f} s for a mission of the first row alone,",
        f"{batch:.2f} s per mission in a batch of {together}.",
    ]
    return "\n".join([markdown(head, rows), "", *text])


def _periods(words: list[str], seed: int, count: int = 1) -> list[np.ndarray]:
    """Milliseconds of planner and tracker in the periods of missions that fly together, (periods, 2) of each."""
    setup = compose(["experiment=mission", *words, f"seed={seed}", "device.threads=1"])
    assert setup.mission is not None
    log = setup.mission.fly(setup.task(setup.layouts(count)).problem, seed=seed)
    took = 1000.0 * torch.stack((log.planner_seconds, log.tracker_seconds), dim=-1).numpy()
    return [part[:steps] for part, steps in zip(took, log.steps(), strict=True)]


def _origin(done: str) -> str:
    return f"{origin(done)}, seed 0, {machine()}."


def _flown(asked: argparse.Namespace) -> str:
    """Markdown: the outcomes of the cases and planners that are asked for."""
    parts = []
    for case in list(CASES)[: asked.cases]:
        for solver in asked.planners if case in WITH_PEERS else asked.planners[:1]:
            if solver not in SLOW or case == WITH_PEERS[0]:
                parts.append(fly(case, solver, max(1, round(asked.share * PLANNERS[solver])), asked.outputs))
    trials = pd.concat(parts)
    return f"{_origin('Flown')}\n\n{short(table(trials), misses(trials))}"


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.families.missions", description="Fly missions, and count."
    )
    parser.add_argument("--cases", type=int, default=len(CASES), help="so many of the cases")
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=list(PLANNERS), metavar="NAME")
    parser.add_argument("--share", type=float, default=1.0, help="of the number of missions")
    parser.add_argument(
        "--alone", type=int, default=20, help="missions that fly alone, for times; 0: the page keeps its times"
    )
    parser.add_argument("--times", action="store_true", help="fly and write the times alone")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "missions")
    parser.add_argument("--write", action="store_true", help="put the tables into benchmarks/results/missions.md")
    parser.add_argument(
        "--many", type=int, default=0, help="only so many missions of the first case by gco, for results/maps.md"
    )
    asked = parser.parse_args(words)
    if asked.many > 0:
        text = f"{_origin('Flown')}\n\n{many(asked.many, asked.outputs)}"
        print(text)
        if asked.write:
            put(RESULTS / "maps.md", "many", text)
        return 0
    blocks = {} if asked.times else {"missions": _flown(asked)}
    if asked.alone > 0:
        together = max(1, min(AT_ONCE, round(asked.share * PLANNERS["gco"])))
        blocks["times"] = f"{_origin('Measured')}\n\n{timing(asked.alone, together)}"
    for name, text in blocks.items():
        print(text)
        if asked.write:
            put(RESULTS / "missions.md", name, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
