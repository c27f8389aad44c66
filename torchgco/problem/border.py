"""Checks of a user's code when a problem is made: shapes, rows of problems that stay apart, randomness, derivatives.

A mistake that broadcasting or autodiff would hide ends here, in one line, and not as a wrong trajectory.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchgco.base.autodiff import WithoutReading, gradients_at_once
from torchgco.base.draws import scattered
from torchgco.base.errors import InputError, theirs
from torchgco.base.mixing import why
from torchgco.base.shapes import MISTAKES, describe
from torchgco.base.tree import is_users
from torchgco.base.values import taken_by, whole_numbers_become
from torchgco.constraints.base import Constraint, FunctionConstraint
from torchgco.constraints.bounds import RateBounds
from torchgco.costs.base import Cost, FunctionCost
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.names import controls_of, states_of
from torchgco.problem.joined import DRAWN_SIZES, depends_on_axes, joined_knots, mixes_problems, unlike

OFFSET = 1e-3  # by which the rows of a check differ, as a share of 1 + |x|
DERIVATIVE_SHARE = 1e-2  # share of a derivative by which differences may disagree
NOISE = 8.0  # times the rounding error of a difference, or its change with the step
OWN_ROW = "values of a problem that depend on its own row alone; numbers per problem belong in `values` or `batched`"

STEP_OF_STAGE = "states (B, K, n) after each of which depends on its own state, control and stage, as for (B, n)"
ANY_AXES = (
    "the same numbers of a state and control whatever axes lie before the last, (B, n), (B, K, n) or (B, S, n), and "
    "whether k is a number or a tensor (K,)"
)
ONE_STAGE = "numbers of a stage that depend on its own state and control alone (changes along the way: an extra state)"
SUM_OF_STAGES = "the sum of its stages and its terminal cost (changes along the way: an extra state)"
ONE_KNOT = (
    "rows of one knot (sums along knots: Integral or an extra state; changes of controls: RateBounds; two knots: Link; "
    "numbers per knot: `knot_values`, or an argument k)"
)


def check_dynamics(dynamics: Dynamics, x0: Tensor, N: int) -> None:
    """Check a user's model for problems of N stages that start at x0 (B, n).

    Raises:
        InputError: names the method, what was expected, and what it returned.
    """
    for named in (states_of, controls_of):  # which refuse names and units that aren't one text for each
        named(dynamics)
    n, rows = dynamics.n, ends_of(x0)
    x, u = states_near(x0, 3), _controls(x0, 3, dynamics.m)
    k = torch.arange(3, device=x0.device).clamp(max=N - 1)
    several, single = dynamics.at(k), dynamics.at(0)
    for name in ("field", "step") if dynamics.is_integrated else ("step",):
        method = lambda model, name=name: lambda i, x, u: getattr(model.take(i), name)(x, u)
        what = "derivatives" if name == "field" else "states"
        wanted = f"{what} (..., {n}) in {x0.dtype}, the type of x0, shaped as its states (numbers per problem are "
        wanted += "`batched` or `per_element`)"
        _check_values(f"dynamics.{name}", method(single), rows, (x[:, 0], u[:, 0]), (2, n), wanted)
        _check_among_all(f"dynamics.{name}", method(single), rows, len(x0), (x[:, 0], u[:, 0]))
        of_stages = called(f"dynamics.{name}", wanted, method(several), rows, x, u)
        check_result(f"dynamics.{name}", of_stages, (2, 3, n), x.dtype, wanted)
    _check_stages(dynamics, rows, x0, N)
    weights = 1.0 + 0.5 * scattered(x)
    step = lambda x, u: (weights * several.take(rows).step(x, u)).flatten(1).sum(-1)

    def own(dx: Tensor, du: Tensor) -> Tensor:
        fx, fu = several.take(rows).jacobians(x, u)
        ahead = (fx @ dx.unsqueeze(-1) + fu @ du.unsqueeze(-1)).squeeze(-1)
        return (weights * ahead).flatten(1).sum(-1)

    _check_slope("dynamics.step", step, x, u, None if type(dynamics).jacobians is Dynamics.jacobians else own)


def _check_stages(dynamics: Dynamics, rows: Tensor, x0: Tensor, N: int) -> None:
    """Check that the states after all stages at once are those after each stage."""
    k, arguments = torch.arange(N, device=x0.device), (states_near(x0, N), _controls(x0, N, dynamics.m))

    def together(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        return dynamics.at(k).take(i).step(*z)

    def alone(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        if dynamics.at(k) is dynamics:  # the same at every stage: all states as problems of their own
            ahead = dynamics.take(i.repeat_interleave(len(k))).step(*(x.flatten(0, 1) for x in z))
            return ahead.unflatten(0, (-1, len(k)))
        f = dynamics.take(i)  # once: numbers of all stages, at each of them, would be as many as the horizon squared
        return torch.stack([f.at(int(j)).step(*(x[:, knot] for x in z)) for knot, j in enumerate(k)], dim=1)

    stage = called("dynamics.step", STEP_OF_STAGE, joined_knots, together, alone, rows, k, arguments)
    if stage is not None:
        got = f"others at stage {stage} where K = {N}, or where other states lie beside"
        raise InputError("dynamics.step", STEP_OF_STAGE, got)


def check_cost(cost: Cost, x0: Tensor, N: int, m: int) -> None:
    """Check a user's cost for problems of N stages and m controls that start at x0 (B, n).

    Raises:
        InputError: as `check_dynamics`.
    """
    rows, X, U, k = ends_of(x0), states_near(x0, N + 1), _controls(x0, N, m), torch.arange(N)
    wanted = f"a number in {x0.dtype}, the type of x0, per state and control (numbers per problem are `batched`)"
    stage: Callable[..., Any] = lambda i, x, u, k=k: cost.take(i).stage(x, u, k)
    _check_values("cost.stage", stage, rows, (X[:, :-1], U), (2, N), wanted)
    _check_values("cost.stage", lambda i, x, u: stage(i, x, u, 0), rows, (X[:, 0], U[:, 0]), (2,), wanted)
    _check_values("cost.terminal", lambda i, x: cost.take(i).terminal(x), rows, (X[:, -1],), (2,), wanted)

    _check_among_all("cost.stage", lambda i, x, u: stage(i, x, u, 0), rows, len(x0), (X[:, 0], U[:, 0]))
    _check_among_all("cost.terminal", lambda i, x: cost.take(i).terminal(x), rows, len(x0), (X[:, -1],))
    row_cost, takes_k = cost.take(rows), not isinstance(cost, FunctionCost) or taken_by(cost.stage_function).knot
    _check_axes("cost.stage", lambda k, x, u: row_cost.stage(x, u, k), takes_k, k, X[:, :-1], U)
    _check_cost_of_stages(cost, takes_k, rows, k, X[:, :-1], U)
    _check_axes("cost.terminal", lambda _, x: row_cost.terminal(x), False, k[:1], X[:, -1:])
    _check_apart("cost.stage", stage, rows, X[:, :-1], U)
    _check_apart("cost.stage", lambda i, x, u: stage(i, x, u, 0), rows, X[:, 0], U[:, 0])
    _check_apart("cost.terminal", lambda i, x: cost.take(i).terminal(x), rows, X[:, -1])
    if type(cost).total is not Cost.total:
        _check_total(row_cost, X, U)
    if type(cost).expand is Cost.expand:
        _check_slope("cost.stage", lambda x, u: row_cost.stage(x, u, k).sum(-1), X[:, :-1], U)
        _check_slope("cost.terminal", lambda x, u: row_cost.terminal(x), X[:, -1], U[:, -1])
        return

    def own(dX: Tensor, dU: Tensor) -> Tensor:
        H = _blocks(X, U)
        row_cost.expand(X, U, H)
        return _along(H, dX, dU)

    _check_slope("cost.expand", row_cost.total, X, U, own)


def _check_cost_of_stages(cost: Cost, takes_k: bool, rows: Tensor, k: Tensor, X: Tensor, U: Tensor) -> None:
    """Check that the costs of all stages at once are those of each stage: of three, unless code takes their numbers."""
    together = lambda i, k, x, u: cost.take(i).stage(x, u, k).unsqueeze(-1)

    def alone(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        joint = together(i, k, *z).clone()
        for j in range(len(k)) if takes_k else (0, len(k) // 2, len(k) - 1):  # a tensor k is that of all stages
            joint[:, j] = together(i, int(k[j]), *(arg[:, j] for arg in z))
        return joint

    with whole_numbers_become(X.dtype):  # else 0.9**k of a tensor would be rounded to float32
        index = called("cost.stage", ONE_STAGE, joined_knots, together, alone, rows, k, (X, U))
    if index is not None:
        raise InputError("cost.stage", ONE_STAGE, f"others at stage {index}, or where other states lie beside")


def _check_total(cost: Cost, X: Tensor, U: Tensor) -> None:
    """Check that the own sum of a cost of two problems is that of its stages and its terminal cost, also far away."""
    for size in (0.0, *DRAWN_SIZES):
        x, u = (z if size == 0.0 else size * scattered(z) for z in (X, U))
        try:
            due = Cost.total(cost, x, u)
        except MISTAKES:  # such states are refused
            continue
        own = called("cost.total", SUM_OF_STAGES, cost.total, x, u)
        check_result("cost.total", own, tuple(due.shape), due.dtype, SUM_OF_STAGES)
        if bool((wrong := unlike(own, due)).any()):
            got, wanted = (float(values[wrong][0]) for values in (own, due))
            raise InputError("cost.total", SUM_OF_STAGES, f"{got:.6g} where these add up to {wanted:.6g}")


def check_constraint(constraint: Constraint, field: str, x0: Tensor, N: int, m: int) -> None:
    """Check a user's constraint, bound to problems of N stages and m controls that start at x0 (B, n).

    Raises:
        InputError: as `check_dynamics`.
    """
    rows, X, U = ends_of(x0), states_near(x0, N + 1), _controls(x0, N, m)
    value = lambda i, X, U: constraint.take(i).value(X, U)
    K = len(torch.arange(N + 1)[constraint.knots])
    if K == 0:
        return
    wanted = f"rows (2, {K}, p) in {x0.dtype}, the type of x0, of two problems (numbers per problem are `batched`)"
    if isinstance(constraint, FunctionConstraint):
        wanted = f"a function of {' and '.join(constraint.of)} that gives {wanted}"
    shape = _check_values(field, value, rows, (X, U), (2, K, None), wanted)
    if 0 in shape:
        return
    if isinstance(constraint, FunctionConstraint):
        _check_rows(constraint, field, rows, len(x0), X, U)
    else:
        _check_apart(field, value, rows, X, U)
        if not constraint.joins_knots:
            _check_rows_of_class(constraint, field, rows, X, U)
    weights = 1.0 + 0.5 * scattered(X.new_empty(shape))

    def own(dX: Tensor, dU: Tensor) -> Tensor:
        H = _blocks(X, U)
        constraint.take(rows).accumulate(X, U, weights, torch.zeros_like(weights), H)
        return _along(H, dX, dU)

    weighted = lambda X, U: (weights * value(rows, X, U)).flatten(1).sum(-1)
    by_pytorch = type(constraint).accumulate in (Constraint.accumulate, FunctionConstraint.accumulate)
    if by_pytorch:
        _check_slope(field, weighted, X, U)
    else:
        _check_slope(f"{field.rpartition('.')[0]}.accumulate", weighted, X, U, own)


def _check_rows(constraint: FunctionConstraint, field: str, rows: Tensor, B: int, X: Tensor, U: Tensor) -> None:
    """Check that the rows of each knot of B problems are those of its own state and controls."""

    def together(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        return constraint.take(i).rows_at(k, *z)

    def alone(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        if constraint.reads_knots:
            taken = constraint.take(i)
            each = [taken.rows_at(k[j : j + 1], *(x[:, j : j + 1] for x in z)) for j in range(len(k))]
            return torch.cat(each, dim=1)
        K, single = len(k), (x.flatten(0, 1).unsqueeze(1) for x in z)
        return together(i.repeat_interleave(K), k[:1], *single).squeeze(1).unflatten(0, (-1, K))

    knots = torch.arange(X.shape[1], device=X.device)[constraint.knots]
    arguments = tuple((X if a == "x" else U)[:, constraint.knots] for a in constraint.of)
    first = [z[:, :1] for z in arguments]
    _check_among_all(field, lambda i, *z: together(i, knots[:1], *z), rows, B, first)
    differing = called(field, ONE_KNOT, joined_knots, together, alone, rows, knots, arguments)
    if differing is not None:
        got = f"rows of knot {int(knots[differing])} that depend on other knots or problems, or on how many there are"
        raise InputError(field, ONE_KNOT, got)
    _check_axes(field, constraint.take(rows).rows_at, taken_by(constraint.function).knot, knots, *arguments)


def _check_rows_of_class(constraint: Constraint, field: str, rows: Tensor, X: Tensor, U: Tensor) -> None:
    """Check that the rows of each knot are those of its own state and controls: by themselves of three knots."""
    every = torch.arange(X.shape[1], device=X.device)
    knots = every[constraint.knots]

    def together(i: Tensor, _: Tensor, x: Tensor, u: Tensor) -> Tensor:
        value = constraint.take(i).value(x, u[:, :-1])
        whole = value.new_zeros(len(value), len(every), value.shape[-1])
        return whole.index_copy(1, knots, value)

    def alone(i: Tensor, k: Tensor, *z: Tensor) -> Tensor:
        joint = together(i, k, *z).clone()
        for j in knots[[0, len(knots) // 2, -1]].tolist():  # along a trajectory that stays there
            joint[:, j] = together(i, k, *(arg[:, j : j + 1].expand_as(arg) for arg in z))[:, j]
        return joint

    arguments = X, torch.cat((U, torch.zeros_like(U[:, :1])), dim=1)  # the last knot has no control
    differing = called(field, ONE_KNOT, joined_knots, together, alone, rows, every, arguments)
    if differing is not None:
        raise InputError(field, ONE_KNOT, f"rows of knot {differing} that depend on other knots or problems")


def check_eager(dynamics: Dynamics, cost: Cost, constraints: Sequence[Constraint], x0: Tensor, N: int) -> None:
    """Differentiate a user's parts as PyTorch's kernels do, for the first problem.

    Raises:
        InputError: names the part that `torch.func` can't differentiate.
    """
    first, wanted = slice(0, 1), "a function that torch.func can differentiate"
    X, U = x0[first].unsqueeze(1).repeat(1, N + 1, 1), x0.new_zeros(1, N, dynamics.m)
    if is_users(dynamics):
        stages = dynamics.take(first).at(torch.arange(N, device=x0.device))
        called("dynamics.step", wanted, stages.jacobians, X[:, :-1], U)
    if is_users(cost):
        called("cost", wanted, cost.take(first).expand, X, U, _blocks(X, U)[first])
    for i, constraint in enumerate(constraints):
        if is_users(constraint):
            single = constraint.take(first)
            zero = torch.zeros_like(called(f"constraints[{i}].value", wanted, single.value, X, U))
            called(f"constraints[{i}].value", wanted, single.accumulate, X, U, zero, zero, _blocks(X, U)[first])


def _check_values(
    field: str,
    function: Callable[..., Any],
    rows: Tensor,
    arguments: tuple[Tensor, ...],
    shape: tuple[int | None, ...],
    wanted: str,
) -> torch.Size:
    """Check function(rows, *arguments) for two problems, together and each on its own; returns the values' shape."""
    before = _versions(arguments)
    both = called(field, wanted, function, rows, *arguments)
    if _versions(arguments) != before:
        raise InputError(
            field, "a function that leaves its arguments as they are", "one that writes into them in place"
        )
    check_result(field, both, shape, arguments[0].dtype, wanted)
    again = called(field, wanted, function, rows, *arguments)
    if not torch.equal(both.nan_to_num(), again.nan_to_num()):
        raise InputError(field, "the same values for the same arguments", "others at a second call: it draws at random")
    if both.numel() == 0:
        return both.shape
    for i in (0, 1):
        alone = called(field, OWN_ROW, function, rows[i : i + 1], *(z[i : i + 1] for z in arguments))
        check_result(field, alone, (1, *both.shape[1:]), both.dtype, OWN_ROW)
        if bool(unlike(alone, both[i : i + 1]).any()):
            raise InputError(field, OWN_ROW, "other values for a problem alone than beside another one")
    return both.shape


