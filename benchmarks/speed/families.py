"""Seconds per problem on drawn layouts: `gco` in batches, other solvers on the first of these layouts."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.lib import acados
from benchmarks.lib.families import FAMILIES
from benchmarks.speed.bench import Bench, Took
from benchmarks.speed.peers import GUIDED, AcadosPeer, CasADiPeer, Peer, first
from torchgco.experiments.config.build import Setup
from torchgco.judging.judge import Verdict, judge

SECTION = "families"


@dataclass
class Ours:
    """A flight of `gco` on a whole batch."""

    batch: int
    took: Took  # per problem
    verdict: Verdict

    @property
    def per_reached(self) -> float:
        reached = int(self.verdict.reached.sum())
        return self.took.seconds * self.batch / reached if reached else float("inf")


def run(bench: Bench) -> None:
    for place, name in enumerate(bench.sizes.families):
        if bench.fits(SECTION, name, 1.0):
            _family(bench, name, 1 / (len(bench.sizes.families) - place))


def _family(bench: Bench, name: str, share: float) -> None:
    """Run peers, `gco`, peers again: if the machine's speed drifts, the peers' two times differ.

    `share` of the time left may be used for this family.
    """
    setup = bench.setup(*FAMILIES[name].generated)
    with tempfile.TemporaryDirectory() as folder:
        peers = [peer for peer in _peers(bench, name, setup, Path(folder)) if peer.flies(bench, SECTION, name)]
        flights = _fly(bench, name, setup, share)
        for peer in reversed(peers):
            peer.fly(bench)
    for peer in peers:
        _say_peer(bench, name, peer)
        for ours in flights:
            _compare(bench, name, ours, peer)


def _peers(bench: Bench, name: str, setup: Setup, folder: Path) -> list[Peer]:
    """The installed peers, prepared; none on a GPU, which they can't use."""
    if bench.device != "cpu":
        return []
    sizes = bench.sizes
    task = setup.task(setup.layouts(sizes.slow_layouts if name in sizes.slow_families else sizes.layouts))
    peers: list[Peer] = [CasADiPeer.ready(bench, solver, task) for solver in ("fatrop", GUIDED)]
    if acados.installed():
        peers += [AcadosPeer.ready(bench, solver, task, folder) for solver in ("acados", "acados_guided")]
    else:
        bench.row(SECTION, name, "acados", "not installed", "")
    if name in sizes.ipopt_families:
        peers.append(CasADiPeer.ready(bench, "ipopt", first(task, sizes.ipopt_layouts)))
    return peers


def _fly(bench: Bench, name: str, setup: Setup, share: float) -> list[Ours]:
    """Fly `gco` on every batch that fits into the time."""
    flights: list[Ours] = []
    batches = (bench.sizes.family_batch, bench.sizes.large_batch if name.startswith("forest") else None)
    for batch in batches:
        known = flights[-1].took.wall if flights else 0.0  # per problem: no longer in a larger batch
        if batch is not None and bench.fits(SECTION, f"{name}, B = {batch}", known * batch, share):
            flights.append(_flight(bench, name, setup, batch))
    return flights


def _flight(bench: Bench, name: str, setup: Setup, batch: int) -> Ours:
    layouts = setup.layouts(batch)
    task = setup.task(layouts)
    bench.warm(setup, task)
    solution, took = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed))
    checked = setup.vehicle.task(layouts)  # on the CPU, where the judge runs
    verdict = judge(checked.problem, solution.U.to("cpu", torch.float64), checked.goal, checked.goal_radius)
    case, ours = f"{name}, B = {batch}", Ours(batch, took.each(batch), verdict)
    _say(bench, case, "gco", ours.took, verdict, ours.per_reached)
    bench.row(SECTION, case, "gco", "iterations", float(solution.iterations.double().mean()))
    return ours


def _say(bench: Bench, case: str, solver: str, took: Took, verdict: Verdict, per_reached: float) -> None:
    bench.times(SECTION, case, solver, took)
    bench.row(SECTION, case, solver, "per layout reached", per_reached, "s")
    bench.counts(SECTION, case, solver, verdict)


def _say_peer(bench: Bench, name: str, peer: Peer) -> None:
    assert peer.verdict is not None
    case = f"{name}, first {peer.count}"
    _say(bench, case, peer.name, peer.took, peer.verdict, peer.per_reached)
    bench.row(SECTION, case, peer.name, "iterations", peer.iterations)
    bench.row(SECTION, case, peer.name, "spread", 100 * peer.spread, "%")
    bench.row(SECTION, case, peer.name, "set-up", peer.setup, "s")


def _compare(bench: Bench, name: str, ours: Ours, peer: Peer) -> None:
    """Rows of ratios: of seconds, and of costs on the layouts that both reached."""
    assert peer.verdict is not None
    case, pair = f"{name}, B = {ours.batch}", f"{peer.name} / gco"
    bench.row(SECTION, case, pair, "seconds, ratio", peer.seconds / ours.took.seconds, "", pair)
    if int(ours.verdict.reached.sum()) > 0:
        bench.row(SECTION, case, pair, "per layout reached, ratio", peer.per_reached / ours.per_reached, "", pair)
    shared = min(ours.batch, peer.count)
    both = ours.verdict.reached[:shared] & peer.verdict.reached[:shared]
    ratio = (peer.verdict.cost[:shared] / ours.verdict.cost[:shared])[both]
    bench.row(SECTION, case, pair, "cost, ratio", float(ratio.quantile(0.5)) if ratio.numel() else "", "", pair)
