"""The counterparts of ATen operations for arrays whose elements are CasADi expressions.

An array is a NumPy array of objects, each a number or a scalar `casadi.SX`: NumPy brings shapes, broadcasting and
indexing, CasADi the arithmetic. Where all arguments are numbers the result is a number.

Recording a function needs only the names in `OPERATIONS`: CasADi is loaded by the first replay that computes something.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from torchgco.base.roots import SOLVED, UNKNOWN
from torchgco.tracing import arrays
from torchgco.tracing.arrays import NoCounterpart, boxed

Scalar = Callable | str  # a function of scalars, or the name of CasADi's
FEW = 8  # expressions that take as long in columns as one after the other


@functools.cache
def _casadi() -> Any:
    import casadi

    return casadi


def _elementwise(function: Scalar, inputs: int) -> Callable:
    """`function` of scalars, on arrays that are broadcast to one shape."""
    return lambda *arrays: boxed(_over(function, inputs)(*arrays))


@functools.cache
def _over(function: Scalar, inputs: int) -> np.ufunc:
    """`function` of scalars, one element after the other."""
    return np.frompyfunc(getattr(_casadi(), function) if isinstance(function, str) else function, inputs, 1)


def _columnwise(function: Scalar, inputs: int) -> Callable:
    """The same of a function that CasADi computes of whole columns, too, in a quarter of the time for each element."""

    def over(*operands: Any) -> np.ndarray:
        same = [np.asarray(a, dtype=object) for a in np.broadcast_arrays(*map(boxed, operands))]
        symbolic = _symbolic(*same)
        if np.count_nonzero(symbolic) < FEW:
            return boxed(_over(function, inputs)(*operands))
        result = np.empty(symbolic.shape, dtype=object)
        result[~symbolic] = _over(function, inputs)(*(a[~symbolic] for a in same))
        of_columns = getattr(_casadi(), function) if isinstance(function, str) else function
        result[symbolic] = arrays.elements(of_columns(*(_casadi().vertcat(*a[symbolic]) for a in same)))
        return result

    return over


def _symbolic(*operands: np.ndarray) -> np.ndarray:
    """Where one of some arrays of one shape has an expression."""
    is_symbolic = np.frompyfunc(lambda element: isinstance(element, _casadi().SX), 1, 1)
    return functools.reduce(np.logical_or, (np.asarray(is_symbolic(a), dtype=bool) for a in operands))


_unary, _binary = (functools.partial(_columnwise, inputs=inputs) for inputs in (1, 2))


def _choose(condition: Any, a: Any, b: Any) -> Any:
    # CasADi's own choice drops the branch not taken, so that a NaN there does no harm.
    ca = _casadi()
    return ca.if_else(condition, a, b) if isinstance(condition, ca.SX) else (a if condition else b)


def _itself(element: Any) -> Any:
    """The same number, or NaN, which CasADi doesn't recognise as the same: |e| with the sign of e."""
    return _casadi().copysign(element, element)


def _comparison(compare: Callable) -> Callable:
    """A comparison that is false where one of the two is NaN, `ne` true, as in PyTorch.

    CasADi takes an expression for equal to itself, and a square for at least 0, which NaN is not.
    """

    def compared(a: Any, b: Any) -> Any:
        result = compare(a, b)
        if not isinstance(result, _casadi().SX) or not result.is_constant():
            return result
        return compare(_itself(a), b) if isinstance(a, _casadi().SX) else compare(a, _itself(b))

    return _elementwise(compared, 2)


_where = _elementwise(_choose, 3)
_add, _sub, _mul = _binary(operator.add), _binary(operator.sub), _binary(operator.mul)
COMPARISONS = "aten.lt", "aten.le", "aten.gt", "aten.ge", "aten.eq", "aten.ne"
_lt, _le, _gt, _ge, _eq, _ne = (_comparison(getattr(operator, name[-2:])) for name in COMPARISONS)
_truediv, _floor, _fmod = _binary(operator.truediv), _unary("floor"), _binary("fmod")


