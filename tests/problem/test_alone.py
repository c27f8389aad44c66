"""Functions that look at values, as a guard does, either keep knots and problems apart or are refused."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    BetweenKnots,
    Constraint,
    ControlBounds,
    Cost,
    Dynamics,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Integral,
    Problem,
    RateBounds,
    Solution,
    StateBounds,
)
from torchgco.dynamics.base import INTEGRATORS

N, DT = 3, 0.25
Function = Callable[..., Tensor]
pytestmark = pytest.mark.filterwarnings("ignore::torchgco.kernels.EagerWarning")


def field(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0]), -1)


def stage(x: Tensor, u: Tensor) -> Tensor:
    return 0.1 * x.square().sum(-1) + 0.1 * u.square().sum(-1)


def end(x: Tensor) -> Tensor:
    return 5.0 * (x[..., 0] - 1.5).square() + x[..., 1].square()


def rows(x: Tensor) -> Tensor:
    return x[..., 1:] - 2.0


# What Python reads of values: without an effect on what is computed ...
GUARDS: dict[str, Callable[[Tensor], object]] = {
    "assert finite": lambda x: check(bool(torch.isfinite(x).all())),
    "raise at NaN": lambda x: check(not bool(torch.isnan(x).any())),
    "small": lambda x: check(float(x.detach().abs().max()) < 1e4),
    "equal": lambda x: check(torch.equal(x, x)),
    "item": lambda x: check((x.square().sum() >= 0.0).item()),
}
# ... and the size (...) of what is added to numbers that are right, and of what mixes them.
APART: dict[str, Callable[[Tensor], Tensor]] = {
    "none": lambda x: 0.0 * x[..., 0],
    "relu": lambda x: (x[..., 0] - 0.5).relu(),
    "where some": lambda x: (x[..., 0] - 0.3).relu() if bool((x > 0.3).any()) else 0.0 * x[..., 0],
    "largest state": lambda x: (x.amax(-1) - 0.2).relu(),
}  # fmt: skip
MIXED: dict[str, Callable[[Tensor], Tensor]] = {
    "forgotten dim": lambda x: (x[..., 0].amax() - 0.4).relu(),
    "mean": lambda x: (x.mean() - x[..., 0]).abs(),
    "far": lambda x: (x.abs().sum() - 30.0).relu(),
    "first problem": lambda x: x[0, ..., 0].sum() + 0.0 * x[..., 0],
}
BRANCHES: dict[str, Callable[[Tensor], float]] = {
    "mean": lambda x: 3.0 if float(x[..., 0].mean()) < 0.3 else 0.5,
    "largest": lambda x: 2.0 if bool(x[..., 0].max() > 0.8) else 0.0,
    "any": lambda x: 1.0 if bool((x[..., 1] > 0.5).any()) else 0.2,
    "never": lambda x: 9.0 if float(x.abs().max()) > 1e9 else 0.7,
}


def check(holds: bool) -> None:
    if not holds:
        raise ValueError("bad state")


@dataclass
class Drawn:
    part: str
    kind: str
    name: str
    more: Callable[[Tensor], Tensor]

    @classmethod
    def of(cls, seed: int) -> Drawn:
        draw = random.Random(seed)
        part, kind = draw.choice(["stage", "end", "model", "rows"]), draw.choice(["apart", "mixed", "branch"])
        size = draw.uniform(0.3, 1.0)
        if kind == "branch":
            name, side = draw.choice(list(BRANCHES.items()))
            return cls(part, kind, name, lambda x: size * side(x) * x[..., 0].square())
        guard = draw.choice(list(GUARDS.values()))
        name, value = draw.choice(list((APART if kind == "apart" else MIXED).items()))
        return cls(part, kind, name, lambda x: (guard(x), size * value(x))[1])

    def functions(self) -> dict[str, Function]:
        more = self.more
        own: dict[str, Function] = {
            "stage": lambda x, u: stage(x, u) + more(x),
            "end": lambda x: end(x) + more(x),
            "model": lambda x, u: field(x, u) - 0.3 * more(x).unsqueeze(-1),
            "rows": lambda x: rows(x) + more(x).unsqueeze(-1),
        }
        return {"stage": stage, "end": end, "model": field, "rows": rows} | {self.part: own[self.part]}


def problem(f: dict[str, Function], starts: Any = ((0.0, 0.0), (-0.4, 0.6)), **more: Any) -> Problem:
    model = FunctionDynamics(f["model"], n=2, m=1, dt=DT)
    cost = FunctionCost(f["stage"], f["end"])
    x0 = torch.tensor(starts).double()
    return Problem(model, cost, [ControlBounds(-20.0, 20.0), FunctionConstraint(f["rows"])], x0, N, **more)


def of_own_code(f: dict[str, Function], x0: Tensor, U: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States (B, N+1, n), costs (B,) and violations (B,) of controls by functions of single rows (1, n)."""
    X, costs, worst = [], [], []
    for b in range(len(U)):
        x, total = [x0[b : b + 1]], torch.zeros(1).double()
        for k in range(N):
            total = total + f["stage"](x[k], U[b : b + 1, k])
            x.append(x[k] + DT * f["model"](x[k], U[b : b + 1, k]))
        X.append(torch.cat(x))
        costs.append(total + f["end"](x[-1]))
        worst.append(max(float(f["rows"](x[k]).max().clamp(min=0.0)) for k in range(1, N + 1)))
    return torch.stack(X), torch.cat(costs), torch.tensor(worst).double()


