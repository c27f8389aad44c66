"""Gates that vehicles have passed in flight, one after the other, measured between the samples too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement
from torchgco.constraints.gates import GateBalls, gates_of
from torchgco.judging.gates import through_balls
from torchgco.obstacles.base import ADMITTED
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Passing(PerElement):
    """The gates of B problems, balls with centers (B, G, 3) and radii (B, G), m, and how many are passed, (B,) int64.

    A gate is passed where the straight line from one sample to the next comes within its radius, and a millimetre, once
    all gates before it have been.
    """

    centers: Tensor
    radii: Tensor
    passed: Tensor

    batched: ClassVar[tuple[str, ...]] = ("centers", "radii", "passed")

    @classmethod
    def among(cls, problem: Problem) -> Self | None:
        """Those of the problems, none of them passed; None without gates.

        Raises:
            InputError: gates that are squares.
        """
        gates = gates_of(problem)
        if gates is None:
            return None
        if not isinstance(gates, GateBalls):
            raise InputError("gates.normals", "balls as gates of a mission", "squares")
        return cls(gates.centers, gates.sizes, torch.zeros_like(gates.sizes[:, 0], dtype=torch.int64))

    @property
    def done(self) -> Tensor:
        """Whether all gates are passed, (B,) bool."""
        return self.passed == self.radii.shape[1]

    def after(self, a: Tensor, b: Tensor) -> Tensor:
        """How many are passed after straight lines from a to b (B, 3), m; (B,) int64."""
        passed, each = self.passed.clone(), torch.arange(len(self.passed))
        for _ in range(self.radii.shape[1]):
            next_gate = passed.clamp(max=self.radii.shape[1] - 1)
            center, reach = self.centers[each, next_gate], self.radii[each, next_gate] + ADMITTED
            more = (segment_distance(a - center, b - center) <= reach) & (passed < self.radii.shape[1])
            if not bool(more.any()):
                break
            passed += more
        return passed

    def along(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """A flight along samples p (T, 3) of the first problem: when, and how closely, it passes its gates.

        Returns:
            The sample by which each gate is passed, (G,) int64, T for those that aren't; and the least distance from
            its middle on the way through it, m, or until the end; infinite for those after a gate that isn't passed.
        """
        G, T = self.radii.shape[1], len(p)
        if T < 2:
            return torch.full((G,), T), torch.full((G,), torch.inf, dtype=p.dtype)
        way = through_balls(self.centers[:1], self.radii[:1], p.unsqueeze(0))
        return way.when[0], way.distance[0]
