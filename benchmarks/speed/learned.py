"""Models of a user's own: first solves in a new process, networks per iteration, training steps, code without C.

`python -m benchmarks.speed.learned NAME` is a process that solves a model for the first time: it prints the processor
seconds, the compilers' included, and the elapsed ones.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

import torchgco
from benchmarks.speed.first_use import _took, started
from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, InputError, Problem, QuadraticCost, Spheres

if TYPE_CHECKING:
    from benchmarks.speed.bench import Bench  # a process that measures a first solve loads nothing else

SECTION = "learned"
D = torch.float64
DT, STAGES, EPOCHS, BATCH = 0.1, 50, 100, 64


def network(*widths: int) -> nn.Sequential:
    """Tanh layers of these widths, the same at every call."""
    torch.manual_seed(0)
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b), nn.Tanh()]
    return nn.Sequential(*layers[:-1]).double()


def residual(net: nn.Module, integrator: str = "euler") -> FunctionDynamics:
    """A double integrator in the plane, whose forces a net adds to."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 2:], u), -1) + 0.1 * net(torch.cat((x, u), -1))

    return FunctionDynamics(field, 4, 2, DT, integrator)


def car(x: Tensor, u: Tensor) -> Tensor:
    speed, heading = x[..., 3], x[..., 2]
    return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]), -1)


def arm(x: Tensor, u: Tensor) -> Tensor:
    """Of two links: angles and rates under torques."""
    w, c, s = x[..., 2:], x[..., 1].cos(), x[..., 1].sin()
    a, b, d, h = 1.5 + 0.6 * c, 0.3 + 0.3 * c, 0.3, 0.3 * s
    first = u[..., 0] + h * (2.0 * w[..., 0] * w[..., 1] + w[..., 1] ** 2)
    second, size = u[..., 1] - h * w[..., 0] ** 2, a * d - b * b
    return torch.stack((w[..., 0], w[..., 1], (d * first - b * second) / size, (a * second - b * first) / size), -1)


MODELS: dict[str, Callable[[], FunctionDynamics]] = {
    "car, RK4": lambda: FunctionDynamics(car, 4, 2, DT, "rk4", position=slice(0, 2)),
    "arm, RK4": lambda: FunctionDynamics(arm, 4, 2, 0.05, "rk4"),
    "6-32-4, Euler": lambda: residual(network(6, 32, 4)),
    "6-32-4, RK4": lambda: residual(network(6, 32, 4), "rk4"),
    "6-64-64-4, Euler": lambda: residual(network(6, 64, 64, 4)),
    "6-64-64-4, RK4": lambda: residual(network(6, 64, 64, 4), "rk4"),
}


def problem(model: FunctionDynamics, B: int = 1, stages: int = STAGES) -> Problem:
    """From rest towards a place, between discs where the model has a position."""
    cost = QuadraticCost([1.0, 1.0, 0.1, 0.1], [0.1, 0.1], [20.0, 20.0, 1.0, 1.0], x_ref=[1.0, 0.5, 0.0, 0.0])
    parts: list = [ControlBounds(-2.0, 2.0)]
    if model.position is not None:
        parts.append(Spheres([[0.5, 0.1]], [0.1], 0.05))
    x0 = 0.2 * torch.linspace(-1.0, 1.0, B, dtype=D).view(-1, 1) * torch.ones(4, dtype=D)
    return Problem(model, cost, parts, x0, stages)


@torch.no_grad()
def solved(of: Problem) -> torchgco.Solution:
    return torchgco.solve(of, solver="interior_point", verbose=False)


def run(bench: Bench) -> None:
    for name in list(MODELS)[: bench.sizes.own_models]:
        first_solve(bench, name)
    for name in ("6-32-4, Euler", "6-64-64-4, Euler")[: bench.sizes.own_models]:
        for B in (1, 8):
            iteration(bench, name, B)
    training(bench)
    for name, model in CODE.items():
        by_pytorch(bench, name, model)
    joined_rows(bench)


def first_solve(bench: Bench, name: str) -> None:
    """In a new process: nothing compiled before; then only another model with as many dimensions of space."""
    other = "line in the plane" if MODELS[name]().position is not None else "line"
    with tempfile.TemporaryDirectory() as empty, tempfile.TemporaryDirectory() as built:
        started(["-m", "benchmarks.speed.learned", other], {"TORCHGCO_CACHE": built})
        for case, folder in (("nothing built", empty), ("solver's objects built", built)):
            processor, wall = map(
                float, started(["-m", "benchmarks.speed.learned", name], {"TORCHGCO_CACHE": folder}).split()
            )
            bench.row(SECTION, name, "torchgco.solve", f"first solve, {case}", processor, "s")
            bench.row(SECTION, name, "torchgco.solve", f"{case}, wall", wall, "s")


def iteration(bench: Bench, name: str, B: int) -> None:
    """Processor time of the library in C, per iteration of the longest problem."""
    from torchgco.native import interior

    whole, times = problem(MODELS[name](), B), []
    library = interior.run

    def timed(*words: Any) -> None:
        began = time.process_time()
        library(*words)
        times.append(time.process_time() - began)

    interior.run = timed
    try:
        for _ in range(15):
            found = solved(whole)
    finally:
        interior.run = library
    count, case = int(found.iterations.max()), f"{name}, B = {B}, N = {STAGES}"
    bench.row(SECTION, case, "interior_point", "an iteration", 1000 * median(times) / count, "ms")
    bench.row(SECTION, case, "interior_point", "iterations", count)


