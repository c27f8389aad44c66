"""Draws models, costs and constraints as users write them, and solves each as often as what they capture changes.

    python -m tests.fuzz.user_code FIRST COUNT

prints a line per drawn problem: its seed, and "equal" or "refused"; a line for any other outcome begins with "wrong".
A crash ends the process, so that whoever counts the lines sees it.
"""

from __future__ import annotations

import random
import sys
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

import torchgco
from torchgco import (
    ILQR,
    ControlBounds,
    Cost,
    Dynamics,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Problem,
    QuadraticCost,
    Solution,
    kernels,
)
from torchgco.dynamics.rollout import open_loop

D = torch.float64
B, N, SIZE = 3, 8, 3
FIRST = torch.zeros(1, dtype=torch.int64)


def squares(z: Tensor) -> Tensor:
    """All products of two components, (..., SIZE, SIZE)."""
    return z.unsqueeze(-1) * z.unsqueeze(-2)


UNARY: dict[str, Callable[[Tensor], Tensor]] = {
    "sin": torch.sin, "tanh": torch.tanh, "softplus": torch.nn.functional.softplus, "square": torch.square,
    "root": lambda z: (1.0 + z * z).sqrt(), "bump": lambda z: torch.exp(-z * z), "flip": lambda z: z.flip(-1),
    "clamped": lambda z: z.clamp(-0.7, 0.9), "chosen": lambda z: torch.where(z > 0.1, z, 0.3 * z),
    "sorted sum": lambda z: z.cumsum(-1) / SIZE, "norm": lambda z: z / (1.0 + z.norm(dim=-1, keepdim=True)),
}  # fmt: skip
# What a trace could take for something else: types, writes, NaN, and Python branches on values.
UNARY |= {
    "masks": lambda z: z * ((z > 0.2) + (z > -0.3)),
    "mask of integers": lambda z: z * torch.full_like(z > 0.0, 3),
    "boolean buffer": lambda z: z * torch.zeros(z.shape, dtype=torch.bool).copy_(z > 0.1),
    "integer buffer": lambda z: 0.1 * torch.zeros(z.shape, dtype=torch.int64).copy_(4.0 * z) + z,
    "counted": lambda z: z * (z > 0.1).sum(-1, keepdim=True) / 3.0,
    "odd": lambda z: z * ((z > 0.1).sum(-1, keepdim=True) & 1),
    "bytes": lambda z: z * (torch.where(z > 0.1, 100, 1).to(torch.int8) * 2 > 0),
    "single": lambda z: z.float().to(z.dtype),
    "ring": lambda z: F.pad(z.reshape(-1, 1, SIZE), (1, 1), mode="circular")[..., :-2].reshape(z.shape),
    "greatest of roots": lambda z: torch.where(torch.maximum(z.sqrt(), z) > -9.0, z, -0.5 * z),
    "least of roots": lambda z: torch.where(torch.stack((z.sqrt(), z)).amin(0) < 9.0, z, -0.5 * z),
    "finite": lambda z: torch.where(z.log().isfinite(), z, 0.5 * z),
    "root of itself": lambda z: (lambda root: torch.where(root == root, z, -0.5 * z))(z.sqrt()),
    "cells": lambda z: z + 0.1 * torch.div(z, 0.1, rounding_mode="floor"),
    "turned": lambda z: (z + 1.0) % 2.0 - 1.0,
    "log of a sigmoid": lambda z: 0.02 * (50.0 * z).sigmoid().log(),
    "bytes as a mask": lambda z: z * z[..., torch.tensor([1, 0, 1], dtype=torch.uint8)].sum(-1, keepdim=True) / 3.0,
    "fewer gathered": lambda z: z * squares(z).gather(-1, FIRST.expand(*z.shape[:-1], 1, 1))[..., 0],
    "whole numbers": lambda z: z * (torch.arange(1, SIZE + 1) / 7),
    "potential": lambda z: torch.func.grad(lambda q: (1.0 + q.square().sum(-1)).log().sum())(z),
    "caught": lambda z: caught(lambda: z if float(z.abs().sum()) < 0.0 else 0.5 * z, z),
    "equal": lambda z: z if torch.equal(z, torch.zeros_like(z)) else 0.5 * z,
    "close": lambda z: z if torch.allclose(z, torch.zeros_like(z)) else 0.5 * z,
    "none chosen": lambda z: z if z[z != 0.0].numel() == 0 else 0.5 * z,
}  # fmt: skip
# Solved as they are; what they read beside that isn't looked for.
BRANCHES = ("caught", "equal", "close", "none chosen")
ROUGH = ("single",)  # of single precision, in which the two kinds of kernels differ by its rounding
# States that leave this range come from models that grow in finite time: they multiply rounding by as much, and the
# solvers of the two kinds of kernels part.
RANGE = 1e3
FAULTS = (
    "numpy", "dropout", "randn", "python random", "one column", "scalar", "coupled", "integer", "missing", "joined",
    "joined far away", "pushed apart", "number of problems", "written",
)  # fmt: skip
HIDDEN = ("joined far away", "pushed apart")  # not looked for in code that branches on values
MIXING = ("coupled", "joined", "joined far away", "pushed apart", "number of problems")
CAPTURES = ("nothing", "number", "tensor", "data", "array", "module", "branch on a number", "list", "values")


