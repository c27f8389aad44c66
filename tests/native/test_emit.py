"""Emitted code computes the same as CasADi, in every lane."""

import casadi as ca
import numpy as np
import pytest

from tests.native.lanes import Emitted
from tests.slow import mostly
from torchgco.native.codegen import emit as emitting
from torchgco.native.codegen.emit import emit, literal
from torchgco.native.compiler import find_compiler
from torchgco.tracing.operations import to_single

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

inf, nan = np.inf, np.nan
EXACT = {
    "arithmetic": lambda x, y: [x + y, x - y, x * y, x / y, -x, x * x, 2 * x, 1 / x, x + 0.1, x * 1e30],
    "comparisons": lambda x, y: [x < y, x <= y, ca.eq(x, y), ca.ne(x, y)],
    "logic": lambda x, y: [ca.logic_not(x < y), ca.logic_and(x < 1, y < 1), ca.logic_or(x < 1, y < 1)],
    "choices": lambda x, y: [ca.if_else(x < y, 1 / x, y), ca.if_else(x > 0, ca.sqrt(x), -x), ca.if_else(x, y, x)],
    "signs": lambda x, y: [ca.fabs(x), ca.sign(x), ca.copysign(x, y)],
    "rounding": lambda x, y: [ca.floor(x), ca.ceil(x), ca.fmod(x, y)],
    "roots": lambda x, y: [ca.sqrt(x), ca.sqrt(ca.fabs(y))],
    "constants": lambda x, y: [ca.SX(c) for c in (0.1, -1e-310, 5e-324, -inf, inf, nan, 1 / 3, 1.7976931348623157e308)],
}
CLOSE = {
    "circular": lambda x, y: [ca.sin(x), ca.cos(x), ca.tan(x), ca.asin(x), ca.acos(x), ca.atan(x), ca.atan2(x, y)],
    "hyperbolic": lambda x, y: [f(x) for f in (ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh, ca.atanh)],
    "exponential": lambda x, y: [f(x) for f in (ca.exp, ca.expm1, ca.log, ca.log1p, ca.erf)],
    "powers": lambda x, y: [x**y, x**2.5, x**3, 2**x, x**-2, ca.hypot(x, y)],
}
NUMBERS = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.75, 1e-300, -1e6, 1e200, inf, -inf, nan]


def functions(name: str, real: str = "double") -> tuple[ca.Function, Emitted]:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    made = ({**EXACT, **CLOSE})[name](x, y)
    function = ca.Function("made", [x, y], [ca.densify(ca.vertcat(*made))])
    return function, Emitted(emit("tgco_made", function), "tgco_made", [1, 1], [len(made)], real)


def pairs() -> tuple[np.ndarray, np.ndarray]:
    x, y = (a.reshape(-1, 1) for a in np.meshgrid(NUMBERS, NUMBERS))
    return x, y


