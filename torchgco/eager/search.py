"""The filter and its line search (Waechter and Biegler 2006), with second-order corrections and a watchdog."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.eager import step as riccati
from torchgco.eager.model import Derivatives, Model
from torchgco.eager.rows import Dense, joined
from torchgco.eager.state import STATE_FIELDS, Kinds, State, column, evaluate, logarithms, residuals, theta_of

# The step -----------------------------------------------------------------------------------------------------------


@dataclass
class Step:
    """What a step of b problems is made of, and the step."""

    at: Derivatives
    H: Tensor  # with the rows' squares
    factors: riccati.Factors
    aim: Tensor  # (b, N, n): gaps to close
    r: Tensor  # (b, R): residuals to close
    dx: Tensor
    du: Tensor
    yn: Tensor  # costates of a full step
    ds: Tensor
    dz: Tensor


MADE = "aim", "r", "dx", "du", "yn", "ds", "dz"  # of a step for each problem, by `stepped`


def curvature(kinds: Kinds, at: Derivatives, t: State) -> Tensor:
    """The Hessian of the condensed system (b, N+1, S, S)."""
    hold = torch.where(kinds.fixed(t), 1.0 / (column(t.soft) * t.gives), 0.0)
    return at.with_squares(torch.where(kinds.inside(t), t.z / t.s, hold))


def stepped(kinds: Kinds, step: Step, t: State) -> None:
    """The step that the factors give for the residuals `aim` and r; in place."""
    inside, fixed = kinds.inside(t), kinds.fixed(t)
    objective, soft, mu = column(t.objective), column(t.soft) * t.gives, column(t.mu)
    sigma = t.z / t.s
    by = torch.where(inside, sigma * step.r + mu / t.s, 0.0)
    by = torch.where(fixed, objective * t.z + step.r / soft, by)
    g = step.at.cost + step.at.pull(by.unsqueeze(1))[:, 0]
    step.dx, step.du, step.yn = riccati.solve(step.factors, g, step.aim)
    change = step.at.push(joined(step.dx, step.du), step.r) + step.r
    step.ds = torch.where(inside, -change, 0.0)
    free = torch.where(inside, (mu + t.z * change) / t.s - t.z, 0.0)
    step.dz = torch.where(fixed, change / soft, free)


def part_of(step: Step, rows: Tensor) -> Step:
    """The step of the problems `rows`; what the factors are made of, and these, are those of all."""
    own = {name: getattr(step, name)[rows] for name in MADE}
    return replace(step, at=taken(step.at, rows), **own)


def taken(at: Derivatives, rows: Tensor) -> Derivatives:
    """Derivatives of the problems `rows`, as a step needs them: F and H are those of all."""
    if rows.numel() == at.cost.shape[0]:
        return at
    slopes = [replace(part, J=part.J[rows]) if isinstance(part, Dense) else part for part in at.slopes]
    return replace(at, cost=at.cost[rows], slopes=slopes)


def put_step(step: Step, rows: Tensor, some: Step) -> None:
    """Write what `stepped` makes of some problems."""
    for name in MADE:
        getattr(step, name)[rows] = getattr(some, name)


# The filter ---------------------------------------------------------------------------------------------------------


def _refused(t: State, theta: Tensor, phi: Tensor) -> Tensor:
    """Whether the filter refuses a trial, (b,)."""
    worse = (theta.unsqueeze(-1) >= t.filter[..., 0]) & (phi.unsqueeze(-1) >= t.filter[..., 1])
    return ~(theta <= t.highest) | worse.any(-1)


def _remember(kinds: Kinds, t: State, of: Tensor) -> None:
    """Add the iterates of the problems `of` to their filters, without what they dominate; the oldest is given up."""
    how = kinds.how
    pair = torch.stack(((1.0 - how.gamma_theta) * t.theta, t.phi - how.gamma_phi * t.theta), dim=-1).unsqueeze(1)
    stays = (t.filter < pair).any(-1)
    order = (~stays).to(torch.int64).argsort(dim=1, stable=True)
    kept = torch.where(stays.unsqueeze(-1), t.filter, torch.inf)
    kept = kept.gather(1, order.unsqueeze(-1).expand_as(kept))
    count, pairs = stays.sum(-1), t.filter.shape[1]
    full = count == pairs
    kept = torch.where(full.view(-1, 1, 1), kept.roll(-1, dims=1), kept)
    place = torch.where(full, pairs - 1, count)
    here = torch.arange(pairs, device=place.device) == place.unsqueeze(-1)
    new = torch.where(here.unsqueeze(-1), pair, kept)
    t.filter = torch.where(of.view(-1, 1, 1), new, t.filter)


def _good(kinds: Kinds, t: State, alpha: Tensor, slope: Tensor, theta: Tensor, phi: Tensor) -> tuple[Tensor, Tensor]:
    """Which trials are accepted, and which of these by the Armijo condition; `slope` is that of phi."""
    how, old = kinds.how, t.theta
    noise = how.noise * torch.finfo(phi.dtype).eps * t.phi.abs()
    finite = torch.isfinite(theta) & torch.isfinite(phi)
    gain = torch.where(slope < 0.0, alpha * (-slope).clamp(min=0.0).pow(how.s_phi), 0.0)
    descends = (old <= t.lowest) & (gain > how.delta * old.pow(how.s_theta)) & ~t.restoring
    falls = phi - t.phi - noise <= how.eta_phi * alpha * slope
    less = (theta <= (1.0 - how.gamma_theta) * old) | (phi - noise <= t.phi - how.gamma_phi * old)
    usual = ~_refused(t, theta, phi) & torch.where(descends, falls, less)
    good = torch.where(t.restoring, theta <= (1.0 - how.eta_phi * alpha) * old, usual)
    descends = descends & finite & ~_refused(t, theta, phi)
    return good & finite, descends


# The line search ----------------------------------------------------------------------------------------------------


def _longest(kinds: Kinds, t: State, step: Step, tau: Tensor) -> tuple[Tensor, Tensor]:
    """The longest steps (b,) that leave a share 1 - tau of slacks, and of multipliers."""
    inside, tau = kinds.inside(t), column(tau)

    def most(values: Tensor, change: Tensor) -> Tensor:
        falls = inside & (change < 0.0)
        length = torch.where(falls, -tau * values / torch.where(falls, change, 1.0), 1.0)
        return length.amin(-1).clamp(max=1.0) if length.shape[1] > 0 else torch.ones_like(t.mu)

    return most(t.s, step.ds), most(t.z, step.dz)


@dataclass
class Trial:
    """Iterates at the end of steps."""

    X: Tensor
    U: Tensor
    cost: Tensor
    c: Tensor
    gap: Tensor
    s: Tensor
    theta: Tensor
    phi: Tensor


def _attempt(kinds: Kinds, model: Model, t: State, step: Step, alpha: Tensor) -> Trial:
    """The trial at step lengths alpha (b,)."""
    by = alpha.view(-1, 1, 1)
    X, U = t.X + by * step.dx, t.U + by * step.du
    found = evaluate(model, t, X, U)
    # A slack that the row leaves more room for takes it: theta and phi fall both.
    s = torch.maximum(t.s + column(alpha) * step.ds, -found.c)
    s = torch.where(kinds.inside(t), s, t.s)
    theta = theta_of(found.gap, residuals(kinds, t, found.c, s))
    return Trial(X, U, found.cost, found.c, found.gap, s, theta, found.cost - t.mu * logarithms(s))


def _descent(kinds: Kinds, t: State, step: Step) -> Tensor:
    """The slope of phi along the step, (b,)."""
    along = (step.at.cost * joined(step.dx, step.du)).flatten(1).sum(-1)
    return along - t.mu * torch.where(kinds.inside(t), step.ds / t.s, 0.0).sum(-1)


def _accept(kinds: Kinds, t: State, step: Step, trial: Trial, won: Tensor, alpha: Tensor, dual: Tensor) -> None:
    """Move the problems `won` to their trials."""
    by, bound = alpha.view(-1, 1, 1), kinds.how.kappa_sigma
    center = column(t.mu) / trial.s
    z = torch.minimum(t.z + column(dual) * step.dz, bound * center)
    z = torch.where(kinds.inside(t), torch.maximum(z, center / bound), t.z + column(alpha) * step.dz)
    z = torch.where(kinds.inside(t) | kinds.fixed(t), z, 0.0)
    new = {
        "X": trial.X, "U": trial.U, "y": t.y + by * (step.yn - t.y), "gap": trial.gap, "cost": trial.cost,
        "c": trial.c, "s": trial.s, "z": z,
    }  # fmt: skip
    for name, value in new.items():
        old = getattr(t, name)
        setattr(t, name, torch.where(won.view(-1, *[1] * (old.dim() - 1)), value, old))


def _keep(t: State, of: Tensor) -> None:
    """Keep the iterates of the problems `of`."""
    t.kept = tuple(
        torch.where(of.view(-1, *[1] * (old.dim() - 1)), getattr(t, name), old)
        for name, old in zip(STATE_FIELDS, t.kept, strict=True)
    )


def go_back(t: State, of: Tensor) -> None:
    """Return to the iterates that were kept, of the problems `of`."""
    for name, kept in zip(STATE_FIELDS, t.kept, strict=True):
        old = getattr(t, name)
        setattr(t, name, torch.where(of.view(-1, *[1] * (old.dim() - 1)), kept, old))
    t.watching = t.watching & ~of
    t.shortened = torch.where(of, 0, t.shortened)


def _watch(kinds: Kinds, t: State, moving: Tensor, slope: Tensor, full: Tensor) -> None:
    """Problems whose steps have been short for long take some full ones on trial (the paper's watchdog)."""
    begins = moving & ~t.watching & ~t.restoring & (t.shortened >= kinds.how.watchdog_shortened_iter_trigger)
    if not bool(begins.any()):
        return
    t.watching = t.watching | begins
    t.slope, t.alpha = torch.where(begins, slope, t.slope), torch.where(begins, full, t.alpha)
    t.ahead = torch.where(begins, 0, t.ahead)
    _keep(t, begins)


@dataclass
class _Found:
    """What a look at trials says of the problems."""

    good: Tensor  # moves to the trial
    back: Tensor  # returns to the iterate that was kept
    again: Tensor  # a second-order correction comes next
    undo: Tensor  # back to the uncorrected step


def _judged(
    kinds: Kinds, t: State, trial: Trial, slope: Tensor, alpha: Tensor, full: Tensor, corrected: Tensor, first: bool
) -> _Found:
    """What comes of the trials at alpha; the filters, and what is remembered of accepted ones, in place."""
    how, watching = kinds.how, t.watching.clone()
    begun = torch.where(watching, t.slope, slope), torch.where(watching, t.alpha, alpha)
    accepted, descends = _good(kinds, t, begun[1], begun[0], trial.theta, trial.phi)
    sound = watching & ~accepted & (trial.theta <= t.highest) & torch.isfinite(trial.phi)
    ahead = sound & (t.ahead < how.watchdog_trial_iter_max)
    t.ahead = t.ahead + sound.to(t.ahead.dtype)
    back = watching & ~accepted & ~ahead
    t.watching = watching & ~accepted
    noted = accepted & ~descends & ~t.restoring
    if bool(noted.any()):
        _remember(kinds, t, noted)
    refused = ~accepted & ~watching
    again = torch.zeros_like(refused)
    if first and how.max_soc:
        again = refused & ~t.restoring & (trial.theta >= t.theta)
    t.theta, t.phi = torch.where(accepted, trial.theta, t.theta), torch.where(accepted, trial.phi, t.phi)
    short = accepted & ~watching
    t.crawls = torch.where(accepted, short & (alpha < how.crawl * full), t.crawls & ~ahead)
    t.shortened = torch.where(accepted, torch.where(short & (alpha < full), t.shortened + 1, 0), t.shortened)
    return _Found(accepted | ahead, back, again, refused & ~again & corrected)


def search(kinds: Kinds, model: Model, t: State, step: Step, moving: Tensor, tau: Tensor) -> Tensor:
    """Move the problems `moving` along their steps; returns which found a step length, (b,)."""
    how, slope = kinds.how, _descent(kinds, t, step)
    full, dual = _longest(kinds, t, step, tau)
    alpha = full.clone()
    _watch(kinds, t, moving, slope, full)
    open_ = moving.nonzero().flatten()
    won, corrected = torch.zeros_like(t.watching), torch.zeros_like(t.watching)
    every, plain, first = torch.arange(len(alpha), device=alpha.device), step, True  # plain: before corrections
    while open_.numel() > 0:
        some, part, own = (t, model, step) if open_.numel() == len(alpha) else (
            t.take(open_), model.take(open_), part_of(step, open_)
        )  # fmt: skip
        a, d = alpha[open_], dual[open_]
        trial = _attempt(kinds, part, some, own, a)
        found = _judged(kinds, some, trial, slope[open_], a, full[open_], corrected[open_], first)
        _accept(kinds, some, own, trial, found.good, a, d)
        if bool(found.back.any()):
            go_back(some, found.back)
        done = found.good | found.back
        halves = ~done & ~found.again
        a = torch.where(halves, 0.5 * torch.where(corrected[open_], full[open_], a), a)
        if some is not t:
            t.put(open_, some)
        again, undo = open_[found.again], open_[found.undo]
        if again.numel() > 0:
            plain = part_of(step, every)
            _correct(kinds, t, step, trial, found.again, again, alpha[again])
        if undo.numel() > 0:
            put_step(step, undo, part_of(plain, undo))
        if again.numel() + undo.numel() > 0:
            p, q = (length[open_] for length in _longest(kinds, t, step, tau))
            a, d = torch.where(found.again, p, a), torch.where(found.again | found.undo, q, d)
        alpha[open_], dual[open_] = a, d
        won[open_] = done
        corrected[open_] = found.again
        open_ = open_[~done & (found.again | (a >= how.alpha_min))]
        first = False
    return won


def _correct(kinds: Kinds, t: State, step: Step, trial: Trial, of: Tensor, rows: Tensor, alpha: Tensor) -> None:
    """Second-order corrections of the problems `rows`: steps that close what trials at alpha left, too; in place.

    `of` are their places among the trials.
    """
    some, own = t.take(rows), part_of(step, rows)
    own.factors = riccati.take(step.factors, rows)
    left = residuals(kinds, some, trial.c[of], trial.s[of])
    own.aim, own.r = alpha.view(-1, 1, 1) * own.aim + trial.gap[of], column(alpha) * own.r + left
    stepped(kinds, own, some)
    put_step(step, rows, own)
