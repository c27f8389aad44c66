"""Rows of inequalities that have no place in a barrier: those that no variable moves, such as a bound on a given start
or a row that is constantly 0, and bounds that coincide.

A slack has no room in them, and their multipliers would explode. The first kind stays out of the solve, and is judged
at its end: what is feasible there, with no multiplier, is optimal with the row, too. Of two bounds that coincide, the
upper one becomes an equality, and the lower one stays out.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from torchgco.eager.model import Derivatives, Model
from torchgco.eager.rows import Group, joined
from torchgco.eager.state import Kinds, State, first_barrier, renew, settle

NUDGE = 1e-3  # how far from the iterate a row's slope is looked at again: it may vanish in one point alone
GOLDEN = 0.6180339887498949
ROUNDINGS = 2.0**12  # units of the last bit of its terms, up to which a change may be rounding along the stages


def sort_rows(kinds: Kinds, model: Model, t: State) -> None:
    """Which rows stay out of the barrier, of problems whose iterate and values c are new; in place."""
    t.out, t.fixes, t.room = torch.zeros_like(t.out), torch.zeros_like(t.fixes), torch.ones_like(t.room)
    tight = torch.zeros_like(t.out)
    for group in model.groups:
        if group.part.sense == "inequality":
            _measure_room(group, t)
            tight[:, group.place.rows] = _tight(kinds, group, t).flatten(1)
    rows = tight.any(-1).nonzero().flatten()
    if rows.numel() == 0:
        return
    some = t.take(rows)
    moves, tight = _moves(model.take(rows), some), tight[rows]
    is_state = torch.zeros_like(kinds.equality)
    for group in model.groups:
        is_state[group.place.rows] = group.is_bound and not group.of_controls
    t.out[rows] = some.out | (tight & ~moves)
    t.fixes[rows] = some.fixes & (moves | ~is_state | ~_looked_at(model, tight))


def _looked_at(model: Model, tight: Tensor) -> Tensor:
    """Rows of the constraints and knots with a tight row, (b, R)."""
    found = torch.zeros_like(tight)
    for group in model.groups:
        own = group.place.of(tight)
        found[:, group.place.rows] = own.any(-1, keepdim=True).expand_as(own).flatten(1)
    return found


def _measure_room(group: Group, t: State) -> None:
    """The room between two bounds of a variable; where they coincide, the upper one holds as an equality."""
    for j, l in _pairs(group):
        c, room, out = group.place.of(t.c), group.place.of(t.room), group.place.of(t.out)
        half = -0.5 * (c[..., j] + c[..., l])
        room[..., j] = room[..., l] = half.clamp(max=1.0)
        same = half == 0.0
        out[..., j] |= same
        out[..., l] |= same
        group.place.of(t.fixes)[..., j] |= same


def _pairs(group: Group) -> Iterator[tuple[int, int]]:
    """Rows of the upper and the lower bound of one variable; none of a constraint that isn't a bound."""
    if not group.is_bound:
        return
    above, below = (part.tolist() for part in group.variables(0))
    for l, variable in enumerate(below):
        if variable in above:
            yield above.index(variable), len(above) + l


def _tight(kinds: Kinds, group: Group, t: State) -> Tensor:
    """Rows (b, K, p) with less room than a slack is given at first, or than a guess is moved inside of its bounds."""
    c, room = group.place.of(t.c), torch.full_like(t.mu, kinds.how.bound_push).view(-1, 1, 1)
    if group.is_bound:
        of = (t.U if group.of_controls else t.X)[:, group.place.knots]
        above, below = group.variables(0)
        room = 2.0 * room * torch.cat((of[..., above], of[..., below]), dim=-1).abs().clamp(min=1.0)
    return c > -room


def _uneven(i: Tensor) -> Tensor:
    """Numbers in [1, 2): no row and no model is likely to let a sum of these cancel."""
    golden = GOLDEN * (i + 1)
    return 1.0 + golden - golden.floor()


def _changes(model: Model, t: State) -> tuple[Tensor, Tensor]:
    """A change of each free component of the start (b, n) and of each free control (b, N, m), by its own number."""
    free, n, (N, m) = model.problem.free_start, t.X.shape[-1], t.U.shape[1:]
    count = lambda first, last: torch.arange(first, last, dtype=t.X.dtype, device=t.X.device)
    x = torch.zeros_like(t.X[:, 0])
    if free is not None:
        x = torch.where(free, _uneven(-count(1, n + 1)), x)
    u = _uneven(count(0, N * m)).view(1, N, m).expand_as(t.U).clone()
    for group in model.groups:
        if group.is_bound and group.of_controls:
            fixes, above = group.place.of(t.fixes), group.variables(0)[0]
            at = u[:, group.place.knots]
            at[..., above] = torch.where(fixes[..., : len(above)], 0.0, at[..., above])
            u[:, group.place.knots] = at
    return x, u