def by_casadi(function: ca.Function, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.array([np.array(function(a, b)).reshape(-1) for a, b in zip(x, y, strict=True)])


@pytest.mark.parametrize("name", EXACT)
def test_exact_operations(name: str) -> None:
    function, emitted = functions(name)
    expected, (made,) = by_casadi(function, *pairs()), emitted(*pairs())
    np.testing.assert_array_equal(made, expected)
    unlike = np.signbit(made) != np.signbit(expected)
    assert not np.any(unlike & ~np.isnan(expected)) or name == "choices"  # either zero is right there


def test_minimum_and_maximum_are_those_of_pytorch() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("made", [x, y], [ca.vertcat(ca.fmin(x, y), ca.fmax(x, y), ca.fmin(x, 1.0), ca.fmax(0.5, y))])
    a, b = pairs()
    (made,) = Emitted(emit("tgco_made", function), "tgco_made", [1, 1], [4])(a, b)
    # NumPy's, like PyTorch's, are NaN where one of the two is; CasADi's own aren't.
    np.testing.assert_array_equal(
        made, np.hstack((np.minimum(a, b), np.maximum(a, b), np.minimum(a, 1.0), np.maximum(0.5, b)))
    )


def test_the_remainder_by_infinity_rounds_to_single_precision() -> None:
    x = ca.SX.sym("x")
    function = ca.Function("made", [x], [to_single(to_single(x) * 3.0)])
    values = np.random.default_rng(5).standard_normal((100, 1))
    for real in ("double", "float"):
        (made,) = Emitted(emit("tgco_made", function), "tgco_made", [1], [1], real)(values)
        np.testing.assert_array_equal(made, values.astype(np.float32) * np.float32(3.0))


@pytest.mark.parametrize("name", CLOSE)
def test_functions_of_the_library(name: str) -> None:
    function, emitted = functions(name)
    x, y = pairs()
    np.testing.assert_allclose(emitted(x, y)[0], by_casadi(function, x, y), rtol=1e-14)


@pytest.mark.parametrize(("real", "spacing"), [("double", 2.2e-16), ("float", 1.2e-7)])
def test_sine_and_cosine_of_all_sizes(real: str, spacing: float) -> None:
    x = ca.SX.sym("x")
    function = ca.Function("made", [x], [ca.vertcat(ca.sin(x), ca.cos(x))])
    emitted = Emitted(emit("tgco_made", function), "tgco_made", [1], [2], real)
    random = np.random.default_rng(3)
    sizes = 10.0 ** random.uniform(-12, 8, (4096, 1)) * random.choice([-1.0, 1.0], (4096, 1))
    quarters = np.pi / 2 * random.integers(-6000, 6000, (512, 1)) + random.uniform(-1e-6, 1e-6, (512, 1))
    values = np.concatenate((sizes, quarters)).astype(np.float32 if real == "float" else np.float64)
    exact = values.astype(np.longdouble)
    np.testing.assert_allclose(
        emitted(values)[0], np.concatenate((np.sin(exact), np.cos(exact)), axis=1).astype(float), rtol=0, atol=spacing
    )
    tiny = np.abs(values[:, 0]) < 1e-5  # the sine keeps its relative precision where it is small
    np.testing.assert_allclose(emitted(values)[0][tiny, 0], values[tiny, 0], rtol=1e-10)


@pytest.mark.parametrize(("real", "spacing"), [("double", 2.2e-16), ("float", 1.2e-7)])
def test_exponentials_logarithms_and_the_tangent_of_all_sizes(real: str, spacing: float) -> None:
    x = ca.SX.sym("x")
    names = "exp", "expm1", "tanh", "tan", "log", "log1p"
    function = ca.Function("made", [x], [ca.vertcat(*(getattr(ca, name)(x) for name in names))])
    emitted = Emitted(emit("tgco_made", function), "tgco_made", [1], [len(names)], real)
    random = np.random.default_rng(3)
    sizes = np.concatenate((10.0 ** random.uniform(-12, 1.9, (4096, 1)), 1.0 + random.uniform(-0.02, 0.02, (512, 1))))
    values = (sizes * random.choice([-1.0, 1.0], sizes.shape)).astype(np.float32 if real == "float" else np.float64)
    exact, (made,) = values.astype(np.longdouble), emitted(values)
    for column, name in zip(made.T, names, strict=True):
        within = values[:, 0] > {"log": 0.0, "log1p": -1.0}.get(name, -np.inf)
        expected = getattr(np, name)(exact[within, 0])
        np.testing.assert_allclose(column[within], expected.astype(float), rtol=4 * spacing, err_msg=name)


@pytest.mark.parametrize("name", [*EXACT, *CLOSE])
def test_single_precision(name: str) -> None:
    function, emitted = functions(name, "float")
    few = [i for i, number in enumerate(NUMBERS) if (abs(number) < 10 and abs(number) != 1e-300) or np.isnan(number)]
    x, y = (z.reshape(len(NUMBERS), -1)[np.ix_(few, few)].reshape(-1, 1) for z in pairs())
    with np.errstate(over="ignore", under="ignore"):
        expected = by_casadi(function, x, y).astype(np.float32)
    np.testing.assert_allclose(emitted(x, y)[0], expected, rtol=1e-6, atol=1e-30)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", [*EXACT, *CLOSE])
@pytest.mark.parametrize("lanes", mostly([1, 4, 16], 1))
def test_lanes_do_not_affect_each_other(name: str, lanes: int) -> None:
    function, emitted = functions(name)
    code, size = emit("tgco_made", function), function.numel_out()
    x, y = pairs()
    (expected,) = emitted(x, y)
    (narrow,) = Emitted(code, "tgco_made", [1, 1], [size], lanes=lanes)(x, y)
    np.testing.assert_array_equal(narrow.view(np.int64), expected.view(np.int64))
    order = np.random.default_rng(1).permutation(len(x))
    (shuffled,) = emitted(x[order], y[order])
    np.testing.assert_array_equal(shuffled.view(np.int64), expected[order].view(np.int64))


def test_sparse_outputs_and_several_inputs() -> None:
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 3)
    sparse = ca.SX(3, 3)
    sparse[0, 0], sparse[2, 1], sparse[1, 2] = x[0] * y[2], y[1], x[1]
    function = ca.Function("made", [x, y], [sparse, ca.SX(0, 1), x[0] - y[0]])
    values = np.arange(10.0).reshape(2, 5)
    first, _, last = Emitted(emit("tgco_made", function), "tgco_made", [2, 3], [3, 0, 1])(values[:, :2], values[:, 2:])
    np.testing.assert_array_equal(first, [[0.0, 3.0, 1.0], [45.0, 8.0, 6.0]])
    np.testing.assert_array_equal(last, [[-2.0], [-2.0]])


