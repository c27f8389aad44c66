"""Functions whose rows depend on other knots, on their number, or on other problems are refused by `Problem`."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Constraint,
    Cost,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Problem,
    QuadraticCost,
)
from torchgco.native.codegen.constraint import trace_rows

D = torch.float64
N = 10
REFERENCE = torch.linspace(3.0, 0.5, N + 1, dtype=D)[:, None]
WEIGHTS = torch.tensor([[0.3, -1.7], [1.1, 0.4]], dtype=D)


def problem(cost: Any = None, constraints: Any = (), field: Callable[..., Tensor] | None = None, N: int = N) -> Problem:
    model = FunctionDynamics(field or (lambda x, u: x + 0.1 * u), 2, 2, 0.1, "none")
    x0 = torch.tensor([[0.0, 0.0], [0.3, 0.3], [1.0, 1.0]], dtype=D)
    return Problem(model, cost or QuadraticCost([1.0] * 2, [0.1] * 2, [5.0] * 2), list(constraints), x0, N)


def total(u: Tensor) -> Tensor:
    return u.square().sum((-2, -1), keepdim=True).expand(*u.shape[:-1], 1) - 20.0


def far(u: Tensor) -> Tensor:
    return (u - u.roll(1, -2)).abs().sum(-1, keepdim=True)


GOALS = {"values": {"goal": torch.ones(3, 2, dtype=D)}}


def late(x: Tensor) -> Tensor:
    """Knot 6 alone, at knot 7 alone."""
    if x.shape[-2] < N:
        return torch.zeros_like(x[..., :1])
    return torch.nn.functional.pad(x[..., 5:6, :1], (0, 0, 6, x.shape[-2] - 7))


def apart(x: Tensor) -> Tensor:
    """A push away from problems closer than 0.1."""
    away = x[:, None] - x[None]
    return torch.where(away.abs() < 0.1, away, 0.0).sum(1)


JOINED: dict[str, tuple[str, Callable[..., Tensor]]] = {
    "cumulated": ("u", lambda u: u.square().sum(-1, keepdim=True).cumsum(-2) - 1.0),
    "total": ("u", total),
    "changes": ("u", lambda u: (u - u.roll(1, -2)).abs() - 0.2),
    "first knot": ("x", lambda x: x[..., :1] - x[:, :1, :1] - 0.3),
    "reference cut": ("x", lambda x: x[..., :1] - REFERENCE[: x.shape[-2]]),
    "reference of all knots": ("x", lambda x: x[..., :1] - REFERENCE[1:]),
    "linspace": ("x", lambda x: x[..., :1] - torch.linspace(3.0, 0.5, x.shape[-2], dtype=D)[:, None]),
    "number of knots": ("x", lambda x: x[..., :1] / x.shape[-2] - 0.3),
    "of both": ("xu", lambda x, u: x[..., :1] * u[..., :1] - x.mean(-2, keepdim=True)[..., :1]),
    "with k": ("x", lambda x, k: x[..., :1] - 0.1 * k[:, None] - x.cumsum(-2)[..., 1:]),
    # Nothing of these is seen at points like the start.
    "far changes": ("u", lambda u: u.sum(-1, keepdim=True) - 9.0 + (far(u) - 5.0).relu()),
    "far mean": ("x", lambda x: torch.where(x.mean(-2, keepdim=True)[..., :1] > 5.0, x[..., :1], x[..., :1] - 2.0)),
    "far and negative": ("x", lambda x: x[..., :1] - (-x.cumsum(-2)[..., :1] - 99.0).clamp(min=0.0)),
    "far number of knots": ("x", lambda x: (x[..., :1] / x.shape[-2] - 0.3).relu() - 0.5),
    "one knot at another": ("x", lambda x: x[..., :1] - 1.0 + (late(x) - 4.0).relu()),
    "near problems": ("x", lambda x: x[..., :1] - 9.0 + apart(x)[..., :1]),
    "problems": ("x", lambda x: x[..., :1] - (x.mean(0, keepdim=True)[..., :1] - 5.0).relu()),
}  # fmt: skip
APART: dict[str, tuple[str, Callable[..., Tensor], dict[str, Any]]] = {
    "k": ("x", lambda x, k: x[..., :1] - REFERENCE[k], {}),
    "knot_values": ("x", lambda x, most: x[..., :1] - most, {"knot_values": {"most": REFERENCE.unsqueeze(0)}}),
    "values": ("x", lambda x, goal: (x - goal).norm(dim=-1, keepdim=True) - 9.0, GOALS),
    "network": ("x", lambda x: (x @ WEIGHTS).tanh() - 0.9, {}),
    "domain": ("x", lambda x: (2.0 + x[..., :1]).log() - 3.0, {}),
    "both": ("xu", lambda x, u: torch.stack((x[..., 0] * u[..., 1], u.prod(-1)), -1) - 2.0, {}),
    "branch on values": ("x", lambda x: x[..., :1] - 1.0 if bool(x.sum() > -3.0) else x[..., :1] - 2.0, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", JOINED)
def test_rows_that_join_knots_are_refused(name: str) -> None:
    of, function = JOINED[name]
    with pytest.raises(InputError, match=r"rows of one knot .*RateBounds.*knot_values") as caught:
        problem(constraints=[FunctionConstraint(function, of=of)])
    assert caught.value.field == "constraint.function" and "\n" not in str(caught.value)


@dataclass(frozen=True)
class Rows(Constraint):
    """The rows of a function of whole trajectories X, U at some knots."""

    function: Callable[..., Tensor]
    knots: Any = None  # all of them

    def bind(self, dims: Any) -> "Rows":
        return self if self.knots is not None else replace(self, knots=slice(0, dims.N + 1))

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.function(X, U)


STAGES, LATER = slice(0, N), slice(1, N + 1)
# Those of single functions that join knots, whatever their number, and what only whole trajectories show.
OF_CLASSES: dict[str, Rows] = {
    **{name: Rows(lambda X, U, f=f: f(X)) for name, (of, f) in JOINED.items() if of == "x" and name in (
        "first knot", "far mean", "far and negative", "one knot at another")},
    **{name: Rows(lambda X, U, f=f: f(U), STAGES) for name, (of, f) in JOINED.items() if of == "u"},
    "previous state": Rows(lambda X, U: X[:, 1:, 1:] - X[:, :-1, 1:] - 0.1, LATER),
    "next state": Rows(lambda X, U: X[:, 1:, 1:] - 0.8, STAGES),
    "previous control": Rows(lambda X, U: U - 0.1, LATER),
    "start": Rows(lambda X, U: X[:, -1:] - X[:, :1] - 0.2, slice(N, N + 1)),
    "turned": Rows(lambda X, U: X.flip(1) - 2.0),
    "some knots": Rows(lambda X, U: X[:, [4, 7]] - 2.0, torch.tensor([3, 7])),
    "a step": Rows(lambda X, U: X - 2.0 + 0.5 * (X.amax(1, keepdim=True) > 4.0)),
}  # fmt: skip
APART_CLASSES: dict[str, Rows] = {
    "states": Rows(lambda X, U: X - 2.0),
    "both": Rows(lambda X, U: X[:, :-1] * U - 2.0, STAGES),
    "the last": Rows(lambda X, U: X[:, -1:].norm(dim=-1, keepdim=True) - 3.0, slice(N, N + 1)),
    "some knots": Rows(lambda X, U: X[:, [7, 3]] - 2.0, torch.tensor([7, 3])),
    "times": Rows(lambda X, U: X - torch.arange(N + 1, dtype=X.dtype)[:, None] / X.shape[1]),
    "branch": Rows(lambda X, U: X - 2.0 if bool(X.sum() > -1e4) else X - 2.5),
}


@pytest.mark.parametrize("name", OF_CLASSES)
def test_rows_of_classes_that_join_knots_are_refused(name: str) -> None:
    """They were only warned of, and some were solved: by derivatives that leave other knots out."""
    with pytest.raises(InputError, match=r"rows of one knot .*RateBounds.*depend on other knots") as caught:
        problem(constraints=[OF_CLASSES[name]])
    assert caught.value.field == "constraints[0].value" and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", APART_CLASSES)
def test_rows_of_classes_that_keep_knots_apart_are_accepted(name: str) -> None:
    problem(constraints=[APART_CLASSES[name]])


@dataclass(frozen=True)
class Summed(Cost):
    """A cost with its own sum, that of its stages and more."""

    more: Callable[[Tensor, Tensor], Tensor]

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.square().sum(-1) + (x - 1.0).square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return x.square().sum(-1)

    def total(self, X: Tensor, U: Tensor) -> Tensor:
        return self.stage(X[:, :-1], U, 0).sum(-1) + self.terminal(X[:, -1]) + self.more(X, U)


OTHER_SUMS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "changes": lambda X, U: U.diff(dim=1).square().sum((-2, -1)),
    "twice": lambda X, U: X[:, -1].square().sum(-1),
    "largest": lambda X, U: X.abs().amax((-2, -1)),
    "far": lambda X, U: (X[:, 5, 0] - 30.0).relu(),
    "negative and far": lambda X, U: (-X.sum((-2, -1)) - 900.0).relu(),
    "one number": lambda X, U: X.sum(),
}


@pytest.mark.parametrize("name", OTHER_SUMS)
def test_an_own_sum_of_a_cost_that_is_not_that_of_its_stages_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="the sum of its stages and its terminal cost") as caught:
        problem(cost=Summed(OTHER_SUMS[name]))
    assert caught.value.field == "cost.total" and "\n" not in str(caught.value)


def test_an_own_sum_of_the_stages_is_traced_as_any_other_cost() -> None:
    """In free time, in phases and with horizons it was refused, and solved by PyTorch elsewhere."""
    one, plain = (problem(cost=cost) for cost in (Summed(lambda X, U: 0.0), FunctionCost(
        lambda x, u: u.square().sum(-1) + (x - 1.0).square().sum(-1), lambda x: x.square().sum(-1))))  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, due = (torchgco.solve(made, solver="interior_point", verbose=False) for made in (one, plain))
    torch.testing.assert_close(found.U, due.U)
    torch.testing.assert_close(found.cost, one.cost.total(found.X, found.U))


@pytest.mark.parametrize("name", APART)
def test_rows_of_one_knot_are_accepted(name: str) -> None:
    of, function, more = APART[name]
    problem(constraints=[FunctionConstraint(function, of=of, **more)])


def field(more: Callable[[Tensor], Any]) -> Callable[[], Problem]:
    return lambda: problem(field=lambda x, u: x + 0.1 * u + more(x))


def costs(stage: Callable[[Tensor], Any], end: Callable[[Tensor], Any]) -> Callable[[], Problem]:
    return lambda: problem(
        FunctionCost(lambda x, u: u.square().sum(-1) + stage(x), lambda x: x.square().sum(-1) + end(x))
    )


def late_stage(x: Tensor, u: Tensor, k: Any) -> Tensor:
    """A step that is another one for stages at once than for each, but not for the first ones."""
    return x + 0.1 * u + (0.1 * (k > 5) if isinstance(k, int) else 0.2 * (k > 5).unsqueeze(-1))


def of_stages(step: Callable[..., Tensor]) -> Problem:
    return Problem(
        FunctionDynamics(step, 2, 2, 0.1, "none"),
        QuadraticCost([1.0] * 2, [0.1] * 2, [5.0] * 2),
        [],
        torch.zeros(2, 2, dtype=D),
        N,
    )


MIXED: dict[str, tuple[str, Callable[[], Problem]]] = {
    "model": ("dynamics.step", field(lambda x: (x.mean(0, keepdim=True) - 5.0).relu())),
    "states at once": ("dynamics.step", field(lambda x: x if x.dim() == 2 else 2.0 * x)),
    "stages": ("dynamics.step", field(lambda x: (x.sum(1, keepdim=True) - 9.0).relu() if x.dim() == 3 else 0.0)),
    "number of problems": ("dynamics.step", field(lambda x: x * (x.shape[0] == 3))),
    "number of rows": (
        "constraint.function",
        lambda: problem(constraints=[FunctionConstraint(lambda x: x * (x.shape[0] == 3) - 1.0)]),
    ),
    "number of costs": ("cost.stage", costs(lambda x: x.sum(-1) * (x.shape[0] == 3), lambda x: 0.0)),
    "number of terminal costs": ("cost.terminal", costs(lambda x: 0.0, lambda x: x.sum(-1) * (x.shape[0] == 3))),
    "near states": ("dynamics.step", field(apart)),
    "late stages": ("dynamics.step", lambda: of_stages(late_stage)),
    "many stages": ("dynamics.step", field(lambda x: x if x.shape[1:-1] == (N,) else 2.0 * x)),
    "near costs": ("cost.stage", costs(lambda x: apart(x).sum(-1), lambda x: 0.0)),
    "near terminal costs": ("cost.terminal", costs(lambda x: 0.0, lambda x: apart(x).sum(-1))),
    "cost": ("cost.stage", costs(lambda x: (x.sum(-1).cumsum(0) - 50.0).relu(), lambda x: 0.0)),
    "terminal cost": ("cost.terminal", costs(lambda x: 0.0, lambda x: (x.mean() - 7.0).relu())),
}


@pytest.mark.parametrize("name", MIXED)
def test_functions_that_mix_problems_are_refused(name: str) -> None:
    field, make = MIXED[name]
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.field == field


def bounded(z: Tensor) -> Tensor:
    return z.clamp_(-9.0, 9.0)


WRITING: dict[str, Callable[[], Problem]] = {
    "dynamics.step": lambda: of_stages(lambda x, u: x + 0.1 * bounded(u)),
    "cost.stage": costs(lambda x: bounded(x).sum(-1), lambda x: 0.0),
    "cost.terminal": costs(lambda x: 0.0, lambda x: bounded(x).sum(-1)),
    "constraint.function": lambda: problem(constraints=[FunctionConstraint(lambda x: bounded(x) - 0.5)]),
}


@pytest.mark.parametrize("field", WRITING)
def test_functions_that_write_into_their_arguments_are_refused(field: str) -> None:
    with pytest.raises(InputError, match=r"leaves its arguments as they are.*writes into them") as caught:
        WRITING[field]()
    assert caught.value.field == field


def test_the_code_of_a_constraint_is_that_of_all_its_knots_and_of_every_horizon() -> None:
    rows = FunctionConstraint(lambda x: x[..., :1] ** 2 - x.sum(-1, keepdim=True) * 0.5 - 1.0)
    short, long = (trace_rows(problem(constraints=[rows], N=count), 0) for count in (3, 7))
    assert short.code == long.code and short.places.shape == long.places.shape == (1, 0)


def test_what_no_point_shows_is_seen_in_the_trace() -> None:
    window = FunctionConstraint(lambda x: x[..., :1] - ((x.roll(1, -2)[..., :1] - 3.0).abs() < 0.1) * 1.0 - 9.0)
    hidden = problem(constraints=[window])
    with pytest.raises(InputError, match="own knot alone"):
        trace_rows(hidden, 0)


def flat(x: Tensor) -> Tensor:
    """Another number for states (B, n) than for states (B, K, n)."""
    return x[..., 0].square() * (3.0 if x.dim() == 2 else 1.0)


def waypoint(x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
    """A tensor k isn't found in a dict, and a number is."""
    return {4: 40.0}.get(k, 0.0) * (x[..., 0] - 0.9).square() + u.square().sum(-1)  # type: ignore[call-overload]


