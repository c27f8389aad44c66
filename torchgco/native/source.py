"""The C file of a form of problems: its model, products with the sparse Jacobian, its functions, and the solver."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from torchgco.native.emit import PRELUDE, literal
from torchgco.native.model import DynamicsSource
from torchgco.native.rows import RowsSource

LANES = 8
SOLVER = Path(__file__).with_name("ilqr.c")


@dataclass(frozen=True)
class Form:
    """What the code of a problem depends on; two problems of one form share a library."""

    dynamics: DynamicsSource
    position: slice | None
    dense: bool  # weights are matrices
    functions: tuple[tuple[int, RowsSource], ...]  # the constraints given as functions, by their place

    def source(self) -> str:
        """The C file."""
        model, at = self.dynamics, self.position
        defines = {
            "REAL": "double", "LANES": LANES, "NX": model.n, "NU": model.m, "NP": model.count, "NJ": model.computed,
            "DIM": 0 if at is None else at.stop - at.start, "POSITION": 0 if at is None else at.start,
            "QUADRATIC_FULL": int(self.dense), "MAX_ROWS": max([1, *(rows.p for _, rows in self.functions)]),
        }  # fmt: skip
        head = "".join(f"#define {name} {value}\n" for name, value in defines.items())
        functions = [rows.code for _, rows in self.functions]
        parts = (head, PRELUDE, model.code, _products(model), *functions, _switches(self.functions), SOLVER.read_text())
        return "\n".join(parts)


def _products(model: DynamicsSource) -> str:
    """The products of a value function with F = [fx fu], which name its nonzeros alone."""
    by_column: list[list[tuple[int, str]]] = [[] for _ in range(model.n + model.m)]
    for row, column, place, value in zip(model.rows, model.columns, model.places, model.values, strict=True):
        factor = f"f[{place}] * " if place >= 0 else "" if value == 1.0 else f"SET({literal(value)}) * "
        by_column[column].append((row, factor))

    def total(entries: list[tuple[int, str]], source: str) -> str:
        return " + ".join(factor + source.format(row) for row, factor in entries) or "SET(0.0)"

    columns = range(len(by_column))
    gather = [f"        T[{c} * NX + r] = {total(by_column[c], 'p[{} * NX]')};" for c in columns]
    product = [
        f"    for (int l = {c}; l < NX + NU; l++) H[{c} * (NX + NU) + l] = {total(by_column[c], 'T[l * NX + {}]')};"
        for c in columns
    ]
    pull_back = [f"    g[{c}] = {total(by_column[c], 'p[{}]')};" for c in columns]
    return "\n".join(
        [
            "static inline void tgco_gather(const V *restrict P, const V *restrict f, V *restrict T) {",
            "    for (int r = 0; r < NX; r++) {", "        const V *p = P + r;", *gather, "    }", "}",
            "static inline void tgco_product(const V *restrict f, const V *restrict T, V *restrict H) {", *product, "}",
            "static inline void tgco_pull_back(const V *restrict p, const V *restrict f, V *restrict g) {",
            *pull_back, "}",
        ]
    )  # fmt: skip


def _switches(functions: Iterable[tuple[int, RowsSource]]) -> str:
    """`tgco_rows` and `tgco_add_rows`, which call the functions of a constraint by its place."""
    values, adds = [], []
    for i, rows in functions:
        values.append(f"    case {i}: tgco_{rows.key}_rows(x, u, c); break;")
        adds.append(f"    case {i}: tgco_{rows.key}_add(x, u, by_c, by_cc, g, H); break;")
    return "\n".join(
        [
            "static inline void tgco_rows(int i, const V *x, const V *u, V *c) {", "    switch (i) {", *values,
            "    }", "}",
            "static inline void tgco_add_rows(",
            "    int i, const V *x, const V *u, const V *by_c, const V *by_cc, V *g, V *H) {",
            "    switch (i) {", *adds, "    }", "}",
        ]
    )  # fmt: skip