def solved(p: Problem, solver: str = "al_ilqr") -> Solution:
    return torchgco.solve(p, solver=solver, verbose=False)


def numbers_are_own(seed: int) -> str:
    drawn = Drawn.of(seed)
    f = drawn.functions()
    try:
        p = problem(f)
        found = solved(p, ("al_ilqr", "interior_point")[seed % 2])
    except InputError as error:
        fields = {"stage": "cost.stage", "end": "cost.terminal", "model": "dynamics.", "rows": "constraint.function"}
        assert error.field.startswith(fields[drawn.part]) and "\n" not in str(error)
        assert drawn.kind != "apart" and (drawn.kind, drawn.name) != ("branch", "never"), error
        return f"{drawn.kind} refused"
    assert drawn.kind != "mixed", drawn
    X, cost, violation = of_own_code(f, p.x0, found.U)
    assert torch.isfinite(cost).all()
    near = {"rtol": 1e-6, "atol": 1e-6}
    torch.testing.assert_close(found.X, X, **near)
    torch.testing.assert_close(found.cost, cost, **near)
    torch.testing.assert_close(found.violation, violation, **near)
    verdict = torchgco.judge(p, found.U)
    torch.testing.assert_close(verdict.cost, cost, **near)
    torch.testing.assert_close(verdict.violation, violation, **near)
    return f"{drawn.kind} solved"


@pytest.mark.sampled(3)
@pytest.mark.parametrize("seed", range(8))
def test_what_is_returned_is_what_each_row_gives(seed: int) -> None:
    numbers_are_own(seed)


@dataclass(frozen=True)
class Cart(Dynamics):
    n, m, dt, more = 2, 1, DT, None

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return field(x, u) - 0.3 * (1.0 if bool((x[..., 0] > 0.2).any()) else 0.0)


class Jump(Cart):
    def at(self, k: Any) -> Jump:
        later = Jump()
        object.__setattr__(later, "more", k)
        return later

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        more = torch.as_tensor(self.more).to(x).unsqueeze(-1)
        return x + DT * (field(x, u) - 0.01 * more * (1.0 if bool((x[..., 0] > 0.2).any()) else 0.0))


class Price(Cost):
    def stage(self, x: Tensor, u: Tensor, k: Any) -> Tensor:
        return stage(x, u) * (2.0 if float(x[..., 0].min()) < 0.2 else 1.0)

    def terminal(self, x: Tensor) -> Tensor:
        return end(x)