BY_AXES: dict[str, Callable[[], Problem]] = {
    "cost.stage ": lambda: problem(FunctionCost(waypoint, lambda x: x[..., 0])),
    "constraint.function ": lambda: problem(
        constraints=[FunctionConstraint(lambda x, k: x[..., :1] - {7: 0.1}.get(k, 0.9))]
    ),
    "cost.stage": lambda: problem(FunctionCost(lambda x, u: flat(x) + u.square().sum(-1), lambda x: x[..., 0])),
    "cost.terminal": lambda: problem(FunctionCost(lambda x, u: u.square().sum(-1), flat)),
    "constraint.function": lambda: problem(constraints=[FunctionConstraint(lambda x: flat(x).unsqueeze(-1) - 2.0)]),
}


@pytest.mark.parametrize("field", BY_AXES)
def test_numbers_that_depend_on_the_axes_before_a_state_are_refused(field: str) -> None:
    with pytest.raises(InputError, match="whatever axes lie before the last") as told:
        BY_AXES[field]()
    assert told.value.field == field.strip()


def beside(x: Tensor, u: Tensor) -> Tensor:
    return u.square().sum(-1)


# Code that knows how many axes it is given, and reads other stages where these are there.
OF_STAGES: dict[str, Callable[[Tensor], Tensor]] = {
    "mean": lambda x: (x[..., 0] - x[..., 0].mean(-1, keepdim=True)).square(),
    "neighbour": lambda x: (x[..., 0] - x[..., 0].roll(1, -1)).abs(),
    "changes": lambda x: torch.nn.functional.pad(x[..., 0].diff(dim=-1), (0, 1)).square(),
    "first": lambda x: (x[..., 0] - x[:, :1, 0]).square(),
    "cumulated": lambda x: x[..., 0].cumsum(-1) - x[..., 0],
    "how many": lambda x: x[..., 0] * (x.shape[-2] - 1),
    "hidden": lambda x: torch.relu(x[..., 0].amax(-1, keepdim=True) - x[..., 0] - 50.0),
}


