"""What the code of a problem depends on: equal signatures, equal kernels.

Torchgco's own parts read their fields and nothing else; a user's code may read anything, see `tracing.Facts`.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

from torchgco.problem.problem import Problem
from torchgco.tracing import Facts, Traced, Unseen


@dataclass(frozen=True, eq=False)
class Signature:
    """A key that problems share only where their native kernels are the same."""

    key: Hashable
    facts: Facts

    def covers(self, traces: Sequence[Traced]) -> bool:
        """Whether traces hold as long as the key: code has branched on no tensor's values, and none is unknown."""
        return all(not trace.looked and all(map(self.facts.know, trace.outside)) for trace in traces)


def signature(problem: Problem) -> Signature | None:
    """The signature of problems as they are now; None where a part's code may read what can't be seen."""
    cost: Any = problem.cost
    form = problem.N, problem.n, problem.m, str(problem.x0.dtype), str(problem.x0.device)
    quadratic = cost.diagonal if cost.kernel == "quadratic" else None
    kinds = tuple(None if c.kernel in ("function", "body") else c.kernel for c in problem.constraints)
    parts: list[Any] = [problem.dynamics, *([] if quadratic is not None else [cost])]
    parts += [c for c, kind in zip(problem.constraints, kinds, strict=True) if kind is None]
    try:
        facts = Facts(*parts)
    except Unseen:
        return None
    return Signature((form, quadratic, kinds, facts.key), facts)