class Memory:
    """What drawn code captures."""

    def __init__(self, rng: random.Random) -> None:
        self.number, self.items = rng.uniform(0.2, 1.0), [rng.uniform(0.2, 1.0) for _ in range(SIZE)]
        self.tensor = torch.tensor(self.items, dtype=D)
        self.array = np.array(self.items)
        self.goals = torch.tensor([[rng.uniform(-1.0, 1.0) for _ in range(SIZE)] for _ in range(B)], dtype=D)
        self.module = torch.nn.Linear(SIZE, SIZE).double()

    def change(self, kind: str) -> None:
        """Another value, by every way that leaves the object the same."""
        if kind == "tensor":
            self.tensor.mul_(-0.5)
        elif kind == "data":
            self.tensor.data = self.tensor.data * -0.5
        elif kind == "array":
            self.array *= -0.5
        elif kind == "values":
            self.goals.mul_(-0.5)
        elif kind == "list":
            self.items[0] *= -0.5
        elif kind == "module":
            with torch.no_grad():
                self.module.weight.mul_(-0.5)
        else:
            self.number *= -0.5

    def read(self, kind: str, z: Tensor) -> Tensor:
        if kind in ("tensor", "data"):
            return z * self.tensor
        if kind == "array":
            return z * torch.from_numpy(self.array)
        if kind == "list":
            return z * torch.tensor(self.items, dtype=D)
        if kind == "module":
            return self.module(z)
        if kind == "number":
            return self.number * z
        if kind == "branch on a number":
            return z if self.number > 0 else z.sin()
        return z


def drawn_function(
    rng: random.Random, memory: Memory, capture: str, branches: tuple[str, ...]
) -> tuple[list[str], Callable[..., Tensor]]:
    """A bounded or growing function of (..., SIZE) that reads `memory`, and the names of its parts."""
    names, weight = rng.choices(list(UNARY), k=rng.randint(1, 3)), rng.uniform(0.2, 0.8)
    names = [name if name not in BRANCHES or name in branches else "sin" for name in names]

    def function(z: Tensor, goal: Tensor | None = None) -> Tensor:
        for name in names:
            z = z + weight * UNARY[name](memory.read(capture, z))
        # The captured tensor is the one that is given as values, too.
        return z if goal is None else z + 0.2 * (goal - memory.goals.mean(0))

    return names, function


def caught(function: Callable[[], Tensor], otherwise: Tensor) -> Tensor:
    try:
        return function()
    except Exception:
        return otherwise


def pushed(z: Tensor) -> Tensor:
    """A push away from problems closer than 0.01."""
    away = z[:, None] - z[None]
    return torch.where(away.norm(dim=-1, keepdim=True) < 0.01, away, 0.0).sum(1)


def spoilt(rng: random.Random, function: Callable[[Tensor], Tensor], fault: str) -> Callable[[Tensor], Any]:
    """The function with a fault."""
    dropout = torch.nn.Dropout(0.5)
    return {
        "numpy": lambda z: torch.tensor(np.sin(function(z).detach().numpy())),
        "dropout": lambda z: dropout(function(z)),
        "randn": lambda z: function(z) + torch.randn(SIZE, dtype=D),
        "python random": lambda z: function(z) * random.random(),
        "one column": lambda z: function(z)[..., :1, None],
        "scalar": lambda z: function(z).sum(),
        "coupled": lambda z: function(z - z.mean(0)),
        "integer": lambda z: function(z).long(),
        "missing": lambda z: None,
        "joined": lambda z: function(z) - function(z).roll(1, -2),
        "pushed apart": lambda z: function(z) + pushed(z),
        "number of problems": lambda z: function(z) * (2.0 if z.shape[0] == B else 1.0),
        "written": lambda z: function(z.clamp_(-9.0, 9.0)),
        "joined far away": lambda z: function(z) + (function(z).cumsum(-2) - 1e4).relu(),
    }[fault]


class Drawn(NamedTuple):
    """How to make a problem, what it captures, how, its fault ("" for none), its parts, and a tolerance."""

    make: Callable[[], Problem]
    memory: Memory
    capture: str
    fault: str
    parts: str
    tolerance: float


