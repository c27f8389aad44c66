"""How a comparison of candidates is written into the record of a search."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.search.candidates import Candidates, Refine, Refined
from torchgco.search.following import Paths
from torchgco.solution import Comparison, Fate


def comparison(
    number: int,
    rows: Tensor,
    paths: Paths,
    refine: Refine,
    tracked: Candidates,
    relaxed: Candidates,
    sound: Tensor,
    refined: Refined,
    found: Tensor,
) -> Comparison:
    """The record of one comparison, from the candidates after each step.

    Args:
        number: of the pass in the solver's table.
        rows: (b,) places of the problems in the batch.
        sound: which of the relaxed candidates are, (b * count,) bool.
        found: (b,) bool: whether there is a proposal.
    """
    B, C = tracked.problem.B, tracked.count
    last = refined.candidates
    fate = torch.where(tracked.live, int(Fate.TRACKED), int(Fate.ABSENT)).view(B, C)
    _write(fate, relaxed, torch.where(sound, int(Fate.RELAXED), int(Fate.UNSOUND)), relaxed.live)
    known = _written(fate, relaxed, sound.to(torch.int64), relaxed.live, 0) == 1
    solved = known.gather(1, last.number.view(B, -1)).flatten() & (refine.top > 1)
    good = refined.cost.isfinite()
    _write(fate, last, torch.where(good, int(Fate.REFINED), int(Fate.FAILED)), solved)
    chosen = torch.zeros_like(last.live)
    chosen[refined.best[found]] = True
    _write(fate, last, torch.full_like(last.number, int(Fate.PROPOSED)), chosen)
    each = torch.arange(C, device=rows.device) // (C // paths.corners.shape[1])
    empty = tracked.X.new_full((B, C, *tracked.X.shape[1:]), torch.nan)
    cost = _written(empty[..., 0, 0], last, refined.cost, solved, torch.nan)
    return Comparison(
        number, rows, paths.corners, paths.classes, each.expand(B, C), fate, tracked.X.view_as(empty).clone(),
        _written(empty, relaxed, relaxed.X, relaxed.live, torch.nan), _written(empty, last, last.X, solved, torch.nan),
        cost,
    )  # fmt: skip


def _write(table: Tensor, candidates: Candidates, values: Tensor, where: Tensor) -> None:
    """Write the values (b * count, ...) of some candidates into a table (b, C, ...), in place."""
    chosen = where.nonzero().flatten()
    table[chosen // candidates.count, candidates.number[chosen]] = values[chosen]


def _written(like: Tensor, candidates: Candidates, values: Tensor, where: Tensor, empty: float) -> Tensor:
    table = torch.full_like(like, empty)
    _write(table, candidates, values, where)
    return table
