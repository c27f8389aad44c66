"""Second derivatives of functions with branches: right in the branch taken, whatever the other would give."""

import casadi as ca
import numpy as np
import pytest

from torchgco.native.codegen.curvature import _has_hidden_pole, _hessian


def needed_anyway(x: ca.SX, y: ca.SX, root: ca.SX) -> ca.SX:
    return root + ca.if_else(x > 0, root, y * y)


CASES = {  # of x and y; whether a branch hides a pole; the second derivatives at (-1, 2)
    "a root": (lambda x, y: ca.if_else(x > 0, ca.sqrt(x), x * y), True, [[0, 1], [1, 0]]),
    "a quotient": (lambda x, y: ca.if_else(x > 0, y / (x + 1), y * y), True, [[0, 0], [0, 2]]),
    "two branches": (lambda x, y: ca.if_else(x > 0, ca.if_else(y > 0, y, ca.sqrt(x)), x * y), True, [[0, 1], [1, 0]]),
    "polynomials": (lambda x, y: ca.if_else(x > 0, x * x, x * x * y), False, [[4, -2], [-2, 0]]),
    "a root needed anyway": (lambda x, y: needed_anyway(x, y, ca.sqrt(y)), False, [[0, 0], [0, 2 - 2**-3.5]]),
    "a clamp before a root": (lambda x, y: ca.sqrt(ca.if_else(x > 0.25, x, 0.25)) * y, False, [[0, 0], [0, 0]]),
    "no branch": (lambda x, y: y / x, False, [[-4, -1], [-1, 0]]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_branch_that_is_not_taken_spoils_nothing(name: str) -> None:
    make, hidden, expected = CASES[name]
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    total = make(x, y)
    assert _has_hidden_pole(ca.Function("total", [x, y], [total])) is hidden
    hessian = ca.Function("hessian", [x, y], [_hessian(total, ca.vertcat(x, y), [x, y])])
    np.testing.assert_allclose(np.array(hessian(-1.0, 2.0)), expected, atol=1e-12)


def test_what_a_network_makes_may_be_a_pole() -> None:
    x, y, made = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("made")
    total = ca.if_else(x > 0, made**3, x * y)
    inputs = [x, y, made]
    assert _has_hidden_pole(ca.Function("total", inputs, [total]), {2})
    assert not _has_hidden_pole(ca.Function("total", inputs, [made + total]), {2})
    hessian = ca.Function("hessian", inputs, [_hessian(total, ca.vertcat(x, y), inputs, {made.element_hash()})])
    np.testing.assert_allclose(np.array(hessian(-1.0, 2.0, np.nan)), [[0, 1], [1, 0]])
