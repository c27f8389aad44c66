"""MPPI in C: all rounds of a sampler for a batch of problems."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.native.codegen.source import SAMPLER
from torchgco.native.compiler import build
from torchgco.native.engine import Engine, run
from torchgco.native.packing import Array, Packed, array
from torchgco.problem.problem import Problem

REALS = {torch.float64: ("double", 8), torch.float32: ("float", 16)}  # type and lanes in C


@dataclass(frozen=True)
class Rounds:
    """The settings of MPPI's rounds (see guidance.MPPI)."""

    samples: int
    knots: int
    decay: float
    elite: int
    temperature: float
    collision_penalty: float
    linger: float  # MPPI's `dwell_cost`
    keys: Tensor  # (B, rounds) int64
    deviation: Tensor  # (B|1, m): standard deviations in the first round
    lower: Tensor  # (B|1, m): infinite where nothing is clamped
    upper: Tensor  # (B|1, m)
    left: Tensor | None  # (N,) int64: the knot of the noise before each stage; None: white
    share: Tensor | None  # (N,): the stage's place between that knot (0) and the next (1)


class _Sampling(ctypes.Structure):
    _fields_ = [
        ("of", ctypes.POINTER(Packed)),
        *((name, ctypes.c_int64) for name in ("samples", "rounds", "knots", "elite")),
        *((name, ctypes.c_double) for name in ("temperature", "collision_penalty", "linger", "decay")),
        ("keys", ctypes.c_void_p),
        *((name, Array) for name in ("deviation", "lower", "upper")),
        *((name, ctypes.c_void_p) for name in ("left", "share", "geometric", "mean")),
    ]


class Sampler:
    """The library that samples around the controls of a form of problems, in single or double precision.

    Raises:
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, engine: Engine, dtype: torch.dtype) -> None:
        self.engine = engine
        self.library = build(engine.form.source(SAMPLER, *REALS[dtype]))

    def improve(self, problem: Problem, U: Tensor, rounds: Rounds) -> Tensor:
        """Controls (B, N, m): the weighted mean of the last round's samples, the first drawn around U."""
        mean, keep = U.clone(memory_format=torch.contiguous_format), []
        packed = self.engine.packed(problem, {"X": problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1)})
        packed.constraints = len(problem.constraints)
        sampling = _Sampling(of=ctypes.pointer(packed), rounds=rounds.keys.shape[1], mean=mean.data_ptr())
        for name in ("samples", "knots", "decay", "elite", "temperature", "collision_penalty", "linger"):
            setattr(sampling, name, getattr(rounds, name))
        for name in ("deviation", "lower", "upper"):
            setattr(sampling, name, array(getattr(rounds, name), keep, knots=False))
        geometric = torch.tensor([int(c.geometric) for c in problem.constraints] or [0], dtype=torch.int32)
        sampling.keys, sampling.geometric = _place(rounds.keys, keep), _place(geometric, keep)
        if rounds.left is not None and rounds.share is not None:
            sampling.left = _place(rounds.left.to(torch.int32), keep)
            sampling.share = _place(rounds.share.to(torch.float64), keep)
        run(self.library.tgco_sample, problem.B, 1, sampling)
        return mean


def _place(value: Tensor, keep: list[Any]) -> int:
    keep.append(value := value.contiguous())
    return value.data_ptr()