def _raise(a: Any, b: Any) -> Any:
    power = a**b
    if not isinstance(b, _casadi().SX) or b.is_constant():
        return power
    # At a = 0 the derivatives b a^(b-1), b (b-1) a^(b-2) and a^b log(a) may be 0 times infinity.
    at_zero = _choose(b > 2.0, 0.0, power)
    for whole, value in ((2.0, a * a), (1.0, a), (0.0, 1.0)):
        at_zero = _choose(b == whole, value, at_zero)
    return _choose(a == 0.0, at_zero, power)


_power = _elementwise(_raise, 2)
_sqrt = _unary("sqrt")
_fmin, _fmax = _binary("fmin"), _binary("fmax")  # in C, NaN where one of the two is


def _divide(a: Any, b: Any, rounding_mode: str | None = None) -> np.ndarray:
    if rounding_mode == "floor":
        return _floor_divided(a, b)
    quotient = _truediv(a, b)
    return quotient if rounding_mode is None else _where(_lt(quotient, 0.0), _unary("ceil")(quotient), _floor(quotient))


def _no_formula() -> Any:
    raise NoCounterpart("an implicit step has no formula")


def _excess(a: Any, b: Any) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a / b rounded towards 0, exactly, and where rounding down leaves b more."""
    left = _fmod(a, b)
    return left, _where(_lt(b, 0.0), _gt(left, 0.0), _lt(left, 0.0))


def _floor_divided(a: Any, b: Any) -> np.ndarray:
    # As PyTorch: the quotient itself may round up to a whole number, as 1.0 / 0.1 does.
    left, more = _excess(a, b)
    whole = _sub(_truediv(_sub(a, left), b), more)
    down = _floor(whole)
    near = _add(down, _gt(_sub(whole, down), 0.5))
    return _where(_eq(b, 0.0), _floor(_truediv(a, b)), near)  # by 0: infinite or NaN, with the derivative 0


def _remainder(a: Any, b: Any) -> np.ndarray:
    left, more = _excess(a, b)
    return _where(more, _add(left, b), left)


def _clamp(a: Any, min: Any = None, max: Any = None) -> np.ndarray:
    # Choices, not fmin and fmax: NaN stays NaN, and the derivative at a number is PyTorch's, at a tensor 1.
    for bound, beyond, reached in ((min, _lt, _le), (max, _gt, _ge)):
        if bound is not None:
            flat = not isinstance(bound, np.ndarray) and _flat_at_numbers()
            outside = (reached if flat else beyond)(a, bound)
            is_result = _elementwise(_either, 2)(outside, _ne(bound, bound))  # a bound that is NaN, too
            a = _where(is_result, bound, a)
    return a


def _either(a: Any, b: Any) -> Any:
    """Whether one of two truths holds; the other one itself where the second is a number and false."""
    return a if not isinstance(b, _casadi().SX) and not b else _casadi().logic_or(a, b)


@functools.cache
@torch.inference_mode(False)
@torch.enable_grad()
def _flat_at_numbers() -> bool:
    """Whether the derivative of PyTorch's clamp at a bound that is a number is 0, as since 2.14, instead of 1."""
    x = torch.zeros((), requires_grad=True)
    return torch.autograd.grad(x.clamp(min=0.0), x)[0].item() == 0.0


def _hardtanh(a: np.ndarray, low: float = -1.0, high: float = 1.0) -> np.ndarray:
    a = _where(_le(a, low), low, a)  # the derivative is 0 at the bounds
    return _where(_ge(a, high), high, a)


def _softplus(a: np.ndarray, beta: float = 1.0, threshold: float = 20.0) -> np.ndarray:
    scaled = _mul(a, beta)
    return _where(_gt(scaled, threshold), a, _truediv(_unary("log1p")(_unary("exp")(scaled)), beta))


def _falling(a: np.ndarray) -> np.ndarray:
    """exp(-|a|), with the derivative from the right at 0."""
    return _unary("exp")(_where(_lt(a, 0.0), a, _unary(operator.neg)(a)))


