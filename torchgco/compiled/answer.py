"""What a call of a compiled problem gives."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchgco.base.status import Status


@dataclass(frozen=True, slots=True)
class Answer:
    """What one call of a compiled problem gives; all tensors are copies."""

    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    K: Tensor  # (B, N, m, n): u = U + K (x - X)
    status: Tensor  # (B,) int64, see Status
    iterations: Tensor  # (B,) int64, of all solves of the call
    violation: Tensor  # (B,): largest violation, metres for lengths
    warm: Tensor  # (B,) bool: whether the solve from the last answer was enough
    seconds: float  # that the call took, without compiling
    t: Tensor | None = None  # (B, N+1): times of the knots where the time is free, s; else None

    @property
    def u(self) -> Tensor:
        """The first controls, (B, m)."""
        return self.U[:, 0]

    @property
    def duration(self) -> Tensor | None:
        """How long each trajectory lasts where the time is free, (B,), s; else None."""
        return None if self.t is None else self.t[:, -1]

    @property
    def statuses(self) -> list[Status]:
        return [Status(status) for status in self.status.tolist()]
