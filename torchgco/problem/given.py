"""A problem's parts as the user gave them, where tensors in them ask for gradients.

A problem holds numbers alone: solvers, pictures and judges never meet a gradient. What it was given is kept beside
them, and bound once more, with gradients recorded, where a solution is to be differentiated; or bound anew where an
optimiser has changed these tensors since.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from torchgco.base.gradients import asking, recording, without_gradients
from torchgco.base.shapes import as_states
from torchgco.problem.free_start import moved_inside
from torchgco.problem.goal import with_goal, without_goal

PARTS = "dynamics", "cost", "constraints", "x0"  # a goal judges trajectories and changes none: it takes no gradients


@dataclass(frozen=True)
class Given:
    """The parts of a problem, some tensors of which ask for gradients.

    Attributes:
        fields: all of the problem's fields as they were given.
        tensors: those that ask for gradients, with the numbers of changes that they had seen when they were bound.
        whole, then: what was made of the problem `whole` afterwards, such as a part of its batch.
    """

    fields: Mapping[str, Any]
    tensors: tuple[tuple[Tensor, int], ...]
    whole: Any = None
    then: tuple[Callable[[Any], Any], ...] = ()

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Given | None:
        """That of a problem's fields; None where nothing asks for gradients."""
        found = asking([fields[name] for name in PARTS])
        return cls(dict(fields), tuple((tensor, tensor._version) for tensor in found)) if found else None

    @property
    def numbers(self) -> dict[str, Any]:
        """The same fields without gradients."""
        return {name: without_gradients(part) if name in PARTS else part for name, part in self.fields.items()}

    @property
    def is_stale(self) -> bool:
        """Whether any of the tensors has been changed in place since they were bound."""
        return any(tensor._version != version for tensor, version in self.tensors)

    def followed(self, whole: Any, by: Callable[[Any], Any]) -> Given:
        """The same of what is made of a problem, `whole`."""
        return replace(self, whole=self.whole or whole, then=(*self.then, by))

    def anew(self, kind: Callable[..., Any]) -> Any:
        """The problem of these parts with their numbers as they are now."""
        return self._applied(kind(**self.fields))

    def recorded(self, problem: Any) -> Any:
        """`problem`, which is of these parts, with gradients recorded: its tensors lead to those that were given."""
        whole = self.whole or problem
        with recording():
            x0 = as_states(self.fields["x0"])
            dims = whole._dimensions(x0)
            parts = {name: self.fields[name].bind(dims) for name in ("dynamics", "cost")}
            goal = self.fields["goal"]
            rows = [part.bind(dims) for part in without_goal(goal, dims, self.fields["constraints"])]
            parts["constraints"] = with_goal(goal, rows, dims)
            parts["x0"] = moved_inside(x0, whole.free_start, parts["constraints"])
            return self._applied(whole._with(parts))

    def _applied(self, problem: Any) -> Any:
        """What was made of the problem."""
        for step in self.then:
            problem = step(problem)
        return problem
