"""What is found for phases: a solution of each, and what only all of them together have."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.phases.phases import Phases
from torchgco.solution import Solution


@dataclass(frozen=True)
class PhasesSolution:
    """A `Solution` for each phase, in its own states and controls, and how all of them ended. It has their number.

    A phase's cost, violation and times are its own: it begins at 0 s, and `begins` says when. Status and iterations are
    those of all phases.
    """

    phases: Phases
    parts: tuple[Solution, ...]
    jumps: tuple[Tensor, ...]  # (B, m) of each jump: its controls
    cost: Tensor  # (B,): of all phases and jumps
    violation: Tensor  # (B,): largest of all phases and jumps, metres for lengths
    status: Tensor  # (B,) int64, see Status
    iterations: Tensor  # (B,) int64
    multipliers: Multipliers  # of all rows, as solvers see them: for `warm`

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, i: int) -> Solution:
        return self.parts[i]

    def __iter__(self) -> Iterator[Solution]:
        return iter(self.parts)

    @property
    def statuses(self) -> list[Status]:
        """The statuses by name; `.sentence` explains one."""
        return [Status(s) for s in self.status.tolist()]

    @property
    def begins(self) -> Tensor:
        """When each phase begins, and the last one ends, (B, P+1), s.

        Raises:
            InputError: a model without a time step.
        """
        lengths = torch.stack([one.duration for one in self.parts], dim=-1)
        return torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)

    @property
    def duration(self) -> Tensor:
        """How long all phases last, (B,), s."""
        return self.begins[:, -1]

    def __repr__(self) -> str:
        ended = ", ".join(f"{count} {name}" for name, count in Counter(s.name for s in self.statuses).items())
        return f"PhasesSolution(B={self.phases.B}, {len(self)} phases: {ended})"