def drawn_problem(seed: int) -> Drawn:
    rng = random.Random(seed)
    torch.manual_seed(seed)
    memory, capture = Memory(rng), rng.choice(CAPTURES)
    fault = rng.choice(FAULTS) if rng.random() < 0.3 else ""
    place = rng.choice(("model", "cost", "constraint"))
    names, inner = drawn_function(rng, memory, capture, () if fault in HIDDEN else BRANCHES)
    inner = spoilt(rng, inner, fault) if fault else inner
    values = {"goal": memory.goals} if capture == "values" and not fault else None
    shape, integrator = rng.choice((0, 1)), rng.choice(("euler", "midpoint", "rk4", "none"))
    subclass = rng.random() < 0.5
    own = rng.random() < 0.3
    X0 = 0.5 * torch.randn(B, SIZE, dtype=D)

    def model() -> Dynamics:
        known = (lambda z: torch.tanh(z)) if place != "model" else inner
        field = lambda x, u, **more: 0.5 * known(x, **more) + 0.3 * torch.cat((u, u[..., :1]), dim=-1)
        if fault and place == "model":
            field = lambda x, u, **more: known(x)
        if not subclass or values:
            return FunctionDynamics(field, SIZE, 2, 0.1, integrator, values=values if place == "model" else None)
        members = {"n": SIZE, "m": 2, "dt": 0.1, "integrator": "rk4", "field": lambda self, x, u: field(x, u)}
        return type("Drawn", (Dynamics,), members)()

    def cost() -> Cost:
        if place != "cost":
            return QuadraticCost([1.0] * SIZE, [0.1] * 2, [5.0] * SIZE)
        stage = lambda x, u, **more: inner(x, **more).square().sum(-1) + 0.1 * u.square().sum(-1)
        if fault:
            stage = lambda x, u, **more: inner(x)[..., 0] if fault in MIXING else inner(x)
        if values or not own:
            return FunctionCost(stage, lambda x: 3.0 * x.square().sum(-1), values)
        members = {"stage": lambda self, x, u, k: stage(x, u), "terminal": lambda self, x: x.square().sum(-1)}
        return type("Drawn", (Cost,), members)()

    def constraints() -> list[Any]:
        some = slice(None) if fault else slice(0, 1 + shape)
        rows = FunctionConstraint(
            lambda x, **more: inner(x) - 0.5 if fault else inner(x, **more)[..., some] - 0.5, values=values
        )
        return [ControlBounds(-2, 2), *([rows] if place == "constraint" else [])]

    known = f"{capture} in {place}, {', '.join(names)}"
    tolerance = 1e-3 if set(names) & set(ROUGH) else 1e-6
    return Drawn(lambda: Problem(model(), cost(), constraints(), X0, N), memory, capture, fault, known, tolerance)


def solved(problem: Problem, native: bool) -> Solution:
    kernels.use_native(native)
    try:
        U0 = torch.zeros(B, N, 2, dtype=D)
        return torchgco.AugmentedLagrangian(ILQR(max_iterations=3), max_outer_iterations=3).solve(problem, U0)
    finally:
        kernels.use_native(True)


def outcome(seed: int) -> str:
    """What becomes of a drawn problem."""
    make, memory, capture, fault, parts, tolerance = drawn_problem(seed)
    try:
        problem = make()
    except InputError as error:
        return "refused" if fault and "\n" not in str(error) else f"wrong: {parts}, {fault}: {error}"
    if fault:
        return f"wrong: accepted with {fault}: {parts}"
    for turn in range(3):
        found, fresh = solved(problem, native=True), make()
        expected = solved(fresh, native=False)
        kept = expected.X.abs().amax((1, 2)) < RANGE
        for name in ("X", "U", "cost", "violation"):
            pair = getattr(found, name)[kept], getattr(expected, name)[kept]
            if not torch.allclose(*pair, rtol=tolerance, atol=0.1 * tolerance):
                return f"wrong: {name} after {turn} changes of {parts}"
        states = open_loop(fresh.dynamics, fresh.x0, found.U)[kept]
        if not torch.allclose(states, found.X[kept], rtol=1e-3 * tolerance, atol=1e-3 * tolerance):
            return f"wrong: states after {turn} changes of {parts}"
        memory.change(capture)
    return "equal"


def main(first: int, count: int) -> None:
    warnings.simplefilter("ignore")
    for seed in range(first, first + count):
        try:
            print(seed, outcome(seed), flush=True)
        except Exception as error:
            print(seed, f"wrong: {type(error).__name__}: {error}".splitlines()[0], flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