def _responses(F: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """Changes [dx, du] (b, N+1, S) that follow from those of start and controls along slopes F (b, N, n, S)."""
    n, found = x.shape[-1], [x.unsqueeze(-1)]
    fx, by_u = F[..., :n].transpose(0, 1), (F[..., n:] @ u.unsqueeze(-1)).transpose(0, 1)
    for A, add in zip(fx.unbind(0), by_u.unbind(0), strict=True):
        found.append(torch.baddbmm(add, A, found[-1]))
    return joined(torch.stack(found, dim=1).squeeze(-1), u)


def _nearby(model: Model, t: State, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """A trajectory near the iterate, with the same gaps."""
    dynamics, U = model.problem.dynamics, t.U + NUDGE * u
    ahead, found = t.X[:, 1:] + t.gap, [t.X[:, 0] + NUDGE * x]
    for k in range(U.shape[1]):
        found.append(t.X[:, k + 1] + (dynamics.at(k).step(found[-1], U[:, k]) - ahead[:, k]))
    return torch.stack(found, dim=1), U


def _moves(model: Model, t: State) -> Tensor:
    """The rows (b, R) that a change of all free variables moves in one of two trajectories close together.

    A row may be flat in one point alone. A change that is within rounding of its terms is none.
    """
    x, u = _changes(model, t)
    rounded, found = ROUNDINGS * torch.finfo(t.X.dtype).eps, torch.zeros_like(t.out)
    for X, U in ((t.X, t.U), _nearby(model, t, x, u)):
        at = model.slopes(X, U)
        dz = _responses(at.F, x, u)
        found = found | ~(at.push(dz, t.c).abs() <= rounded * at.terms(dz, t.c))
    return found


def _is_broken(t: State, admitted: float) -> Tensor:
    """Rows (b, R) that were left out and are violated by more; of bounds that coincide none, as an equality stands."""
    return t.out & (t.room > 0.0) & (t.c > admitted)


def readmit(kinds: Kinds, model: Model, t: State, of: Tensor, admitted: float) -> Tensor:
    """Rows that were left out come in where they are broken by more than `admitted` and something moves them now.

    Of the problems `of` (b,); returns those with such rows.
    """
    changed = torch.zeros_like(of)
    rows = (of & _is_broken(t, admitted).any(-1)).nonzero().flatten()
    if rows.numel() == 0:
        return changed
    some, part = t.take(rows), model.take(rows)
    come = _is_broken(some, admitted) & _moves(part, some)
    some.out = some.out & ~come
    some.s = torch.where(come, kinds.how.bound_push, some.s)
    t.out[rows], t.s[rows] = some.out, some.s
    rows = rows[come.any(-1)]
    if rows.numel() == 0:
        return changed
    changed[rows] = True
    some, part = t.take(rows), model.take(rows)
    some.mu = first_barrier(kinds, some)
    some.watching, some.shortened = torch.zeros_like(some.watching), torch.zeros_like(some.shortened)
    some.least = torch.full_like(some.least, torch.inf)
    some.left = torch.full_like(some.left, torch.inf)
    settle(kinds, part, some)
    renew(kinds, part, some)
    t.put(rows, some)
    return changed


def relax(kinds: Kinds, model: Model, t: State) -> None:
    """Where a multiplier of an inequality explodes, rows leave each other no room: they are relaxed once.

    By a share of the violation tolerance, as IPOPT's bounds are, and by less where the controls change them little.
    """
    largest = torch.where(kinds.equality, 0.0, t.z).amax(-1) if t.z.shape[1] > 0 else torch.zeros_like(t.mu)
    rows = ((largest > kinds.how.explodes * t.raised) & ~t.rows_relaxed & ~t.watching).nonzero().flatten()
    if rows.numel() == 0:
        return
    some, part = t.take(rows), model.take(rows)
    some.rows_relaxed = torch.ones_like(some.rows_relaxed)
    at: Derivatives = part.slopes(some.X, some.U)
    change = at.push(_responses(at.F, *_changes(part, some)), some.c)
    room = kinds.how.relaxes * kinds.how.constr_viol_tol * torch.minimum(change.abs(), some.room)
    some.relaxed = torch.where(kinds.inside(some) & torch.isfinite(room), room, 0.0)
    some.s = some.s + some.relaxed
    settle(kinds, part, some)
    renew(kinds, part, some)
    t.put(rows, some)


def breaks_rows_left_out(kinds: Kinds, t: State) -> Tensor:
    """Whether rows that were left out are violated, (b,)."""
    return (t.out & ~t.fixes & ~kinds.equality & ~(t.c <= kinds.how.constr_viol_tol)).any(-1)


def split_multipliers(model: Model, t: State, lam: Tensor) -> None:
    """Multipliers lam (b, R) of two bounds that coincide: each has the sign of an inequality's; in place."""
    for group in model.groups:
        for j, l in _pairs(group):
            own, fixes = group.place.of(lam), group.place.of(t.fixes)[..., j]
            below = fixes & (own[..., j] < 0.0)
            own[..., l] = torch.where(below, -own[..., j], own[..., l])
            own[..., j] = torch.where(below, 0.0, own[..., j])


def join_multipliers(model: Model, t: State) -> None:
    """The same the other way round for a warm start: the equality takes both."""
    for group in model.groups:
        for j, l in _pairs(group):
            own = group.place.of(t.z)
            own[..., j] = torch.where(group.place.of(t.fixes)[..., j], own[..., j] - own[..., l], own[..., j])
