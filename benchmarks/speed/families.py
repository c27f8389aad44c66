"""Problems a second on drawn layouts, against FATROP and IPOPT on the first of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from benchmarks.speed.bench import Bench
from benchmarks.speed.peers import HAVE_CASADI, Peer, first
from torchgco.experiments.build import Setup
from torchgco.judge import Verdict, judge

SECTION = "families"
FAMILIES = {
    "forest30": ("scenario=forest", "scenario.num_obstacles=30"),
    "forest60": ("scenario=forest", "scenario.num_obstacles=60"),
    "planar_trap": ("scenario=planar_trap", "model=planar"),
    "planar_random": ("scenario=planar_random", "model=planar"),
}


@dataclass
class Ours:
    """A flight of `gco` on a whole batch."""

    name: str
    batch: int
    seconds: float  # a problem
    verdict: Verdict


def run(bench: Bench) -> None:
    for place, name in enumerate(bench.sizes.families):
        if bench.fits(SECTION, name, 1.0):
            _family(bench, name, 1 / (len(bench.sizes.families) - place))


def _family(bench: Bench, name: str, share: float) -> None:
    """Peers, ours, peers again: a machine that drifts meanwhile shows in the peers' two times.

    `share` is of the time left, what this family may take.
    """
    setup = bench.setup(*FAMILIES[name])
    peers = _peers(bench, name, setup)
    for peer in peers:
        peer.fly(bench)
    flights = _fly(bench, name, setup, share)
    for peer in reversed(peers):
        peer.fly(bench)
    for peer in peers:
        _say_peer(bench, name, peer)
        for ours in flights:
            _compare(bench, name, ours, peer)


def _peers(bench: Bench, name: str, setup: Setup) -> list[Peer]:
    """Those that are installed, made ready; none on a GPU, which they have no use for."""
    if bench.device != "cpu":
        return []
    if not HAVE_CASADI:
        bench.row(SECTION, name, "fatrop", "not installed", "")
        return []
    counts = {"fatrop": bench.sizes.fatrop_layouts, "ipopt": bench.sizes.ipopt_layouts}
    task = setup.task(setup.layouts(max(counts.values())))
    return [Peer.ready(bench, solver, first(task, count)) for solver, count in counts.items()]


def _fly(bench: Bench, name: str, setup: Setup, share: float) -> list[Ours]:
    """`gco` on every batch that fits into the time, eager and, where asked for, compiled."""
    flights: list[Ours] = []
    for compiled in bench.modes():
        solver = "gco, compiled" if compiled else "gco"
        with bench.mode(compiled):
            if compiled:
                _say_compilation(bench, name, setup, min(bench.sizes.family_batches))
            for batch in bench.sizes.family_batches:
                known = flights[-1].seconds if flights else 0.0  # a problem: in a larger batch they take no longer
                if bench.fits(SECTION, f"{name}, B = {batch}", known * batch, share):
                    flights.append(_flight(bench, name, setup, solver, batch))
    return flights


def _flight(bench: Bench, name: str, setup: Setup, solver: str, batch: int) -> Ours:
    layouts = setup.layouts(batch)
    task = setup.task(layouts)
    solution, seconds = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed))
    checked = setup.vehicle.task(layouts)  # on the CPU, where the judge sits
    verdict = judge(checked.problem, solution.U.to("cpu", torch.float64), checked.goal, checked.goal_radius)
    case = f"{name}, B = {batch}"
    bench.row(SECTION, case, solver, "seconds a problem", seconds / batch, "s")
    bench.row(SECTION, case, solver, "problems a second", batch / seconds, "1/s")
    _say_verdict(bench, case, solver, verdict)
    bench.row(SECTION, case, solver, "iterations", float(solution.iterations.double().mean()))
    return Ours(solver, batch, seconds / batch, verdict)


def _say_compilation(bench: Bench, name: str, setup: Setup, batch: int) -> None:
    """What the first solve takes more than the second one, which is not kept."""
    task = setup.task(setup.layouts(batch))
    first_time, again = (bench.timed(lambda: setup.solver.solve(task.problem, task.U0))[1] for _ in range(2))
    bench.row(SECTION, f"{name}, B = {batch}", "gco, compiled", "compilation", max(0.0, first_time - again), "s")


def _say_verdict(bench: Bench, case: str, solver: str, verdict: Verdict) -> None:
    count = verdict.feasible.numel()
    bench.row(SECTION, case, solver, "feasible", f"{int(verdict.feasible.sum())}/{count}")
    bench.row(SECTION, case, solver, "reached", f"{int(verdict.reached.sum())}/{count}")


def _say_peer(bench: Bench, name: str, peer: Peer) -> None:
    assert peer.verdict is not None
    case = f"{name}, first {peer.count}"
    bench.row(SECTION, case, peer.name, "seconds a problem", peer.seconds, "s")
    bench.row(SECTION, case, peer.name, "problems a second", 1 / peer.seconds, "1/s")
    _say_verdict(bench, case, peer.name, peer.verdict)
    bench.row(SECTION, case, peer.name, "iterations", peer.iterations)
    bench.row(SECTION, case, peer.name, "spread", 100 * peer.spread, "%")
    bench.row(SECTION, case, peer.name, "set-up", peer.setup_seconds, "s")


def _compare(bench: Bench, name: str, ours: Ours, peer: Peer) -> None:
    """Seconds, and costs on the layouts that both flew."""
    assert peer.verdict is not None
    case, told = f"{name}, B = {ours.batch}", f"{peer.name} / {ours.name}"
    bench.row(SECTION, case, ours.name, f"seconds {peer.name} / gco", peer.seconds / ours.seconds, "", told)
    shared = min(ours.batch, peer.count)
    both = ours.verdict.feasible[:shared] & peer.verdict.feasible[:shared]
    ratio = (ours.verdict.cost[:shared] / peer.verdict.cost[:shared])[both]
    value = float(ratio.quantile(0.5)) if ratio.numel() else ""
    bench.row(SECTION, case, ours.name, f"cost gco / {peer.name}", value, "", f"{ours.name} / {peer.name}")
