"""What is known of the form of problems: of a problem with its subsets, other starts and numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Known:
    """Found at first need, and shared by all problems of the form.

    Attributes:
        current: a solve works on them, and has looked at their code: see `kernels.current`.
        row_shapes: knots and rows of every constraint.
        paths: whether the roadmap can seek any.
        in_c, in_pytorch: kernels; `in_c` is False where those in C can't serve.
        code: the signature that the kernels in C were found, or are kept, by; None where it doesn't tell all.
        interior: the interior point with functions that Python computes: it knows the shapes of rows.
        expects_interior: the interior point will be asked for.
        warned: reasons for PyTorch's kernels that a warning has named.
        packed: of "dynamics", "cost" and constraints by their place: the part that was packed for C last, of how many
            problems, and what was made of it.
        lifted: what is known of problems with further states, by their kind: see `horizons` and `carried`.
    """

    current: bool = False
    row_shapes: tuple[tuple[int, int], ...] | None = None
    paths: bool | None = None
    in_c: Any = None
    in_pytorch: Any = None
    code: Any = None
    interior: Any = None
    expects_interior: bool = False
    warned: set[str] = field(default_factory=set)
    packed: dict[str | int, tuple[Any, int, Any]] = field(default_factory=dict)
    lifted: dict[str, Known] = field(default_factory=dict)

    def of_lifted(self, kind: str) -> Known:
        """What is known of the problems with further states; a solve that works on these works on those."""
        return self.lifted.setdefault(kind, Known(current=self.current, warned=self.warned))
