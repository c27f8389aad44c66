"""python -m benchmarks.families.fleets: vehicles that swap places, on circles, through a door and in a forest.

Each fleet counts where `judge` calls it sound; of discs their ways are also computed in closed form, at 40 times a
stage, in NumPy. Costs stand beside the sum of the costs that vehicles have alone, which no fleet is below but by local
minima. Swaps of jaxipm are counted by `Scenario.counted`.
"""

from __future__ import annotations

import time
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.families.fleet_scenes import KEPT, discs, quadrotors, swaps
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from benchmarks.outside.jaxipm_problems import SCENARIOS, spread
from torchgco import Fleet, FleetSolution

FINE = 40  # times a stage at which ways of discs are computed
TOUCH = 0.95  # share of what they keep at which two touch
SAME = 1e-3  # m that the two measures may differ by
HEAD = [
    "scene", "vehicles", "sound", "apart by closed form", "cost", "cost / alone", "within 2 % of the best known",
    "makespan, s", "s a vehicle",
]  # fmt: skip
NEAR = 1.02  # times the least cost that any solve has found


def fleet_of(scene: str, V: int, count: int, seed: int) -> Fleet:
    """Drawn fleets of a scene."""
    return quadrotors(V, count, seed) if scene == "quadrotors" else discs(scene, V, count, seed)


def ways(fleet: Fleet, found: FleetSolution, b: int) -> np.ndarray:
    """Places (V, N FINE + 1, 2) of discs under controls that are held over each stage."""
    h = fleet.dt * np.arange(1, FINE + 1)[:, None] / FINE
    every = []
    for member, one in zip(fleet.members, found, strict=True):
        x, places = member.x0[b].numpy(), [member.x0[b, :2].numpy()[None]]
        for u in one.U[b].numpy():
            places.append(x[:2] + h * x[2:] + 0.5 * h**2 * u)
            x = np.concatenate([places[-1][-1], x[2:] + fleet.dt * u])
        every.append(np.concatenate(places))
    return np.stack(every)


def apart(fleet: Fleet, found: FleetSolution, b: int) -> bool:
    """Whether no two discs touch."""
    p = ways(fleet, found, b)
    least = min(np.linalg.norm(p[i] - p[j], axis=1).min() for i, j in combinations(range(len(p)), 2))
    return bool(least >= TOUCH * KEPT - SAME)


def row(scene: str, V: int, count: int, seed: int, more: int) -> list[object]:
    """What a scene comes to; `more` solves with other draws look for what is cheaper."""
    fleet = fleet_of(scene, V, count, seed)
    alone = sum((torchgco.solve(one, verbose=False).cost for one in fleet.members), torch.zeros(count))
    torchgco.solve(Fleet(fleet.take([0]).members[:2], float(fleet.distances.max())))  # compiles
    began = time.process_time()
    found = torchgco.solve(fleet)
    spent = (time.process_time() - began) / count
    sound = torchgco.judge(fleet, found).reached
    checked = "-" if scene == "quadrotors" else share(sum(apart(fleet, found, b) for b in range(count)), count)
    held = sound.nonzero().flatten()
    if len(held) == 0:
        return [scene, V, share(0, count), checked, "-", "-", "-", "-", f"{spent / V:.2f}"]
    ratio, cost, last = (found.cost / alone)[held], found.cost[held], found.makespan[held]
    least = found.cost.clone()
    for draw in range(1, 1 + more):
        other = torchgco.solve(fleet, seed=draw)
        least = torch.where(other.sound, torch.minimum(least, other.cost), least)
    near = int((cost <= NEAR * least[held]).sum())
    return [
        scene, V, share(len(held), count), checked, f"{float(cost.mean()):.1f}",
        f"{float(ratio.mean()):.3f} ({float(ratio.max()):.3f})", share(near, count) if more else "-",
        f"{float(last.mean()):.1f}", f"{spent / V:.2f}",
    ]  # fmt: skip


def swapped(count: int) -> str:
    """Swaps of jaxipm, by `Fleet`."""
    rows = []
    for scenario in (one for one in SCENARIOS if one.family == "swap"):
        places = spread(scenario.size, count)
        fleet = swaps(scenario, places)
        torchgco.solve(fleet.take([0]))  # compiles
        began = time.process_time()
        found = torchgco.solve(fleet)
        rate = len(places) / (time.process_time() - began)
        U: Tensor = torch.cat([one.U for one in found], dim=-1)
        cost, missed = scenario.counted(scenario.at(places), U.numpy())
        good = int((torchgco.judge(fleet, found).feasible).sum())
        rows.append(
            [scenario.name, share(good, len(places)), f"{cost.mean():.1f}", f"{missed.max():.0e}", f"{rate:.1f}"]
        )
    return markdown(["jaxipm's", "sound", "mean cost", "largest violation", "a second"], rows)


def text(scenes: list[str], count: int, seed: int, more: int) -> str:
    """The tables."""
    rows = [row(scene, int(V), count, seed, more) for scene, _, V in (one.partition("-") for one in scenes)]
    return f"{markdown(HEAD, rows)}\n\n{swapped(count)}"


SCENES = [
    *("circle-4", "circle-8", "circle-16", "circle-32"), *("quadrotors-4", "quadrotors-8", "quadrotors-16"),
    *("forest-8", "forest-16"), *("door-8", "door-16", "door-32"),
]  # fmt: skip
main = Command(
    __doc__, "fleets", text, "{count} drawn fleets of each, seed {seed}",
    scenes=(SCENES, "scenes, and vehicles of each"),
    count=(16, "fleets of each"), seed=(31415, "of the layouts"),
    more=(1, "solves with other draws, for the best known"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