def _versions(arguments: Sequence[Tensor]) -> list[int]:
    """How often each of the tensors was written into; unknown to tensors of the inference mode."""
    return [0 if z.is_inference() else z._version for z in arguments]


def _check_among_all(
    field: str, function: Callable[..., Tensor], rows: Tensor, B: int, arguments: Sequence[Tensor]
) -> None:
    """Check that function(rows, *arguments) of two problems is the same among all B."""
    if B <= 2:
        return
    many = [torch.cat((z[:1].expand(B - 1, *z.shape[1:]), z[1:])) for z in arguments]
    among_all = called(field, OWN_ROW, function, torch.arange(B, device=rows.device), *many)
    two = called(field, OWN_ROW, function, rows, *arguments)
    if among_all.shape != (B, *two.shape[1:]) or bool(unlike(among_all[[0, -1]], two).any()):
        raise InputError(field, OWN_ROW, f"other values among {B} problems than among two")


def _check_apart(field: str, function: Callable[..., Tensor], rows: Tensor, *arguments: Tensor) -> None:
    """Check that function(rows, *arguments) of two problems is the same beside a third one, whatever that holds."""
    if mixes_problems(function, rows, *arguments):
        raise InputError(field, OWN_ROW, "values that change with those of another problem")


def _check_axes(field: str, function: Callable[..., Tensor], takes_k: bool, k: Tensor, *arguments: Tensor) -> None:
    """Check that function(k, *arguments) doesn't look at how many axes its arguments have, nor at what k is."""
    if called(field, ANY_AXES, depends_on_axes, function, k, arguments, takes_k):
        raise InputError(field, ANY_AXES, "others for a state by itself, and its k, than among those of all knots")


