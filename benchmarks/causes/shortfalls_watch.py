"""What `gco` does with the candidates of one problem in space, one per path: which it relaxes, compares and chooses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from torchgco.search.candidates import Candidates, Refining
from torchgco.search.paths import PathProposals, Proposal


@dataclass
class Search:
    """One search along paths. Candidates have the number of their path; a search for more paths extends the list."""

    count: int  # paths sought, those of the same homotopy class included
    relaxed: Sequence[int] = ()  # the cheapest first, as tracked
    compared: Sequence[int] = ()  # the sound ones of those taken, the cheapest first, as relaxed
    chosen: int | None = None  # None: no proposal
    ends: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)  # X, U of those refined to a good end


@contextmanager
def watching() -> Iterator[list[Search]]:
    """The searches made inside this context, in their order, each for a single problem."""
    searches: list[Search] = []
    numbers: list[int] = []  # of the candidates at hand
    methods = [(PathProposals, "_along"), (Candidates, "pick"), (Candidates, "refined")]
    along, pick, refined = (getattr(owner, name) for owner, name in methods)

    def noting_along(self: PathProposals, problem: Any, rest: Tensor, ways: Any, *more: Any, **named: Any) -> Proposal:
        assert problem.B == 1 and len(self.paces) == 1 and not self.initial_offsets
        numbers[:] = range(ways.paths.shape[1])
        searches.append(Search(len(numbers)))
        return along(self, problem, rest, ways, *more, **named)

    def noting_pick(self: Candidates, order: Tensor) -> Candidates:
        places = order[0].tolist()
        if not searches[-1].relaxed:
            searches[-1].relaxed = [numbers[place] for place in places if self.live[place]]
        numbers[:] = [numbers[place] for place in places]
        return pick(self, order)

    def noting_refined(self: Candidates, inner: Any, sound: Tensor, refining: Refining) -> Any:
        end, multipliers, best, cost = refined(self, inner, sound, refining)
        search = searches[-1]
        search.compared = [number for number, is_sound in zip(numbers, sound.tolist(), strict=True) if is_sound]
        counts = cost.isfinite() if refining.needed else sound[best]
        search.chosen = numbers[int(best)] if bool(counts) else None
        changed = (end.U != self.U).flatten(1).any(-1)  # a solve with a bad end leaves its candidate unchanged
        search.ends = {numbers[row]: (end.X[row], end.U[row]) for row in changed.nonzero().flatten().tolist()}
        return end, multipliers, best, cost

    try:
        for (owner, name), noting in zip(methods, (noting_along, noting_pick, noting_refined), strict=True):
            setattr(owner, name, noting)
        yield searches
    finally:
        for (owner, name), original in zip(methods, (along, pick, refined), strict=True):
            setattr(owner, name, original)
