"""python -m benchmarks.families.simulators: missions among forests in simulators of others, by one planner's settings.

Each simulator flies vehicles that it has itself. They are planned with an airframe that is near at hand, and with the
one that `torchgco-identify` finds in twelve short flights. Cases are kept below outputs/simulators, so that a run that
was stopped goes on where it was. Needs the extras mujoco and rotorpy; with --x2 FILE also flies menagerie's model, and
--crazyflow flies that package's vehicles instead, which want SCIPY_ARRAY_API=1 in the environment.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch

from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.page import machine, markdown, origin, put, share
from benchmarks.lib.studies import named
from torchgco import Airframe, compose, presets
from torchgco.missions import Mission, Outcome, Planner, endings
from torchgco.missions.identification import identify, record
from torchgco.missions.plant import Plant
from torchgco.missions.simulators.crazyflow import CrazyflowPlant
from torchgco.missions.simulators.mujoco import MujocoPlant
from torchgco.missions.simulators.rotorpy import RotorpyPlant
from torchgco.scenarios import Forest, Vehicle

HEAD = ("simulator", "its vehicle", "planned with", "reached", "collisions", "flight time", "least clearance", "CPU s")
IDENTIFIED = "identified"
CRAZYFLOW = ("cf2x_L250", "cf21B_500")
SEED = 0  # of the forests and of the flights that identify
AT_ONCE = 8  # missions that are flown together: what a stopped run loses at most


@dataclass(frozen=True)
class Case:
    """A vehicle of a simulator: `base` is what is planned with before it is identified."""

    simulator: str
    vehicle: str
    base: str
    make: Callable[[Airframe], Plant]
    both: bool = True  # False: the base is the vehicle itself
    blind: int = 8  # missions that are planned with the base at most: they end late
    most: int = 64  # missions: RotorPy takes 3 ms for a time step of the hummingbird, whose rotors are fast


def cases(x2: str | None) -> list[Case]:
    """All of them, menagerie's where its file is given."""
    own = [
        Case("MuJoCo", "the paper's, as MJCF", "paper", lambda frame: MujocoPlant(frame), False),
        Case("RotorPy", "its crazyflie", "crazyflie", lambda frame: RotorpyPlant(frame, parameters="crazyflie")),
        Case(
            "RotorPy", "its hummingbird", "paper", lambda frame: RotorpyPlant(frame, parameters="hummingbird"),
            blind=0, most=32,
        ),
    ]  # fmt: skip
    given = [Case("MuJoCo", "Skydio X2 of menagerie", "paper", lambda frame: MujocoPlant(frame, model=x2))]
    return [*own[:1], *(given if x2 else []), *own[1:]]


def crazyflow_case(name: str) -> Case:
    return Case("crazyflow", f"its {name}", "crazyflie", lambda frame: CrazyflowPlant(frame, drone_model=name))


def base_of(name: str) -> Airframe:
    return compose([f"vehicle={name}"]).vehicle.dynamics.airframe  # type: ignore[attr-defined]


def flown(case: Case, identified: bool, count: int, outputs: Path) -> list[dict]:
    """A row for each mission, flown now or read."""
    file = outputs / f"{named(f'{case.simulator}-{case.vehicle}-{identified}-{SEED}')}.json"
    kept: list[dict] = json.loads(file.read_text()) if file.is_file() else []
    frame = base_of(case.base)
    if identified:
        plant = case.make(frame)
        frame = identify(*record(plant, frame, SEED), plant.dt, frame).airframe
    while len(kept) < count:
        ids = range(len(kept), min(len(kept) + AT_ONCE, count))
        problem = Vehicle.quadrotor(frame).among(Forest(start=(1, 1, 0)), ids, SEED).problem
        began = time.process_time()
        log = Mission(Planner(presets.gco(3)), plant=case.make(frame)).fly(problem, SEED, torch.tensor(list(ids)))
        seconds = (time.process_time() - began) / len(ids)
        for number, end in zip(ids, endings(log, problem, 0.5), strict=True):
            kept.append({
                "mission": number, "outcome": end.outcome.name, "time": end.flight_time, "clearance": end.clearance,
                "seconds": seconds,
            })  # fmt: skip
        outputs.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(kept))
        ended = [row["outcome"] for row in kept[-len(ids) :]]
        print(case.simulator, case.vehicle, identified, len(kept), ended, flush=True)
    return kept[:count]


def row(case: Case, planned: str, missions: list[dict]) -> list[object]:
    reached = [one for one in missions if one["outcome"] == Outcome.REACHED.name]
    hits = sum(one["outcome"] == Outcome.COLLISION.name for one in missions)
    clear = min((one["clearance"] for one in reached), default=float("nan"))
    took = f"{median(one['time'] for one in reached):.2f} s" if reached else "-"
    seconds = sum(one["seconds"] for one in missions) / len(missions)
    return [
        case.simulator, case.vehicle, planned, share(len(reached), len(missions)), hits, took,
        f"{clear:.3f} m" if reached else "-", f"{seconds:.1f}",
    ]  # fmt: skip


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.families.simulators", description="Fly, and count.")
    parser.add_argument("--count", type=int, default=64, help="missions of each row, at most")
    parser.add_argument("--unidentified", type=int, default=8, help="missions of rows without identification")
    parser.add_argument(
        "--x2", metavar="FILE", help="skydio_x2/x2.xml of mujoco_menagerie, with its yaw gears corrected"
    )
    parser.add_argument("--crazyflow", action="store_true", help="that simulator alone, in a table of its own")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "simulators")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/simulators.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    rows, mark = [], "crazyflow" if asked.crazyflow else "simulators"
    flying = [*map(crazyflow_case, CRAZYFLOW)] if asked.crazyflow else cases(asked.x2)
    for case in flying:
        rows += (
            [row(case, IDENTIFIED, flown(case, True, min(asked.count, case.most), asked.outputs))] if case.both else []
        )
    for case in flying:
        count = min(asked.unidentified, case.blind) if case.both else asked.count
        if count > 0:
            missions = flown(case, False, count, asked.outputs)
            rows.append(row(case, f"`{case.base}`" if case.both else "itself", missions))
    text = f"{origin('Flown')}, seed {SEED}, {machine()}.\n\n{markdown(HEAD, rows)}"
    print(text)
    if asked.write:
        put(RESULTS / "simulators.md", mark, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