def _sinc(a: np.ndarray) -> np.ndarray:
    # A quotient's derivatives lose all digits near 0. The series' first term left out, x^12 / 13!, is below 2^-53 here.
    x = _mul(a, math.pi)
    near, square = _lt(_unary("fabs")(x), 0.3), _mul(x, x)
    series = 1.0
    for i in (5, 4, 3, 2, 1):
        series = _sub(1.0, _truediv(_mul(square, series), 2 * i * (2 * i + 1)))
    return _where(near, series, _truediv(_unary("sin")(x), x))


def _sigmoid(a: np.ndarray) -> np.ndarray:
    # Not by tanh: of large negative numbers, all digits would be lost.
    e = _falling(a)
    return _truediv(_where(_lt(a, 0.0), e, 1.0), _add(1.0, e))


_gelu = _unary(lambda x: 0.5 * x * (1.0 + _casadi().erf(x / math.sqrt(2.0))))
_gelu_by_tanh = _unary(
    lambda x: 0.5 * x * (1.0 + _casadi().tanh(math.sqrt(2.0 / math.pi) * (x + 0.044715 * x * x * x)))
)


def _elu(a: np.ndarray, alpha: float = 1.0, scale: float = 1.0, input_scale: float = 1.0) -> np.ndarray:
    below = _mul(_unary("expm1")(_mul(a, input_scale)), alpha * scale)
    return _where(_gt(a, 0.0), _mul(a, scale), below)


def _matmul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # CasADi's own product: entry by entry, the thousands of entries of an obstacle constraint would take long.
    ca = _casadi()
    if a.ndim == 2:
        product = ca.mtimes(_matrix(a), _matrix(b))
        return np.array(ca.densify(product).nonzeros(), dtype=object).reshape(b.shape[1], a.shape[0]).T
    return np.stack([_matmul(first, second) for first, second in zip(a, b, strict=True)])


def _matrix(a: np.ndarray) -> Any:
    ca = _casadi()
    return ca.reshape(ca.vertcat(ca.SX(0, 1), *a.T.reshape(-1)), *a.shape)


def _addmm(c: np.ndarray, a: np.ndarray, b: np.ndarray, beta: float = 1, alpha: float = 1) -> np.ndarray:
    return _add(_mul(beta, c), _mul(alpha, _matmul(a, b)))


def _sum(a: np.ndarray, dim: Any = None, keepdim: bool = False, **_: Any) -> np.ndarray:
    return boxed(np.sum(a, axis=arrays.axes(a, dim), keepdims=keepdim))


def _mean(a: np.ndarray, dim: Any = None, keepdim: bool = False, **_: Any) -> np.ndarray:
    return _truediv(_sum(a, dim, keepdim), math.prod(a.shape[axis] for axis in arrays.axes(a, dim)))


def _fold(combine: Callable) -> Callable:
    """A reduction by pairs along some axes, or along all."""

    def reduce(a: np.ndarray, dim: Any = None, keepdim: bool = False, **_: Any) -> np.ndarray:
        axes = arrays.axes(a, dim)
        front = np.moveaxis(a, axes, range(len(axes)))
        rest = front.shape[len(axes) :]
        reduced = functools.reduce(combine, map(boxed, front.reshape(-1, *rest)))
        return np.expand_dims(reduced, axes) if keepdim else reduced

    return reduce


