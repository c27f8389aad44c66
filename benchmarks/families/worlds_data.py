"""python -m benchmarks.families.worlds_data: draw the public layouts of the worlds.

Of the layouts 0, 1, 2, ... of seed 0, the first 32 are kept on which a way through is proven. Among resting obstacles
the proof is a path of the roadmap that isn't long, measured again by the judge's own distances; among moving ones it
is a trajectory of `gco_max`. Best costs are sought by `python -m benchmarks.families.oracle --families NAME ...`.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.lib.families import WORLDS, Family
from torchgco import compose, judge
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.roadmap.geometry import length, scene_of
from torchgco.roadmap.roadmap import Roadmap
from torchgco.scenarios import Layouts, Task, concatenate
from torchgco.solvers.contracts import Solver

COUNT, AT_ONCE = 32, 16
HALTON = 512
LONG = 1.75  # lengths of the straight line: a longer path may lead around the world


def kept(family: Family, count: int = COUNT, seed: int = 0) -> tuple[Layouts, int]:
    """The first `count` layouts with a proven way through, and how many were drawn for them."""
    parts, held, drawn = [], 0, 0
    while held < count:
        setup = compose([*family.generated, f"seed={seed}", "solver=gco_max"])
        layouts = setup.scenario.draw(range(drawn, drawn + AT_ONCE), seed)
        task = setup.task(layouts)
        moving = layouts.velocities is not None
        proven = _flown(task, setup.solver) if moving else _passable(task)
        chosen = proven.nonzero().flatten().numpy()[: count - held]
        if held + len(chosen) == count:
            drawn += int(chosen[-1]) + 1
        else:
            drawn += AT_ONCE
        held += len(chosen)
        if len(chosen):
            parts.append(layouts.take(chosen))
    return replace(concatenate(parts), name=family.name), drawn


def _passable(task: Task) -> Tensor:
    """Whether a free path of moderate length leads to the goal, (B,)."""
    scene = scene_of(task.problem, task.U0)
    assert scene is not None
    paths, found = Roadmap(num_halton=HALTON).paths(scene, 1)
    straight = length(torch.stack((scene.start, scene.goal), dim=1))
    free = found & (length(paths[:, 0]) <= LONG * straight)
    for boxes in task.problem.constraints:
        if isinstance(boxes, BoundBoxes):
            free &= boxes.measured(paths[:, 0])[1].flatten(1).amin(-1) >= 0
    return free


def _flown(task: Task, solver: Solver) -> Tensor:
    ids = torch.as_tensor(task.layouts.ids)
    return judge(task.problem, solver.solve(task.problem, task.U0, seed=0, ids=ids).U).reached


def main() -> int:
    torch.set_num_threads(1)
    for family in WORLDS.values():
        layouts, drawn = kept(family)
        family.file().parent.mkdir(parents=True, exist_ok=True)
        replace(layouts, ids=np.arange(layouts.count), best_cost=np.full(layouts.count, np.nan)).save(family.file())
        print(f"{family.name}: {layouts.count} of {drawn} drawn layouts kept", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