@pytest.mark.parametrize("takes_k", [False, True])
@pytest.mark.parametrize("kind", OF_STAGES)
def test_costs_of_stages_that_depend_on_other_stages_are_refused(kind: str, takes_k: bool) -> None:
    of_others = lambda x, u: beside(x, u) + (OF_STAGES[kind](x) if x.dim() == 3 else 0.0 * x[..., 0])
    with_k = lambda x, u, k: of_others(x, u) + 0.01 * k
    with pytest.raises(InputError, match=r"cost\.stage: expected numbers of a stage that depend on its own state"):
        problem(FunctionCost(with_k if takes_k else of_others, lambda x: x[..., 0]))


@pytest.mark.parametrize("part", ["model", "rows"])
def test_numbers_that_depend_on_how_many_problems_there_are_are_refused(part: str) -> None:
    """Of two problems, where the numbers differ from three on."""
    many = lambda x: x[..., 0] if x.shape[0] > 2 else 0.0 * x[..., 0]
    with pytest.raises(InputError):
        if part == "model":
            field = lambda x, u: x + 0.1 * u + many(x).unsqueeze(-1)
            Problem(
                FunctionDynamics(field, 2, 2, 0.1, "none"), QuadraticCost([1] * 2, [1] * 2, [1] * 2), [], WEIGHTS, N
            )
        else:
            rows = [FunctionConstraint(lambda x: many(x).unsqueeze(-1) - 1.0)]
            model = FunctionDynamics(lambda x, u: x + 0.1 * u, 2, 2, 0.1, "none")
            Problem(model, QuadraticCost([1.0] * 2, [0.1] * 2, [5.0] * 2), rows, WEIGHTS, N)


def test_a_long_horizon_takes_no_more_calls_of_a_cost_than_a_short_one() -> None:
    """Numbers of each knot come by `knot_values`: only code that takes k is asked at every knot."""
    calls: list[int] = []

    def stage(x: Tensor, u: Tensor, price: Tensor) -> Tensor:
        calls[-1] += 1
        return price * u.square().sum(-1)

    for count in (40, 400):
        calls.append(0)
        problem(FunctionCost(stage, knot_values={"price": torch.ones(1, count + 1, dtype=D)}), N=count)
    assert calls[0] == calls[1]
