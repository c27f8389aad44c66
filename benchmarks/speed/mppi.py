"""Sample-steps per second of one MPPI round, compared with pytorch-mppi on the same problem."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from statistics import median
from typing import Any

import torch

import torchgco
from benchmarks.speed.bench import SEED, Bench, Took
from benchmarks.speed.quadrotor_mppi import QuadrotorAmongSpheres
from torchgco.base.draws import DrawKey
from torchgco.constraints.bounds import ControlBounds
from torchgco.guidance.mppi import COLLISION_PENALTY
from torchgco.scenarios import Task

SECTION = "mppi"
TEMPERATURE, SIGMA = 1.0, 1.0
RATIO = "seconds pytorch-mppi / torchgco"
HAVE_PEER = find_spec("pytorch_mppi") is not None


def run(bench: Bench) -> None:
    setup = bench.setup("scenario=forest")
    task = setup.task(setup.layouts(1))
    for samples in bench.sizes.samples:
        rounds = {"torchgco": _ours(task, samples)}
        if HAVE_PEER:
            rounds["pytorch-mppi"] = _theirs(task, samples)
        _measure(bench, samples, task.problem.N, rounds)
    if not HAVE_PEER:
        bench.row(SECTION, "any", "pytorch-mppi", "not installed", "")


def _measure(bench: Bench, samples: int, stages: int, rounds: dict[str, Callable[[], Any]]) -> None:
    """Time both in turns, under the same conditions; medians count."""
    case = f"S = {samples}"
    for work in rounds.values():
        work()  # traces and compiles
    times: dict[str, list[Took]] = {name: [] for name in rounds}
    for _ in range(bench.sizes.mppi_repeats):
        for name, work in rounds.items():
            times[name].append(bench.timed(work)[1])
    middle = {name: median(took.seconds for took in values) for name, values in times.items()}
    for name, seconds in middle.items():
        bench.row(SECTION, case, name, "per round", 1000 * seconds, "ms")
        bench.row(SECTION, case, name, "wall", 1000 * median(took.wall for took in times[name]), "ms")
        bench.row(SECTION, case, name, "sample-steps per second", samples * stages / seconds / 1e6, "millions")
    if HAVE_PEER:
        ratio = middle["pytorch-mppi"] / middle["torchgco"]
        bench.row(SECTION, case, "torchgco", RATIO, ratio, "", "pytorch-mppi / torchgco")


def _ours(task: Task, samples: int) -> Callable[[], Any]:
    """One round: draw, roll out, weight; also roll out the mean, in double precision."""
    sampler = torchgco.MPPI(
        samples=samples, covariance=SIGMA, temperature=TEMPERATURE, rounds=1, noise_knots=0, dtype="float32"
    )
    ids = torch.zeros(1, dtype=torch.int64, device=task.U0.device)
    return lambda: sampler.improve(task.problem, task.U0, DrawKey(SEED, ids, ids))


def _theirs(task: Task, samples: int) -> Callable[[], Any]:
    """`command` of pytorch-mppi, which refines the plan without shifting it.

    The terminal cost, one evaluation in N, is left out: with it pytorch-mppi would store every state and be slower.
    """
    from pytorch_mppi import MPPI

    model = QuadrotorAmongSpheres(task.problem, COLLISION_PENALTY)
    bounds = next(c for c in task.problem.constraints if isinstance(c, ControlBounds))
    device, m = task.U0.device, task.problem.m
    controller = MPPI(
        model.dynamics, model.running_cost, task.problem.n, SIGMA * torch.eye(m, device=device),
        num_samples=samples, horizon=task.problem.N, device=device, lambda_=TEMPERATURE,
        u_min=bounds.lower[0].float(), u_max=bounds.upper[0].float(), u_init=model.u_ref, U_init=task.U0[0].float(),
        noise_mu=torch.zeros(m, device=device),
    )  # fmt: skip
    x0 = task.problem.x0[0].float()
    return lambda: controller.command(x0, shift_nominal_trajectory=False)
