"""The track of 19 gates for a quadrotor with four rotors, in the least time, with a duration for each leg.

The README of TOGT-Planner gives 17.56 s for the method of Foehn, Romero and Scaramuzza, "Time-optimal planning for
quadrotor waypoint flight" (Science Robotics, 2021). Gates, start, end and vehicle are retyped from
github.com/FSC-Lab/TOGT-Planner (MIT licence), resources/racetrack/race_uzh_19wp.yaml and
parameters/cpc/cpc_quad.yaml: seven places, 2.7 times around.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.lib.page import markdown
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InteriorPoint,
    Problem,
    Solution,
    StateBounds,
)
from torchgco.problem.in_time import guessing_times

D = torch.float64
START, END, WITHIN = (-5.0, 4.5, 1.2), (4.75, -0.9, 1.2), 0.3  # m
PLACES = (
    (-1.1, -1.6, 3.6), (9.2, 6.6, 1.0), (9.2, -4.0, 1.2), (-4.5, -6.0, 3.5), (-4.5, -6.0, 0.8), (4.75, -0.9, 1.2),
    (-2.8, 6.8, 1.2),
)  # fmt: skip
GATES = tuple(PLACES[i % 7] for i in range(19))
MASS, GRAVITY, INERTIA = 0.85, 9.8066, (0.001, 0.001, 0.0017)  # kg, m/s^2, kg m^2
ARM, TURN = 0.15, 0.05  # m, to each axis; yaw torque per newton, m
STRONGEST, FASTEST = 6.879, (15.0, 15.0, 3.0)  # N per rotor, rad/s
PACE = 8.0  # m/s, of the guess on straight lines
MEAN = float(torch.tensor([START, *GATES, END], dtype=D).diff(dim=0).norm(dim=-1).mean())  # m, of a leg
RACE, FINER = InteriorPoint(max_iterations=1000), 1e-2  # the barrier from a solution with fewer stages
# The barrier of a plan that is aimed. Many trajectories take as long, to 0.1 ms: from a larger one a solve ends at one
# whose thrusts differ by newtons, and whose flight misses by as much as before, but elsewhere.
AIMED = 1e-4
AIMS = 3  # plans that are aimed at most, until a flight passes all gates


def rates(x: Tensor, u: Tensor) -> Tensor:
    """x' of x = [p, v, q, w] (..., 13) under the thrusts u (..., 4), N; the thrust's axis is divided by |q|^2."""
    _, v, q, w = x.split((3, 3, 4, 3), dim=-1)
    q0, q1, q2, q3 = q.unbind(-1)
    w1, w2, w3 = w.unbind(-1)
    f1, f2, f3, f4 = u.unbind(-1)
    lift = (f1 + f2 + f3 + f4) / MASS / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    push = (
        lift * 2 * (q1 * q3 + q0 * q2),
        lift * 2 * (q2 * q3 - q0 * q1),
        lift * (q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3) - GRAVITY,
    )
    turn = (
        -0.5 * (q1 * w1 + q2 * w2 + q3 * w3),
        0.5 * (q0 * w1 + q2 * w3 - q3 * w2),
        0.5 * (q0 * w2 - q1 * w3 + q3 * w1),
        0.5 * (q0 * w3 + q1 * w2 - q2 * w1),
    )
    J1, J2, J3 = INERTIA
    spin = (
        (ARM * (f1 - f2 - f3 + f4) - (J3 - J2) * w2 * w3) / J1,
        (ARM * (-f1 - f2 + f3 + f4) - (J1 - J3) * w3 * w1) / J2,
        (TURN * (f1 - f2 + f3 - f4) - (J2 - J1) * w1 * w2) / J3,
    )
    return torch.cat((v, torch.stack((*push, *turn, *spin), dim=-1)), dim=-1)


def race(
    stages: int, gates: Tensor | None = None, within: float = WITHIN, rest: Tensor | None = None
) -> tuple[Problem, Tensor, Tensor]:
    """The race with so many stages a leg, and states and controls on straight lines at `PACE`.

    Args:
        gates: (B, G, 3), m; None: those of the track.
        within: m, of each gate's centre.
        rest: (B, 6), position and velocity at the end; None: at rest at that of the track.
    """
    places = torch.tensor([GATES], dtype=D) if gates is None else gates
    (B, legs), ends = (len(places), places.shape[1] + 1), [torch.tensor(p, dtype=D) for p in (START, END)]
    way = torch.cat((ends[0].expand(B, 1, 3), places, ends[1].expand(B, 1, 3)), dim=1)
    N, firsts = legs * stages, [leg * stages for leg in range(1, legs)]
    at_knots = torch.zeros(B, N + 1, 3, dtype=D)
    at_knots[:, firsts] = places
    rest = torch.cat((ends[1], torch.zeros(3, dtype=D))).expand(B, -1) if rest is None else rest
    lengths = way.diff(dim=1).norm(dim=-1)
    dt = MEAN / PACE / stages  # of all tracks: with another one code would be compiled again
    rows = [
        ControlBounds(0.0, STRONGEST),
        StateBounds([-math.inf] * 10 + [-w for w in FASTEST], [math.inf] * 10 + list(FASTEST)),
        FunctionConstraint(
            lambda x, place: (x[..., :3] - place).square().sum(-1, keepdim=True) - within**2,
            knots=firsts, name="gates", knot_values={"place": at_knots},
        ),
        FunctionConstraint(
            lambda x, rest: x[..., :6] - rest, "equality", knots=[-1], name="at rest", values={"rest": rest}
        ),
    ]  # fmt: skip
    x0 = torch.zeros(B, 13, dtype=D)
    x0[:, :3], x0[:, 6] = ends[0], 1.0
    guess = lengths / PACE / stages / dt
    time = FreeTime(0.02, 20.0, guess=guess.clamp(0.02, 20.0), segments=firsts)
    model = FunctionDynamics(rates, 13, 4, dt, "rk4", slice(0, 3))
    problem = Problem(model, FunctionCost(lambda x, u: 0.0 * u[..., 0]), rows, x0, N, time=time)
    share = torch.arange(stages, dtype=D).view(1, 1, -1, 1) / stages
    p = (way[:, :-1].unsqueeze(2) + share * way.diff(dim=1).unsqueeze(2)).flatten(1, 2)
    X0 = torch.zeros(B, N + 1, 13, dtype=D)
    X0[..., :3], X0[..., 6] = torch.cat((p, way[:, -1:]), dim=1), 1.0
    v = PACE * way.diff(dim=1) / lengths.unsqueeze(-1)
    X0[:, 1:-1, 3:6] = v.repeat_interleave(stages, dim=1)[:, 1:]
    return problem, X0, torch.full((B, N, 4), MASS * GRAVITY / 4.0, dtype=D)


def finer(problem: Problem, coarse: Solution, factor: int) -> tuple[Problem, Tensor, Tensor]:
    """A problem with `factor` times the stages of a solution, and that solution as its guess of times, X0 and U0."""
    share = torch.arange(factor, dtype=D).view(1, 1, -1, 1) / factor
    X, U, t = coarse.X, coarse.U.repeat_interleave(factor, dim=1), coarse.t.unsqueeze(-1)
    within = lambda z: torch.cat(
        ((z[:, :-1, None] + share * z.diff(dim=1).unsqueeze(2)).flatten(1, 2), z[:, -1:]), dim=1
    )
    return guessing_times(problem, within(t).squeeze(-1)), within(X), U


def aimed(solution: Solution, stages: int, gates: Tensor, within: float) -> tuple[Problem, Tensor, Tensor]:
    """The race again, with gates and end moved by what the plan's flight misses them, from the plan itself.

    The steps of the plan are longer than those of its flight, and open loop their errors add up over the race: at
    13 ms to some centimetres. What a flight misses changes little from this plan to the next, so the next one's flight
    is where it should be.
    """
    off = drift(solution)[..., :6]
    moved = gates - off[:, stages::stages, :3][:, : gates.shape[1]]
    rest = torch.tensor((*END, 0.0, 0.0, 0.0), dtype=D) - off[:, -1]
    problem, _, _ = race(stages, moved, within, rest)
    return guessing_times(problem, solution.t), solution.X, solution.U


def drift(solution: Solution, dt: float = 1e-3) -> Tensor:
    """How far flights are from their plans at the knots, (B, N+1, 13), to first order.

    Each stage's own error is that of its step beside finer ones of about `dt`; by the model's derivatives along the
    plan it is carried on to all later knots.
    """
    X, U, h = solution.X[:, :-1], solution.U, solution.t.diff(dim=1).unsqueeze(-1)
    count = max(1, math.ceil(float(h.max()) / dt))
    fine = X
    for _ in range(count):
        fine = stepped(fine, U, h / count)
    own = fine - torch.cat((solution.X[:, 1:, :6], _unit(solution.X[:, 1:, 6:10]), solution.X[:, 1:, 10:]), dim=-1)
    by_x = torch.func.vmap(torch.func.vmap(torch.func.jacfwd(stepped)))(X, U, h)
    off = [torch.zeros_like(X[:, 0])]
    for k in range(X.shape[1]):
        off.append((by_x[:, k] @ off[-1].unsqueeze(-1)).squeeze(-1) + own[:, k])
    return torch.stack(off, dim=1)


def _unit(q: Tensor) -> Tensor:
    return q / q.norm(dim=-1, keepdim=True)


def stepped(x: Tensor, u: Tensor, h: Tensor) -> Tensor:
    """x (..., 13) after a step of RK4 of h (..., 1), s, with q renormalised."""
    k1 = rates(x, u)
    k2 = rates(x + 0.5 * h * k1, u)
    k3 = rates(x + 0.5 * h * k2, u)
    x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(x + h * k3, u))
    return torch.cat((x[..., :6], _unit(x[..., 6:10]), x[..., 10:]), dim=-1)


def flown(solution: Solution, gates: Tensor, dt: float = 1e-3) -> dict[str, Tensor]:
    """The plans flown open loop by RK4 at about `dt`, q renormalised at each step, as numbers (B,).

    `gate`: the largest of the smallest distances to the gates, each within 0.15 s of its knot, m; `end`: how far from
    the end the flight ends, m; `rate`: by how much a rate of turn passes its limit, as a share.
    """
    (B, N, _), legs = solution.U.shape, gates.shape[1] + 1
    stages, t = N // legs, solution.t
    x, nearest = solution.X[:, 0], torch.full((B, legs - 1), torch.inf, dtype=D)
    knots, rate = t[:, stages::stages][:, : legs - 1], torch.zeros(B, dtype=D)
    count = max(1, math.ceil(float(t.diff(dim=1).max()) / dt))
    for k in range(N):
        h, u = (t[:, k + 1] - t[:, k]).unsqueeze(-1) / count, solution.U[:, k]
        for j in range(count):
            x, now = stepped(x, u, h), t[:, k : k + 1] + (j + 1) * h
            away = (x[:, None, :3] - gates).norm(dim=-1)
            nearest = torch.where((now - knots).abs() < 0.15, torch.minimum(nearest, away), nearest)
            rate = torch.maximum(rate, (x[:, 10:].abs() / torch.tensor(FASTEST, dtype=D)).amax(-1) - 1.0)
    end = (x[:, :3] - torch.tensor(END, dtype=D)).norm(dim=-1)
    return {"gate": nearest.amax(-1), "end": end, "rate": rate}


def races(stages: Sequence[int], margin: float, tracks: int, seed: int) -> str:
    """The table of the race: the track, and tracks with gates moved by up to 0.3 m along each axis, as aimed."""
    draws, published = torch.Generator().manual_seed(seed), torch.tensor([GATES], dtype=D)
    moved = published + 0.6 * torch.rand(tracks, len(GATES), 3, generator=draws, dtype=D) - 0.3
    rows = _raced("as published", stages, margin, published)
    if tracks > 0:
        rows += _raced(f"{tracks} moved", stages, margin, moved)
    head = ["track", "N", "duration, s", "s, with those before", "gate at 1 ms, m", "end, m",
            "rates over, share"]  # fmt: skip
    return markdown(head, rows)


def _raced(name: str, stages: Sequence[int], margin: float, gates: Tensor) -> list[list[object]]:
    """A row for each number of stages a leg, and those for the last aimed at where its flight shall be.

    All but the first begin with the solution before. Batches: the worst.
    """
    rows, before, spent, passes = list[list[object]](), None, 0.0, False
    for size in (*stages, *[stages[-1]] * AIMS):
        if passes:
            break
        problem, X0, U0 = race(size, gates, 0.3)
        solver, label = RACE, f"{problem.N}"
        if before is not None and size > before[0]:
            problem, X0, U0 = finer(problem, before[1], size // before[0])
            solver = replace(RACE, initial_barrier=FINER)
        elif before is not None:
            began = time.process_time()
            problem, X0, U0 = aimed(before[1], size, gates, 0.3 - margin)
            spent += time.process_time() - began
            solver, label = replace(RACE, initial_barrier=AIMED), f"{problem.N}, aimed"
        solver.solve(problem, U0, X0=X0, max_seconds=1e-3)
        began = time.process_time()
        found = solver.solve(problem, U0, X0=X0)
        spent += time.process_time() - began
        there = flown(found, gates)
        rows.append([
            name, label, f"{float(found.duration.max()):.4f}",
            f"{spent / problem.B:.2f}",
            *(f"{float(there[key].max()):.4f}" for key in ("gate", "end", "rate")),
        ])  # fmt: skip
        before, passes = (size, found), "aimed" in label and float(there["gate"].max()) <= 0.3
    return rows