def training(bench: Bench) -> None:
    """Solves with changed weights, the libraries compiled on the way counted, and the steps of an optimizer."""
    from torchgco.native import store

    net = network(6, 32, 4)
    whole, times = problem(residual(net), BATCH, 20), []
    optimizer, counts = torch.optim.SGD(net.parameters(), lr=1e-3), []
    for _ in range(bench.sizes.training_steps):
        began = time.process_time()
        found = solved(whole)
        step = whole.dynamics.step(found.X[:, :-1], found.U)
        optimizer.zero_grad()
        (step - found.X[:, 1:].detach() + 0.01).square().mean().backward()
        optimizer.step()
        times.append(time.process_time() - began)
        counts.append(sum(1 for file in Path(store.folder()).glob("*") if file.suffix in (".so", ".o")))
    case = f"6-32-4, Euler, B = {BATCH}, N = 20"
    bench.row(SECTION, case, "interior_point", "training step, median", 1000 * median(times[1:]), "ms")
    bench.row(SECTION, case, "interior_point", "compiled after the first step", counts[-1] - counts[0])


def _lstm() -> FunctionDynamics:
    torch.manual_seed(0)
    cell, out = nn.LSTM(6, 16, batch_first=True).double(), nn.Linear(16, 4).double()

    def field(x: Tensor, u: Tensor) -> Tensor:
        z = torch.cat((x, u), -1)
        inner = out(cell(z.reshape(-1, 1, 6))[0])[:, 0].reshape(x.shape)
        return torch.cat((x[..., 2:], u), -1) + 0.1 * inner

    return FunctionDynamics(field, 4, 2, DT, "euler")


def _implicit() -> FunctionDynamics:
    """Accelerations from a mass matrix that depends on the state."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        q = 0.3 * x[..., :2].sin()
        mass = torch.eye(2, dtype=D) * 2.0 + q.unsqueeze(-1) * q.unsqueeze(-2)
        return torch.cat((x[..., 2:], torch.linalg.solve(mass, u.unsqueeze(-1)).squeeze(-1)), -1)

    return FunctionDynamics(field, 4, 2, DT, "euler")


def _mixture() -> FunctionDynamics:
    def field(x: Tensor, u: Tensor) -> Tensor:
        share = torch.softmax(torch.stack((x[..., 0], x[..., 1], 0.5 * x[..., 2]), -1), -1)
        drag = (share * torch.tensor([0.1, 0.4, 0.8], dtype=D)).sum(-1, keepdim=True)
        return torch.cat((x[..., 2:], u - drag * x[..., 2:]), -1)

    return FunctionDynamics(field, 4, 2, DT, "euler")


CODE = {"LSTM (16)": _lstm, "linalg.solve": _implicit, "softmax": _mixture}


def by_pytorch(bench: Bench, name: str, model: Callable[[], FunctionDynamics]) -> None:
    """A first solve with a limit on states: what the trace doesn't take, PyTorch's kernels solve."""
    whole = problem(model(), 1, 60)
    limit = torchgco.StateBounds([-9.0, -9.0, -0.8, -0.8], [9.0, 9.0, 0.8, 0.8])
    whole = Problem(whole.dynamics, whole.cost, [*whole.constraints, limit], whole.x0, whole.N)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.process_time()
        with torch.no_grad():
            found = torchgco.solve(whole, verbose=False)
        bench.row(SECTION, f"{name}, N = 60", "gco", "first solve", time.process_time() - began, "s")
    row = found.to_frame().iloc[0]
    bench.row(SECTION, f"{name}, N = 60", "gco", "status, kernels", f"{row['status']}, {row['kernels']}")


def joined_rows(bench: Bench) -> None:
    """Six pendulums whose torques' rates are rows that join two knots: refused, with what to write instead."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 6:], u - 5.0 * x[..., :6].sin()), -1), 12, 6, 0.05, "rk4")
    cost = QuadraticCost([1.0] * 12, [0.1] * 6, [10.0] * 12)
    began = time.process_time()
    try:
        rates = FunctionConstraint(lambda x, u: u.diff(dim=-2, prepend=u[..., :1, :]).abs() - 0.5, of="xu")
        torchgco.solve(Problem(model, cost, [rates], 0.3 * torch.ones(1, 12, dtype=D), 120), verbose=False)
        outcome = "solved"
    except InputError as error:
        outcome = "refused: " + str(error).replace("|", "or")
    bench.row(SECTION, "rates by hand, N = 120", "gco", "until then", time.process_time() - began, "s")
    bench.row(SECTION, "rates by hand, N = 120", "gco", "outcome", outcome)


def _line(position: slice | None) -> FunctionDynamics:
    return FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, DT, "euler", position=position)


if __name__ == "__main__":
    torch.set_num_threads(1)
    others = {"line": lambda: _line(None), "line in the plane": lambda: _line(slice(0, 2))}
    first = problem((MODELS | others)[sys.argv[1]]())
    with torch.no_grad():
        print(*_took(lambda: torchgco.solve(first, verbose=False)))