@pytest.mark.parametrize("part", [Cart(), Jump(), Price()], ids=lambda part: type(part).__name__)
def test_classes_are_evaluated_row_by_row(part: Any) -> None:
    """And what they give so is what they give for single rows, in the batch and alone."""
    model, cost = (part, Price()) if isinstance(part, Dynamics) else (Cart(), part)
    p = Problem(model, cost, [], [[0.0, 0.0], [0.6, 0.3], [torch.nan, 0.0]], N)
    draws = torch.Generator().manual_seed(0)
    U = torch.rand(3, N, 1, dtype=torch.float64, generator=draws)
    together, found = torchgco.judge(p, U), []
    for b in range(3):
        x, total = p.x0[b : b + 1], torch.zeros(1).double()
        for k in range(N):
            total = total + cost.stage(x, U[b : b + 1, k], k)
            x = model.at(k).step(x, U[b : b + 1, k])
        found.append(total + cost.terminal(x))
    torch.testing.assert_close(together.cost, torch.cat(found), equal_nan=True)
    assert together.cost.isnan().tolist() == [False, False, True]
    alone = [torchgco.judge(p.take([b]), U[b : b + 1]).cost for b in range(3)]
    torch.testing.assert_close(together.cost, torch.cat(alone), rtol=0.0, atol=0.0, equal_nan=True)
    X = torch.rand(3, N + 1, 2, dtype=torch.float64, generator=draws)
    both, one = torchgco.certify(p, X, U), torchgco.certify(p.take([1]), X[1:2], U[1:2])
    torch.testing.assert_close(both.dynamics_residual[1:2], one.dynamics_residual)


BRANCHED = {
    "stage": lambda x, u: stage(x, u) * (4.0 if float(x[..., 0].mean()) < 0.4 else 1.0),
    "rows": lambda x: x[..., 1:] - (3.0 if float(x[..., 0].max()) > 1.0 else 1.0),
}


FORMS = ["plain", "single", "horizon", "one start not finite", "bounded rates", "free time"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("form", "part"),
    mostly(
        [(form, part) for form in FORMS for part in BRANCHED if (form, part) != ("free time", "rows")],
        *((form, "stage") for form in FORMS[1:-1:2]),
        *((form, "rows") for form in FORMS[:-1:2]),
        several=True,
    ),
)
def test_a_branch_that_mixes_knots_is_raised(part: str, form: str) -> None:
    f: dict[str, Any] = {"stage": stage, "end": lambda x: 60.0 * end(x), "model": field, "rows": rows}
    f |= {part: BRANCHED[part]}
    more: dict[str, Any] = {"starts": [[0.0, 0.0]]}
    solver = "al_ilqr"
    if form == "horizon":
        more |= {"starts": [[0.0, 0.0], [0.0, 0.0]], "horizon": torch.tensor([N, N - 1])}
    elif form == "one start not finite":
        more |= {"starts": [[0.0, 0.0], [torch.nan, 0.0]]}
    elif form == "free time":
        more["time"], solver = FreeTime(0.5, 1.0, 1.0), "interior_point"
    p = problem(f, **more)
    if form == "single":
        p = p.cast(torch.float32)
    elif form == "bounded rates":
        parts = [ControlBounds(-20.0, 20.0), FunctionConstraint(f["rows"]), RateBounds(-30.0, 30.0)]
        p = Problem(p.dynamics, p.cost, parts, p.x0, N)
    with pytest.raises(InputError) as told:
        solved(p, solver)
    assert told.value.field == {"stage": "cost.stage", "rows": "constraint.function"}[part]
    assert "by itself" in str(told.value) and "(problem 0, row" in str(told.value)


@pytest.mark.slow
def test_what_is_returned_is_what_each_row_gives_of_many_functions() -> None:
    kinds = [numbers_are_own(seed) for seed in range(8, 208)]
    assert {"apart solved", "mixed refused", "branch solved", "branch refused"} == set(kinds)


class Slowing(Dynamics):
    n, m, dt, integrator = 2, 1, DT, "rk4"

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return field(x, u) * (0.5 if bool((x[..., 1] > 0.6).any()) else 1.0)


