"""Tables of passes that many tests use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from torchgco import GCO, AugmentedLagrangian, PathProposals, Problem, Restarts
from torchgco.search import ClearChords, Follow, FromProposal, FromSamples, IntoGoal, Refine, Row, Solve
from torchgco.search import rows as table
from torchgco.search.proposals import Proposal, propose


def varied(proposals: PathProposals, **changes: Any) -> PathProposals:
    """The pass with other fields: its own, of every way to follow a path, or `top`, the number of refined ones."""
    ways = {name: changes.pop(name) for name in {field.name for field in fields(Follow)} & set(changes)}
    if "top" in changes:
        changes["refine"] = replace(proposals.refine, top=changes.pop("top"))
    return replace(proposals, follow=tuple(replace(follow, **ways) for follow in proposals.follow), **changes)


def closer(proposals: PathProposals) -> PathProposals:
    """The row after `proposals`: the same paths, followed closer where they led to no proposal."""
    follow = tuple(map(table.closer, proposals.follow))
    return replace(proposals, when="unproposed", roadmaps=(), follow=follow, relax_top=None)


def without(solver: Restarts, *kinds: type) -> Restarts:
    """The solver with the steps of its rows one by one, without those of these kinds."""
    left = tuple(one for one in solver.passes.steps if not isinstance(one, kinds))
    assert len(left) < len(solver.passes.steps)
    return replace(solver, passes=left)


def rounds(proposals: PathProposals) -> tuple[PathProposals, PathProposals]:
    """The rows of one round as the default makes it: `proposals`, and `closer`."""
    return proposals, closer(proposals)


def thorough(proposals: PathProposals) -> PathProposals:
    """More paths, followed longer, for the problems where an attempt along the best path failed."""
    more = 2 * proposals.num_paths
    follow = tuple(replace(way, iterations=3 * way.iterations, pace=None) for way in proposals.follow)
    top = max(more, proposals.refine.top)
    return replace(proposals, when="far", num_paths=more, follow=follow, relax_top=None, refine=Refine(top=top))


def proposed(proposals: PathProposals, problem: Problem) -> Proposal:
    """The proposals of one round."""
    return propose(rounds(proposals), problem)


def restarts(
    local: AugmentedLagrangian,
    proposals: PathProposals | None = None,
    guidance: GCO | None = None,
    attempts: int = 4,
    every: bool = False,
    last: Sequence[Row] = (ClearChords(),),
    after: int | None = 3,
) -> Restarts:
    """A table like the default's: along paths, more thoroughly where that fails, then from samples.

    attempts  after a trajectory is caught
    every     all of them, even where one arrives
    after     outer iterations after which a single contact counts as caught, where there is guidance
    """
    when, first = "caught" if every else "unarrived", Solve(single_contact_after=None if guidance is None else after)
    passes: list[Row] = [Solve("end", "pathless"), first]
    if proposals is not None:
        passes += [*rounds(replace(proposals, when=when)), FromProposal(), IntoGoal()]
        passes += [*rounds(thorough(proposals)), FromProposal()] if attempts > 1 else []
    passes.append(FromSamples("caught" if every and proposals is None else "unproposed"))
    passes += [FromSamples(when, redraws=attempts - 1)] if attempts > 1 else []
    return Restarts(replace(local, guidance=guidance), (*passes, IntoGoal(), *last))
