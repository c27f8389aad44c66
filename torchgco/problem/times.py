"""Trajectories over time: when each knot is, the states between knots, and tables at any rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchgco.base.autodiff import slope_along
from torchgco.base.errors import InputError
from torchgco.base.values import Values
from torchgco.dynamics.base import INTEGRATORS, Dynamics, FunctionDynamics
from torchgco.dynamics.names import Quantity, controls_of, states_of
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem

LENGTHS = "dt"  # the knot values of this name are the lengths of stages, s


def times(problem: Problem) -> Tensor:
    """The times t (N+1,) of the knots, s; (B, N+1) where they differ from problem to problem.

    Stages last `dt` of the model at that stage, or of FunctionDynamics the knot values named "dt". After a problem's
    own horizon time stands still.

    Raises:
        InputError: dynamics without a time step.
    """
    lengths = _lengths(problem)
    if bool((lengths == lengths[:1]).all()):
        lengths = lengths[:1]
    same = bool((lengths == lengths[:1, :1]).all())
    if problem.horizon is not None:
        knots = torch.arange(problem.N + 1, device=lengths.device).clamp(max=problem.stages.unsqueeze(-1))
    else:
        knots = torch.arange(problem.N + 1, device=lengths.device).expand(lengths.shape[0], -1)
    if same:  # products round once, sums at every stage
        t = lengths[:1, :1] * knots
    else:
        t = torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)
        t = t.expand(knots.shape[0], -1).gather(1, knots)
    return t[0] if t.shape[0] == 1 and problem.horizon is None else t


def _lengths(problem: Problem) -> Tensor:
    """The lengths of the stages, (B, N) or (1, N), s."""
    model = problem.dynamics
    if isinstance(model, FunctionDynamics) and not model.is_integrated and isinstance(model.values, Values):
        lengths = dict(zip(model.values.knot_names, model.values.knot_rows, strict=True)).get(LENGTHS)
        if lengths is not None and lengths[0, 0].numel() == 1:
            return lengths.flatten(1)
    each = [getattr(model.at(k), "dt", None) for k in range(problem.N)]
    if any(dt is None for dt in each):
        raise InputError("dynamics.dt", "a time step, for the times of the knots", "none")
    return problem.x0.new_tensor([each])


PIECES_AT_MOST = 16  # of a stage: their chords are 256 times as close to a path as the stage's own


class Paths(NamedTuple):
    """Trajectories of some problems by shorter steps, whose chords are as good as their paths."""

    rows: Tensor  # (b,): which problems
    pieces: int  # of each stage
    X: Tensor  # (b, N pieces + 1, n)


def between(dynamics: Dynamics, X: Tensor, U: Tensor, k: Tensor, h: Tensor, lengths: Tensor) -> Tensor:
    """The states (B, T, n) at times h (T,), s, after the knots k (T,), on trajectories X (B, N+1, n), U (B, N, m).

    A model that integrates a derivative is integrated over h in place of its time step: after a whole stage the state
    is that of the next knot, to rounding. Models with a step alone have the straight line between two knots.

    Args:
        k: stages, int64 within 0..N-1.
        lengths: of these stages, (T,), s.
    """
    x, u = X[:, k], U[:, k]
    model = dynamics.at(k)
    if not model.stretches:
        return x + (h / lengths).unsqueeze(-1) * (X[:, k + 1] - x)
    # The field times h, over a unit of time: integrators take one time step for all states.
    x = INTEGRATORS[model.integrator](lambda z: h.unsqueeze(-1) * model.field(z, u), x, 1.0)
    return x if model.is_integrated else model.settled(x)  # as its own steps are


def bulge(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """How far what is measured leaves the chords of trajectories X (B, N+1, n), U (B, N, m), halfway, (B,), m.

    Of a body that is where its balls are, of pairs that keep a distance the vector between them.
    """
    off = torch.zeros_like(X[:, 0, 0])
    parts: list[Any] = [row.bare for row in problem.constraints if row.bare.on_the_way(X) is not None]
    if not parts or len(X) == 0:
        return off
    middle, even = states_within(problem, X, U, 2)[:, :, 0], 0.5 * (X[:, :-1] + X[:, 1:])
    for row in parts:
        apart = row.on_the_way(middle) - row.on_the_way(even)
        off = torch.maximum(off, apart.norm(dim=-1).flatten(1).amax(-1))
    return off


def paths(problem: Problem, X: Tensor, U: Tensor, off: Tensor | None = None) -> list[Paths]:
    """Trajectories X (B, N+1, n), U (B, N, m) in pieces so short that paths leave their chords by at most 1e-3 m.

    A quarter of the bulge is left where a piece is half as long; no stage has more than `PIECES_AT_MOST`. Problems with
    as many pieces are together.

    Args:
        off: their bulges (B,), m, where these are known.
    """
    every = torch.arange(len(X), device=X.device)
    if len(X) == 0 or not problem.bends:
        return [Paths(every, 1, X)]
    off = bulge(problem, X, U) if off is None else off
    pieces = (off / ADMITTED).nan_to_num(1.0, 1.0, 1.0).sqrt().ceil().clamp(1, PIECES_AT_MOST)
    polylines = []
    for count in pieces.unique().int().tolist():
        rows = (pieces == count).nonzero().flatten()
        if count == 1:
            polylines.append(Paths(rows, 1, X[rows]))
            continue
        subset = problem.take(rows)
        fine = torch.cat((X[rows, :-1].unsqueeze(2), states_within(subset, X[rows], U[rows], count)), dim=2).flatten(
            1, 2
        )
        polylines.append(Paths(rows, count, torch.cat((fine, X[rows, -1:]), dim=1)))
    return polylines


def curves(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None = None) -> list[Paths]:
    """`paths` of which positions, too, whether anything measures them or not, leave their chords by at most 1e-3 m.

    Args:
        times: of the knots (B, N+1), s, where the time is free.
    """
    whole, X, U = at_times(problem, X, U, times)
    off = None
    if whole.bends and whole.dynamics.position is not None and len(X) > 0:
        apart = states_within(whole, X, U, 2)[:, :, 0] - 0.5 * (X[:, :-1] + X[:, 1:])
        off = apart[..., whole.dynamics.position].norm(dim=-1).amax(-1)
        off = torch.maximum(off, bulge(whole, X, U))
    return [part._replace(X=part.X[..., : problem.n]) for part in paths(whole, X, U, off)]


def states_within(problem: Problem, X: Tensor, U: Tensor, count: int) -> Tensor:
    """States (B, N, count - 1, n) at the ends of all but the last of `count` pieces of each stage."""
    N, dt = X.shape[1] - 1, float(problem.dynamics.dt)
    k = torch.arange(N, device=X.device).repeat_interleave(count - 1)
    h = dt / count * torch.arange(1, count, dtype=X.dtype, device=X.device).repeat(N)
    inner = between(problem.dynamics, X, U, k, h, torch.full_like(h, dt)).unflatten(1, (N, count - 1))
    if problem.horizon is None:
        return inner
    return torch.where(problem.running[..., None, None], inner, X[:, :-1].unsqueeze(2))  # at rest after the last knot


TIME_COLUMN = "t [s]"
RATE_OF_POSITION, SECOND_RATE = "d{}/dt", "d2{}/dt2"  # of the position, where states have the usual names
ROUNDING = 1e-9  # of a sample: an end this close after one is that sample's


def sampled(dynamics: Dynamics | None, X: Tensor, U: Tensor, t: Tensor, rate: float | None) -> dict[str, np.ndarray]:
    """Columns by label: times, states, controls, and what the model knows beside them.

    Controls hold from their knot to the next one; the last row has the last ones. Of models that integrate a
    derivative, states between the knots are the integrator's, and of their position come the acceleration and, where it
    isn't a state, the velocity. Of others there are straight lines between the knots.

    Args:
        dynamics: None: not known, and numbers stand for names.
        X, U, t: of one trajectory, (N+1, n), (N, m), (N+1,) s.
        rate: samples per second; None: the knots.
    """
    k, h, lengths = _places(t, rate)
    x, u = X[k].clone(), U[k]
    if bool((h > 0).any()):
        path = X.unsqueeze(0), U.unsqueeze(0), k, h, lengths
        x = between(dynamics, *path)[0] if dynamics is not None else x + (h / lengths).unsqueeze(-1) * (X[k + 1] - x)
    ends = h >= lengths * (1 - ROUNDING)  # a whole stage leads to the knot after it, which may not obey the model
    x[ends] = X[k[ends] + 1]
    if dynamics is None:
        named = [Quantity(f"x[{i}]") for i in range(X.shape[-1])], [Quantity(f"u[{i}]") for i in range(U.shape[-1])]
    else:
        named = states_of(dynamics), controls_of(dynamics)
    columns = {TIME_COLUMN: t[k] + h}
    columns |= {state.label: x[:, i] for i, state in enumerate(named[0])}
    if dynamics is not None:
        states = {s.name.partition(" [")[0]: x[:, i] for i, s in enumerate(named[0])}  # a unit may stand in a name
        columns |= _of_position(dynamics, x, u, k, states) | dynamics.derived(x, u)
    columns |= {control.label: u[:, i] for i, control in enumerate(named[1])}
    return {label: values.detach().cpu().numpy() for label, values in columns.items()}


def sample_times(first: float, last: float, rate: float) -> np.ndarray:
    """Times from `first` on, s, `rate` a second, and the `last` one, which may come sooner after the one before."""
    times = first + np.arange(int((last - first) * rate + ROUNDING) + 1) / rate
    return times if (last - times[-1]) * rate <= ROUNDING else np.append(times, last)


def _places(t: Tensor, rate: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Stages k (T,), times h since their knots and lengths of stages, s, of the samples from t[0] to t[-1]."""
    N = len(t) - 1
    if rate is None:
        k = torch.arange(N + 1, device=t.device).clamp(max=N - 1)
        h = torch.zeros_like(t)
        h[-1] = t[-1] - t[-2]
    else:
        times = torch.from_numpy(sample_times(float(t[0]), float(t[-1]), rate)).to(t)
        k = (torch.searchsorted(t.contiguous(), times + ROUNDING / rate, right=True) - 1).clamp(0, N - 1)
        h = (times - t[k]).clamp(min=0.0)
    return k, h, t[k + 1] - t[k]


