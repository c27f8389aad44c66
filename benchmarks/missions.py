"""python -m benchmarks.missions: how often missions reach their goal, by planner, and how long planning takes.

Every case is a study of missions below outputs/missions, so that a run that was stopped resumes where it was. With
--write the tables are put into results/missions.md, with date and commit.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.speed.provenance import provenance
from benchmarks.speed.tables import put_between
from torchgco.experiments.statistics import wilson
from torchgco.outcome import Outcome

ROOT = Path(__file__).resolve().parents[1]
START = "scenario.start=[1,1,0]"
CASES = {
    "forest, 30 spheres": [],
    "walls": ["scenario=walls", START],
    "8 spheres at 1 to 3 m/s": [
        "scenario=forest_moving", START, "scenario.num_obstacles=8", "scenario.slowest=1", "scenario.speed=3",
    ],
    "forest, mass +10 %, wind 0.5 N": ["plant.mass_error=0.1", "mission.disturbance.wind=0.5"],
    "the same with drag 0.1 N s/m": [
        "plant.drag=0.1", "plant.mass_error=0.1", "mission.disturbance.wind=0.5",
    ],
    "the same in drone-models": [
        "plant=drone_models", "plant.drag=0.1", "plant.mass_error=0.1", "mission.disturbance.wind=0.5",
    ],
    "forest, gusts 0.5 N, noise, one period of latency": [
        "mission.disturbance.gust=0.5", "mission.disturbance.position_noise=0.01",
        "mission.disturbance.velocity_noise=0.02", "mission.disturbance.attitude_noise=0.002",
        "mission.disturbance.rate_noise=0.01", "mission.latency=1",
    ],
}  # fmt: skip
# Planners and how many missions they fly: the peers plan one problem after the other, and are built anew at every step.
PLANNERS = {"gco": 128, "gco_paper": 32, "al_ilqr": 32, "fatrop": 4}
WITH_PEERS = list(CASES)[:3]
SLOW = ("fatrop",)  # planners that fly the first case alone
HEAD = ("missions", "planner", "n", *(outcome.name for outcome in Outcome), "flight time", "clearance", "kept plans")


def fly(case: str, solver: str, count: int, outputs: Path, first: int = 0, more: Sequence[str] = ()) -> pd.DataFrame:
    """The trials of one case, flown now or read."""
    name = "".join(letter if letter.isalnum() else "-" for letter in f"{case}-{solver}-{count}-{first}")
    folder = outputs / name
    command = [
        sys.executable, "-m", "torchgco", "experiment=mission_study", *CASES[case], f"solver={solver}", f"seed={first}",
        f"study.layouts={count}", "study.baselines=[]", "study.workers=1", f"hydra.run.dir={folder}", *more,
    ]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return pd.read_parquet(folder / "trials.parquet").assign(case=case)


def table(trials: pd.DataFrame) -> str:
    """Markdown: a row per case and planner, outcomes with 95 % Wilson intervals in percent."""
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    for (case, solver), rows in trials.groupby(["case", "solver"], sort=False):
        cells: list[object] = [case, f"`{solver}`", len(rows)]
        for outcome in Outcome:
            count = int((rows["outcome"] == outcome.name).sum())
            low, high = wilson(count, len(rows))
            cells.append(f"{count} [{100 * low:.0f}, {100 * high:.0f}]" if count else "0")
        reached = rows[rows["outcome"] == Outcome.REACHED.name]
        cells += [f"{reached['flight_time'].median():.2f} s", f"{reached['clearance'].min():.3f} m"]
        cells.append(f"{rows['shifted_plans'].mean():.1f}")
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def timing(outputs: Path, alone: int, together: int) -> str:
    """Markdown: planner and tracker of missions that fly alone, and seconds per mission of a batch against those."""
    case, steps, totals = next(iter(CASES)), [], []
    for seed in range(alone):
        trials = fly(case, "gco", 1, outputs, first=seed, more=["device.threads=1"])
        folder = outputs / "".join(c if c.isalnum() else "-" for c in f"{case}-gco-1-{seed}")
        steps.append(pd.read_parquet(folder / "mission.parquet"))
        totals.append(float(trials["seconds"].iloc[0]))
    batch = float(fly(case, "gco", together, outputs)["seconds"].mean())
    log = pd.concat(steps)
    planner, tracker = 1000 * log["planner_seconds"].to_numpy(), 1000 * log["tracker_seconds"].to_numpy() / 5
    missed = int((log["planner_seconds"] + log["tracker_seconds"] > 0.05).sum())
    rows = [
        ("planner, one mission alone", *np.quantile(planner, [0.5, 0.9, 0.99]), planner.max()),
        ("planner, after the first step", *np.quantile(planner[log["step"] > 0], [0.5, 0.9, 0.99]),
         planner[log["step"] > 0].max()),
        ("tracker, one call", *np.quantile(tracker, [0.5, 0.9, 0.99]), tracker.max()),
    ]  # fmt: skip
    lines = ["| milliseconds | median | 90 % | 99 % | longest |", "|---|---|---|---|---|"]
    lines += [f"| {name} | " + " | ".join(f"{value:.1f}" for value in values) + " |" for name, *values in rows]
    text = [
        f"{alone} missions alone on one core, {len(log)} control periods of 50 ms, {missed} missed deadlines.",
        f"Planner and tracker take {np.mean(totals):.2f} s for a mission alone, {batch:.2f} s per mission in a batch",
        f"of {together}.",
    ]
    return "\n".join([*lines, "", *text])


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.missions", description="Fly missions, and count.")
    parser.add_argument("--cases", type=int, default=len(CASES), help="so many of the cases")
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=list(PLANNERS), metavar="NAME")
    parser.add_argument("--share", type=float, default=1.0, help="of the number of missions")
    parser.add_argument("--alone", type=int, default=20, help="missions that fly alone, for times")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "missions")
    parser.add_argument("--write", action="store_true", help="put the tables into benchmarks/results/missions.md")
    asked = parser.parse_args(words)
    parts = []
    for case in list(CASES)[: asked.cases]:
        for solver in asked.planners if case in WITH_PEERS else asked.planners[:1]:
            if solver in SLOW and case != WITH_PEERS[0]:
                continue
            parts.append(fly(case, solver, max(1, round(asked.share * PLANNERS[solver])), asked.outputs))
    together = max(1, round(asked.share * PLANNERS["gco"]))
    origin = provenance("cpu")
    head = (
        f"Flown on {origin['date']} at commit {origin['commit']}, seed 0, 95 % Wilson intervals in percent; one\n"
        f"thread, {origin['processor']}, shared."
    )
    text = f"{head}\n\n{table(pd.concat(parts))}\n\n{timing(asked.outputs, asked.alone, together)}"
    print(text)
    if asked.write:
        marks = "<!-- missions -->", "<!-- end missions -->"
        put_between(ROOT / "benchmarks" / "results" / "missions.md", *marks, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
