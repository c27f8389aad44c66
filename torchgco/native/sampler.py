"""MPPI in C: all rounds of a sampler for a batch of problems."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.draws import words
from torchgco.base.shapes import repeated
from torchgco.eager.sampling import Sampling
from torchgco.native import structures
from torchgco.native.codegen.source import LANES, SAMPLER
from torchgco.native.cuda import source as cuda
from torchgco.native.engine import Engine, run
from torchgco.native.structures import array
from torchgco.problem.problem import Problem

REALS = {torch.float64: ("double", LANES), torch.float32: ("float", 2 * LANES)}  # type and lanes in C


class Sampler:
    """The library that samples around the controls of a form of problems, in single or double precision.

    Raises:
        NativeError: no compiler, or it refuses the source.
    """

    def __init__(self, engine: Engine, dtype: torch.dtype) -> None:
        self.engine = engine
        self.library = engine.further(
            dtype, lambda: engine.form.units(SAMPLER, *REALS[dtype]), cuda.SAMPLER, REALS[dtype][0]
        )

    def improve(self, problem: Problem, U: Tensor, how: Sampling) -> Tensor:
        """See `kernels.in_pytorch.Kernels.sample`."""
        mean = U.clone(memory_format=torch.contiguous_format)
        wide = problem.x0.new_full((1, 1, 1, problem.m), torch.inf)
        lower, upper = (array(bound.squeeze(2).transpose(0, 1), knots=True) for bound in how.bounds or (-wide, wide))
        rounds = structures.Sampling(
            of=self.engine.packed(problem, X=repeated(problem.x0, problem.N + 1)), mean=mean,
            samples=how.samples, rounds=how.rounds, knots=how.noise_knots, decay=how.decay, elite=how.elite,
            temperature=how.temperature, collision_penalty=how.collision_penalty, dwell_cost=how.dwell_cost,
            keys=torch.stack([words(how.key, i) for i in range(how.rounds)], dim=-1),
            deviation=array(how.sigma.sqrt(), knots=True), lower=lower, upper=upper,
            geometric=torch.tensor([int(c.geometric) for c in problem.constraints], dtype=torch.int32),
        )  # fmt: skip
        if how.left is not None and how.share is not None:
            rounds.left, rounds.share = how.left.to(torch.int32), how.share.double()
        run(self.library.tgco_sample, problem.B, 1, rounds)
        return mean