def _norm(a: np.ndarray, ord: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> np.ndarray:
    if ord != 2:
        raise NoCounterpart  # with another type of its result
    square = _sum(_mul(a, a), dim, keepdim)
    return _where(_eq(square, 0.0), 0.0, _sqrt(square))  # at zero the derivative is 0, as PyTorch's


def _cross(a: np.ndarray, b: np.ndarray, dim: int = -1) -> np.ndarray:
    a, b = np.broadcast_arrays(a, b)
    return np.cross(a, b, axis=dim)


FILLED = {"zeros": 0.0, "ones": 1.0, "empty": 0.0}


def _full(value: float, a: np.ndarray, size: Sequence[int] | None = None, **_: Any) -> np.ndarray:
    return np.full(a.shape if size is None else tuple(size), value, dtype=object)


def is_logical(element: Any) -> bool:
    """Whether an expression is 0 or 1 by its own form."""
    return isinstance(element, _casadi().SX) and element.op() in _logical()


@functools.cache
def _logical() -> frozenset[int]:
    return frozenset(getattr(_casadi(), f"OP_{name}") for name in ("LT", "LE", "EQ", "NE", "NOT", "AND", "OR"))


def to_truth(element: Any) -> Any:
    """1 where an element isn't 0, NaN too, and else 0."""
    if not isinstance(element, _casadi().SX):
        return 1.0 if element != 0 else 0.0
    return element if is_logical(element) else _casadi().ne(element, 0)


def to_single(element: Any) -> Any:
    """An element rounded to single precision.

    CasADi has no such operation: its remainder by infinity, which no counterpart makes and which is the number itself,
    stands for it, and is a conversion in C.
    """
    if not isinstance(element, _casadi().SX):
        return float(np.float32(element))
    return element if is_logical(element) else _casadi().remainder(element, math.inf)


def wrapped(element: Any, low: int, size: int) -> Any:
    """The whole number from `low` to `low + size - 1` that differs from a whole number by a multiple of `size`."""
    return element - size * _casadi().floor((element - low) / size)


def _truths(reduce: Callable) -> Callable:
    """A reduction whose result is 0 or 1 where it takes over a single element, too."""
    return lambda *args, **options: _elementwise(to_truth, 1)(reduce(*args, **options))


def _refused(*_: Any, **__: Any) -> Any:
    raise NoCounterpart("bits of integers")


def _whole_power(a: np.ndarray, exponent: Any) -> np.ndarray:
    if not isinstance(exponent, int):
        raise NoCounterpart("an integer's power that may be a fraction")
    return _power(a, exponent)


# The counterparts where the result is an integer.
WHOLE_NUMBERS: dict[str, Callable] = {
    "aten.bitwise_and": _refused,
    "aten.bitwise_or": _refused,
    "aten.bitwise_not": _unary(lambda x: -x - 1),
    "aten.pow": _whole_power,
}
# By name of the operation, without its overload. Others are first decomposed by PyTorch, where it can.
OPERATIONS: dict[str, Callable] = {
    # arithmetic
    "aten.add": lambda a, b, alpha=1: _add(a, b if alpha == 1 else _mul(b, alpha)),
    "aten.sub": lambda a, b, alpha=1: _sub(a, b if alpha == 1 else _mul(b, alpha)),
    "aten.rsub": lambda a, b, alpha=1: _sub(b, a if alpha == 1 else _mul(a, alpha)),
    "aten.mul": _mul,
    "aten.div": _divide,
    "aten.neg": _unary(operator.neg),
    "aten.reciprocal": _unary(lambda x: 1.0 / x),
    "aten.pow": _power,
    "aten.square": _unary(lambda x: x * x),
    "aten.sqrt": _sqrt,
    "aten.rsqrt": _unary(lambda x: 1.0 / _casadi().sqrt(x)),
    "aten.abs": _unary("fabs"),
    "aten.sign": lambda a: _sub(_gt(a, 0.0), _lt(a, 0.0)),  # of NaN it is 0
    "aten.floor": _floor,
    "aten.ceil": _unary("ceil"),
    "aten.fmod": _fmod,
    "aten.remainder": _remainder,
    # functions
    **{
        f"aten.{name}": _unary(name)
        for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
    },
    **{f"aten.{name}": _unary(name) for name in ("exp", "expm1", "log", "log1p", "log10", "erf")},
    "aten.log2": _unary(lambda x: _casadi().log(x) / math.log(2.0)),
    "aten.sinc": _sinc,
    "aten.atan2": _binary("atan2"),
    "aten.hypot": _binary("hypot"),
    "aten.sigmoid": _sigmoid,
    "aten.log_sigmoid_forward": lambda a: [_sub(_where(_lt(a, 0.0), a, 0.0), _unary("log1p")(_falling(a))), a],
    "aten.relu": lambda a: _where(_le(a, 0.0), 0.0, a),
    "aten.leaky_relu": lambda a, slope=0.01: _where(_gt(a, 0.0), a, _mul(a, slope)),
    "aten.softplus": _softplus,
    "aten.gelu": lambda a, approximate="none": (_gelu if approximate == "none" else _gelu_by_tanh)(a),
    "aten.elu": _elu,
    # choices
    "aten.where": _where,
    "aten.clamp": _clamp,
    "aten.clamp_min": _clamp,
    "aten.clamp_max": lambda a, max: _clamp(a, max=max),
    "aten.hardtanh": _hardtanh,
    "aten.maximum": _fmax,
    "aten.minimum": _fmin,
    **dict(zip(COMPARISONS, (_lt, _le, _gt, _ge, _eq, _ne), strict=True)),
    **{f"aten.{kind}_{name}": _binary(f"logic_{name}") for kind in ("logical", "bitwise") for name in ("and", "or")},
    **{f"aten.{kind}_not": _unary("logic_not") for kind in ("logical", "bitwise")},
    # products and reductions
    "aten.mm": _matmul,
    "aten.bmm": _matmul,
    "aten.addmm": _addmm,
    "aten.linalg_cross": _cross,
    "aten.sum": _sum,
    "aten.mean": _mean,
    "aten.prod": _fold(_mul),
    "aten.linalg_vector_norm": _norm,
    "aten.amax": _fold(_fmax),
    "aten.amin": _fold(_fmin),
    "aten.any": _truths(_fold(_binary("logic_or"))),
    "aten.all": _truths(_fold(_binary("logic_and"))),
    "aten.cumsum": lambda a, dim, **_: np.cumsum(a, axis=dim),
    # shapes
    **{f"aten.{name}": lambda a, shape: a.reshape(tuple(shape)) for name in ("view", "reshape", "_unsafe_view")},
    "aten.unsqueeze": lambda a, dim: np.expand_dims(a, dim),
    "aten.squeeze": arrays.squeeze,
    "aten.expand": arrays.expand,
    "aten.permute": lambda a, dims: np.transpose(a, tuple(dims)),
    "aten.transpose": lambda a, i, j: np.swapaxes(a, i, j),
    "aten.t": lambda a: a.T,
    "aten.flip": lambda a, dims: np.flip(a, tuple(dims)),
    "aten.repeat": np.tile,
    "aten.diagonal": lambda a, offset=0, dim1=0, dim2=1: np.diagonal(a, offset, dim1, dim2),
    "aten.cat": lambda parts, dim=0: np.concatenate(list(parts), axis=dim),
    "aten.stack": lambda parts, dim=0: np.stack(list(parts), axis=dim),
    "aten.split": arrays.split,
    "aten.split_with_sizes": arrays.pieces,
    "aten.unbind": arrays.unbind,
    # places
    "aten.select": arrays.select,
    "aten.slice": arrays.cut,
    "aten.index": arrays.index,
    "aten.index_select": arrays.index_select,
    "aten.gather": arrays.gather,
    "aten.select_scatter": arrays.select_scatter,
    "aten.slice_scatter": arrays.slice_scatter,
    "aten.diagonal_scatter": arrays.diagonal_scatter,
    "aten.index_put": arrays.index_put,
    # copies and new ones
    **{f"aten.{name}": lambda a, **_: a for name in ("clone", "alias", "detach", "lift_fresh_copy", "_to_copy")},
    "prims.convert_element_type": lambda a, dtype: a,
    "aten.copy": lambda a, source, *_: arrays.expand(source, a.shape),
    "aten.fill": lambda a, value: arrays.expand(boxed(value), a.shape),
    **{f"aten.{name}_like": functools.partial(_full, value) for name, value in FILLED.items()},
    "aten.full_like": lambda a, value, **_: _full(value, a),
    **{f"aten.new_{name}": functools.partial(_full, value) for name, value in FILLED.items()},
    "aten.new_full": lambda a, size, value, **_: _full(value, a, size),
    # the root of an equation, which `Traced` keeps whole
    UNKNOWN: lambda guess: _no_formula(),
    SOLVED: lambda unknown, residual: _no_formula(),
}
