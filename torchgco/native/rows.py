"""C of a constraint that is given as a PyTorch function: its rows, and what they add to a quadratic model."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.native import emit, store
from torchgco.native.model import elements, makers
from torchgco.tracing import Traced


@dataclass(frozen=True)
class RowsSource:
    """Rows c (p) of x (n), u (m) and a knot's own numbers p, for the prelude of `emit`:

        tgco_KEY_rows(x, u, p, c)
        tgco_KEY_add(x, u, p, by_c, by_cc, g, H)     g += c_z' by_c,  H += c_z' diag(by_cc) c_z, its upper triangle
    """

    p: int
    code: str
    key: str


def trace_rows(field: str, function: Callable[[Tensor, Tensor], Tensor], n: int, m: int) -> RowsSource:
    """The C of function(x (1, n), u (1, m)) -> (1, p), from the cache folder where it was made before.

    Raises:
        InputError: the function can't be traced, or holds an operation without a counterpart.
    """
    x, u = torch.zeros(1, n, dtype=torch.float64), torch.zeros(1, m, dtype=torch.float64)
    p = function(x, u).shape[-1]
    traced = Traced(field, lambda i, x, u: function(x, u), x, u)
    key = store.key_of(("rows", traced.fingerprint(), *makers(__file__)))
    known = store.read(key, ".json")
    if known is None:
        known = json.dumps(_made(traced, key[:16], n, m)).encode()
        store.save(key, ".json", known)
    return RowsSource(p, json.loads(known)["code"], key[:16])


def _made(traced: Traced, name: str, n: int, m: int) -> dict[str, Any]:
    import casadi as ca

    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX(0, 1)
    c = ca.densify(ca.vertcat(*traced(elements(ca.SX(0, 1)), elements(x)[None], elements(u)[None]).reshape(-1)))
    slopes = ca.sparsify(ca.jacobian(c, ca.vertcat(x, u), {"allow_reverse": False}))
    rows, columns = slopes.sparsity().get_triplet()
    nonzeros: list[Any] = slopes.nonzeros()
    entries = ca.vertcat(ca.SX(0, 1), *nonzeros)
    code = [
        emit.emit(f"tgco_{name}_rows", ca.Function("rows", [x, u, p], [c])),
        emit.emit(f"tgco_{name}_slopes", ca.Function("slopes", [x, u, p], [entries])),
        f"static inline void tgco_{name}_add(",
        "    const V *x, const V *u, const V *p, const V *by_c, const V *by_cc, V *g, V *H) {",
        f"    V e[{max(1, len(rows))}];",
        f"    tgco_{name}_slopes(x, u, p, e);",
    ]
    places = sorted(zip(rows, columns, range(len(rows)), strict=True))
    for row, column, i in places:
        code.append(f"    g[{column}] += e[{i}] * by_c[{row}];")
        for other, later, j in places:
            if other == row and later >= column:
                code.append(f"    H[{column} * (NX + NU) + {later}] += e[{i}] * by_cc[{row}] * e[{j}];")
    return {"code": "\n".join([*code, "}"])}
