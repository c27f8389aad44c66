"""What CasADi computes of whole columns is what it computes of one element after the other."""

import casadi as ca
import numpy as np
import pytest

from torchgco.tracing import operations
from torchgco.tracing.arrays import elements
from torchgco.tracing.operations import OPERATIONS

pytestmark = pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
ONE = (
    "neg", "reciprocal", "square", "sqrt", "rsqrt", "abs", "sign", "floor", "ceil", "sin", "atanh", "exp", "log1p",
    "log2", "erf", "sinc", "sigmoid", "relu", "softplus", "gelu", "elu", "logical_not",
)  # fmt: skip
TWO = (
    "add", "sub", "mul", "div", "pow", "fmod", "remainder", "atan2", "hypot", "maximum", "minimum", "logical_and",
    "lt", "eq",
)  # fmt: skip
NUMBERS = (0.0, 1.0, -1.0, 2.5, 1, True)


def mixed(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Expressions, the same one twice among them, a constant one, and numbers."""
    draws = np.random.default_rng(seed)
    x = elements(ca.SX.sym(f"x{seed}", 5))
    pool = [*x, x[0] * x[1], ca.SX(0.0), ca.SX(3.0), *NUMBERS]
    array = np.empty(shape, dtype=object)
    for place in np.ndindex(*shape):
        array[place] = pool[draws.integers(len(pool))]
    return array


def both_ways(name: str, *arguments: np.ndarray) -> list[np.ndarray]:
    found = []
    for few in (0, 10**9):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(operations, "FEW", few)
            found.append(OPERATIONS[f"aten.{name}"](*arguments))
    return found


def assert_same(columns: np.ndarray, single: np.ndarray) -> None:
    assert columns.shape == single.shape
    for a, b in zip(columns.ravel(), single.ravel(), strict=True):
        assert isinstance(a, ca.SX) == isinstance(b, ca.SX)
        assert str(a) == str(b) if isinstance(a, ca.SX) else a == b or (np.isnan(a) and np.isnan(b))


@pytest.mark.parametrize("name", ONE)
def test_functions_of_one(name: str) -> None:
    some = mixed(3, (4, 1, 9))
    number = [e for e in some.ravel() if not isinstance(e, ca.SX)]
    assert number and len(number) < some.size
    if name in ("atanh", "log1p", "reciprocal", "sqrt", "rsqrt", "log2", "sinc"):  # undefined for some of the numbers
        some = np.where([[[not isinstance(e, ca.SX) for e in row] for row in part] for part in some], 0.5, some)
    assert_same(*both_ways(name, some))


@pytest.mark.parametrize("name", TWO)
def test_functions_of_two_that_are_broadcast(name: str) -> None:
    a, b = mixed(5, (7, 1, 3)), mixed(6, (4, 3))
    if name in ("div", "fmod", "remainder", "pow"):
        b = np.where([[not isinstance(e, ca.SX) for e in row] for row in b], 2.0, b)
    assert_same(*both_ways(name, a, b))
    assert_same(*both_ways(name, a, np.float64(0.5)))
    assert_same(*both_ways(name, a, np.array(2)))


def test_numbers_alone_stay_numbers() -> None:
    a = np.arange(1.0, 40.0).reshape(3, 13)
    columns, single = both_ways("mul", a, a[:1])
    assert_same(columns, single)
    assert all(isinstance(e, float) for e in columns.ravel())