def test_unsupported_operations_are_named() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(ValueError, match="ERFINV"):
        emit("tgco_made", ca.Function("made", [x], [ca.erfinv(x)]))
    z = ca.MX.sym("z")
    with pytest.raises(ValueError, match="scalar expressions"):
        emit("tgco_made", ca.Function("made", [z], [z]))


def test_literals() -> None:
    for value in (0.1, -3.0, 1e-310, 0.0, -0.0):
        assert float.fromhex(literal(value)).hex() == value.hex()
    assert [literal(v) for v in (inf, -inf, nan)] == ["INFINITY", "-INFINITY", "NAN"]


def chained(steps: int) -> ca.Function:
    """A step again and again: values of the first ones are read by the last ones."""
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    z, early = x, []
    for _ in range(steps):
        z = ca.vertcat(z[1] * y[0] + ca.sin(z[0]), z[2] - 0.3 * z[0] * z[0], ca.fabs(z[0]) / (1.0 + z[1] * z[1]) + y[1])
        early.append(z[2])
    return ca.Function("made", [x, y], [z, ca.vertcat(*early) * z[0]])


@pytest.mark.parametrize("piece", [1, 7, 40])
def test_a_long_function_in_pieces_has_the_bits_of_the_whole(piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
    draws = np.random.default_rng(4)
    x, y, function = draws.normal(size=(11, 3)), draws.normal(size=(11, 2)), chained(12)
    whole = emit("tgco_made", function)
    monkeypatch.setattr(emitting, "LONG", 50)
    monkeypatch.setattr(emitting, "PIECE", piece)
    cut = emit("tgco_made", function)
    assert "kept" not in whole and cut.count("tgco_made_piece_") == 2 * -(-whole.count(" = ") // piece)
    assert emitting.whole(f"{cut}{whole}") == whole + whole
    results = [Emitted(code, "tgco_made", [3, 2], [3, 12])(x, y) for code in (whole, cut)]
    for a, b in zip(*results, strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_array_equal(a, b)
