"""MPPI in C: all rounds of a sampler for a batch of problems."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.native.codegen.source import SAMPLER
from torchgco.native.engine import Engine, run
from torchgco.native.structures import Sampling
from torchgco.problem.problem import Problem

REALS = {torch.float64: ("double", 8), torch.float32: ("float", 16)}  # type and lanes in C


class Sampler:
    """The library that samples around the controls of a form of problems, in single or double precision.

    Raises:
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, engine: Engine, dtype: torch.dtype) -> None:
        self.engine = engine
        self.library = engine.further(dtype, lambda: engine.form.units(SAMPLER, *REALS[dtype]))

    def improve(self, problem: Problem, U: Tensor, sampling: Sampling) -> Tensor:
        """Controls (B, N, m): the weighted mean of the last round's samples, the first drawn around U.

        Args:
            sampling: all fields but `of`, `geometric` and `mean`.
        """
        mean = U.clone(memory_format=torch.contiguous_format)
        sampling.of = self.engine.packed(problem, X=problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1))
        sampling.geometric = torch.tensor([int(c.geometric) for c in problem.constraints], dtype=torch.int32)
        sampling.mean = mean
        run(self.library.tgco_sample, problem.B, 1, sampling)
        return mean