CARRIED: dict[str, Callable[[], Any]] = {
    "rows within stages": lambda: BetweenKnots(FunctionConstraint(BRANCHED["rows"])),
    "a model within stages": lambda: BetweenKnots(StateBounds([-9.0, -9.0], [9.0, 0.7])),
    "an integral": lambda: Integral(
        lambda x, u: u[..., 0].square() * (3.0 if bool((x[..., 1] > 0.6).any()) else 1.0), most=2.0
    ),
}


@pytest.mark.parametrize("kind", CARRIED)
def test_rows_within_stages_and_integrals_are_evaluated_row_by_row(kind: str) -> None:
    """The judge's violation is that of each instant alone."""
    model = Slowing() if "model" in kind else FunctionDynamics(field, 2, 1, DT, "rk4")
    p = Problem(model, FunctionCost(stage, end), [CARRIED[kind]()], [[0.6, 0.3]], N)
    U = 3.0 * torch.rand(1, N, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x, worst, total = p.x0, 0.0, 0.0
    for u in U[0].split(1):
        ahead = lambda share, x=x, u=u: INTEGRATORS["rk4"](lambda z: model.field(z, u), x, share * DT)
        total += float(_integrated(x, u))
        for share in (0.25, 0.5, 0.75):
            row = ahead(share)[:, 1] - 0.7 if "model" in kind else BRANCHED["rows"](ahead(share))
            worst = max(worst, float(row))
        x = ahead(1.0)
    alone = max(0.0, total - 2.0) if kind == "an integral" else worst
    assert alone > 0.05 and float(torchgco.judge(p, U).violation) == pytest.approx(alone, rel=1e-9)


def _integrated(x: Tensor, u: Tensor) -> Tensor:
    """The third kind's integral over a stage, by RK4 of state and integral together."""
    rate = lambda z: u[..., 0].square() * (3.0 if float(z[..., 1]) > 0.6 else 1.0)
    rates = lambda z: torch.cat((field(z[..., :2], u), rate(z).unsqueeze(-1)), -1)
    return INTEGRATORS["rk4"](rates, torch.cat((x, torch.zeros(1, 1)), -1).double(), DT)[..., 2]


def test_a_branch_within_stages_is_raised() -> None:
    kind = FunctionConstraint(lambda x: x[..., 1:] - (3.0 if float(x[..., 0].max()) > 0.5 else 1.0), name="speed")
    model = FunctionDynamics(field, 2, 1, DT, "rk4")
    p = Problem(model, FunctionCost(stage, lambda x: 60.0 * end(x)), [BetweenKnots(kind)], [[0.0, 0.0]], N)
    with pytest.raises(InputError, match=r"speed\.function: expected rows of one knot .* by itself"):
        solved(p, "interior_point")


@dataclass(frozen=True)
class Below(Constraint):
    """v <= 2, or <= 1 where x is over 1 at any knot that `value` sees."""

    knots: Any = None
    sense: Any = "inequality"

    def bind(self, dims: Any) -> Below:
        return Below(slice(1, dims.N + 1))

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return X[:, 1:, 1:] - (1.0 if bool((X[..., 0] > 0.5).any()) else 2.0)


def test_rows_of_a_class_are_evaluated_knot_by_knot() -> None:
    p = Problem(FunctionDynamics(field, 2, 1, DT), FunctionCost(stage, end), [Below()], [[0.0, 0.0]], N)
    U = torch.tensor([[[7.0], [-1.0], [-1.0]]]).double()
    x, worst = p.x0, 0.0
    for u in U[0].split(1):
        x = x + DT * field(x, u)
        worst = max(worst, float(x[0, 1]) - (1.0 if float(x[0, 0]) > 0.5 else 2.0))
    assert float(torchgco.judge(p, U).violation) == pytest.approx(worst, rel=1e-12)
    p = Problem(p.dynamics, FunctionCost(stage, lambda x: 60.0 * end(x)), [Below()], [[0.0, 0.0]], N)
    with pytest.raises(InputError, match=r"constraints\[0\]\.value: expected rows of one knot .* by itself"):
        solved(p)