def _of_position(
    dynamics: Dynamics, x: Tensor, u: Tensor, k: Tensor, states: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Velocity and acceleration of the position, (T,) each, of models that integrate a derivative.

    Their names are `vx` and `ax`; where states have such names, but are something else, in the vehicle's axes for
    instance, `dx/dt` and `d2x/dt2`.
    """
    xyz = dynamics.position
    if xyz is None or xyz.stop - xyz.start > 3 or not dynamics.is_integrated:
        return {}
    model, x, u = dynamics.at(k), x.unsqueeze(0), u.unsqueeze(0)
    rates = model.field(x, u)
    change = slope_along(lambda z: model.field(z, u), (x,), (rates,))
    columns = {}
    for name, other, unit, values in (("v{}", RATE_OF_POSITION, "m/s", rates), ("a{}", SECOND_RATE, "m/s^2", change)):
        new = {name.format(axis): values[0, :, xyz.start + i] for i, axis in enumerate("xyz"[: xyz.stop - xyz.start])}
        if all(torch.allclose(states[key], new[key]) for key in new if key in states):
            columns |= {f"{key} [{unit}]": new[key] for key in new if not new.keys() & states.keys()}
        else:
            columns |= {f"{other.format(key[-1])} [{unit}]": values for key, values in new.items()}
    return columns