def check_result(field: str, value: Any, shape: tuple[int | None, ...], dtype: torch.dtype, wanted: str) -> None:
    fits = isinstance(value, Tensor) and value.dim() == len(shape) and value.dtype == dtype
    if not fits or any(want not in (None, got) for want, got in zip(shape, value.shape, strict=True)):
        sizes = ", ".join("p" if size is None else str(size) for size in shape)
        raise InputError(field, wanted, f"{describe(value)} instead of ({sizes}{',' if len(shape) == 1 else ''})")


def _check_slope(
    field: str,
    function: Callable[[Tensor, Tensor], Tensor],
    x: Tensor,
    u: Tensor,
    slope: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> None:
    """Compare derivatives of function(x, u) (2,) in two directions with differences, where two steps of these agree.

    `slope` (dx, du) is the derivative by the part's own code; None: by PyTorch, in reverse mode.
    """
    eps, readers = torch.finfo(x.dtype).eps, WithoutReading()
    expected = "a function with derivatives by PyTorch, or the part's own, that agree with differences"
    if slope is None:
        with readers, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PyTorch's, about numbers read from tensors with gradients
            gx, gu = called(field, expected, gradients_at_once, function, x, u)
        slope = lambda dx, du: (gx * dx).flatten(1).sum(-1) + (gu * du).flatten(1).sum(-1)
    # States and controls apart: the derivatives by one may be too large for a mistake in the others to be seen.
    for dx, du in ((_steps(x), torch.zeros_like(u)), (torch.zeros_like(x), _steps(u))):
        slopes, h = called(field, expected, slope, dx, du), eps ** (1.0 / 3.0)
        along = lambda t, dx=dx, du=du: function(x + t * dx, u + t * du)
        wide, close = ((along(t) - along(-t)) / (2.0 * t) for t in (h, 0.25 * h))
        rounding = NOISE * eps * along(0.0).abs() / (0.25 * h)
        unsure = NOISE * (wide - close).abs() + rounding + DERIVATIVE_SHARE * torch.maximum(slopes.abs(), close.abs())
        wrong = ((slopes - close).abs() > unsure) & torch.isfinite(close)
        if bool(wrong.any()):
            b = wrong.nonzero()[0, 0]
            lost = "".join(f"; Tensor.{name} may lose them" for name in sorted(readers.seen))
            got, due = float(slopes[b]), float(close[b])
            raise InputError(field, expected, f"{got:.4g} where differences give {due:.4g}{lost}")


def called(field: str, wanted: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """function(*arguments), with what it raises as an InputError."""
    try:
        return function(*arguments)
    except InputError:
        raise
    except MISTAKES as error:
        raise InputError(field, wanted, why(error, function, *arguments)) from theirs(error)


def ends_of(x0: Tensor) -> Tensor:
    """The first and the last problem, (2,) int64."""
    return torch.tensor([0, x0.shape[0] - 1], device=x0.device)


def states_near(x0: Tensor, K: int) -> Tensor:
    """States (2, K, n) close to the first and the last start; no two of them are equal."""
    x = x0[ends_of(x0)].unsqueeze(1).repeat(1, K, 1)
    x = torch.where(torch.isfinite(x), x, torch.zeros_like(x))
    return x + OFFSET * (1.0 + x.abs()) * (1.0 + 0.5 * scattered(x))


def _controls(x0: Tensor, K: int, m: int) -> Tensor:
    """Controls (2, K, m) close to zero; no two of them are equal."""
    u = x0.new_zeros(2, K, m)
    return u + OFFSET * (1.0 + 0.5 * scattered(u))


def _steps(z: Tensor) -> Tensor:
    """A direction of differences, larger where the values are."""
    return scattered(z) * (1.0 + z.abs())


def _blocks(X: Tensor, U: Tensor) -> Tensor:
    """Empty homogeneous blocks (2, N+1, s, s)."""
    s = X.shape[-1] + 1 + U.shape[-1]
    return X.new_zeros(2, X.shape[1], s, s)


def _along(H: Tensor, dX: Tensor, dU: Tensor) -> Tensor:
    """The derivative (2,) in a direction from the gradients in homogeneous blocks H (2, N+1, s, s)."""
    n = dX.shape[-1]
    by_x, by_u = H[..., :n, n], H[:, :-1, n + 1 :, n]
    return (by_x * dX).flatten(1).sum(-1) + (by_u * dU).flatten(1).sum(-1)


def check_constraints(constraints: Any) -> None:
    """Raise InputError unless these are constraints in a list, one `RateBounds` at most."""
    # A generator is refused, too: this first look would use it up.
    if not isinstance(constraints, Sequence) or isinstance(constraints, str):
        raise InputError("constraints", "a list of Constraint", kind_of(constraints))
    for constraint in constraints:
        if not isinstance(constraint, Constraint):
            raise InputError("constraints", "a list of Constraint", kind_of(constraint))
    if (rates := sum(isinstance(constraint, RateBounds) for constraint in constraints)) > 1:
        raise InputError("constraints", "one RateBounds at most", rates)


def kind_of(part: object) -> str:
    """A part's class, as errors name it."""
    return f"the class {part.__name__}" if isinstance(part, type) else type(part).__name__
