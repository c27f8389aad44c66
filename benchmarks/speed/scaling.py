"""Seconds per problem of whole solves as stages and obstacles grow: `gco` in a batch, FATROP and acados beside.

The peers fly the first of the same layouts. Obstacles far from every way are added, too: they should cost nothing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.lib import acados
from benchmarks.speed.bench import Bench, Took
from benchmarks.speed.peers import AcadosPeer, CasADiPeer, Peer, first
from torchgco import Problem, Spheres
from torchgco.judging.judge import Verdict, judge
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.scenarios import Task

SECTION = "scaling"
FLIGHT = 5.0  # s: the same for any number of stages
TYPICAL = 30  # spheres of a forest, which the others are compared with
FAR, AWAY = 470, 12.0  # spheres that are added, and how far from the forest at least, m


def run(bench: Bench) -> None:
    sizes, seconds = bench.sizes, {}
    for stages in sizes.stages:
        task = _drawn(bench, f"scenario.stages={stages}", f"scenario.dt={FLIGHT / stages}")
        _beside_peers(bench, f"{stages} stages", task, stages <= sizes.peers_stages)
    for count in sizes.obstacles:
        task, case = _drawn(bench, f"scenario.num_obstacles={count}"), f"{count} spheres"
        seconds[case] = _beside_peers(bench, case, task, count <= sizes.peers_obstacles)
        if count == TYPICAL:
            case = f"{count} spheres and {FAR} far"
            seconds[case] = _ours(bench, case, replace(task, problem=with_far(task.problem)))
    typical = f"{TYPICAL} spheres"
    for case in [case for case in seconds if typical in seconds and case != typical]:
        bench.row(SECTION, case, "gco", f"times {typical}", seconds[case] / seconds[typical])


def with_far(problem: Problem) -> Problem:
    """The problems with `FAR` more spheres in a lattice of 1 m beside the forest, `AWAY` and more from its edge."""
    forest = next(part for part in problem.constraints if isinstance(part, BoundSpheres))
    number, side = torch.arange(FAR, dtype=torch.float64), int(FAR**0.5) + 1
    beside = torch.stack((number % side, AWAY + number // side, torch.zeros_like(number)), dim=-1)
    corner = (forest.centers + forest.inflated_radii.unsqueeze(-1)).amax((0, 1)) * torch.tensor([0.0, 1.0, 0.0])
    far = (corner + beside).expand(problem.B, -1, -1)
    vehicle = forest.vehicle_radius.unsqueeze(-1)
    radii = forest.inflated_radii - vehicle
    more = Spheres(
        torch.cat((forest.centers, far), dim=1),
        torch.cat((radii, radii.mean(-1, keepdim=True).expand(-1, FAR)), dim=1),
        forest.vehicle_radius,
    )
    return replace(problem, constraints=[more if part is forest else part for part in problem.constraints])


def _drawn(bench: Bench, *overrides: str) -> Task:
    setup = bench.setup("scenario=forest", *overrides)
    return setup.task(setup.layouts(bench.sizes.growth_batch))


def _beside_peers(bench: Bench, case: str, task: Task, peers: bool) -> float:
    """Rows of `gco` and of its peers, where they fly; returns the seconds of `gco` per problem."""
    seconds = _ours(bench, case, task)
    if peers:
        with tempfile.TemporaryDirectory() as folder:
            for peer in _peers(bench, first(task, bench.sizes.peers_layouts), Path(folder)):
                if peer.flies(bench, SECTION, case):
                    assert peer.verdict is not None
                    _say(bench, case, peer.name, peer.took, peer.verdict)
    return seconds


def _ours(bench: Bench, case: str, task: Task) -> float:
    setup = bench.setup("scenario=forest")
    bench.warm(setup, task)
    solution, took = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed))
    verdict = judge(task.problem, solution.U, task.goal, task.goal_radius)
    return _say(bench, case, "gco", took.each(task.problem.B), verdict)


def _peers(bench: Bench, task: Task, folder: Path) -> Iterator[Peer]:
    yield CasADiPeer.ready(bench, "fatrop", task)
    if acados.installed():
        yield AcadosPeer.ready(bench, "acados", task, folder)


def _say(bench: Bench, case: str, solver: str, took: Took, verdict: Verdict) -> float:
    bench.row(SECTION, case, solver, "seconds per problem", took.seconds, "s")
    for word in ("feasible", "reached"):
        hits = getattr(verdict, word)
        bench.row(SECTION, case, solver, word, f"{int(hits.sum())}/{hits.numel()}")
    return took.seconds
