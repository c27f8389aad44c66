"""The C file of a form of problems: its model, products with the sparse Jacobian, its functions, and the solver."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchgco.native.codegen.cost import CostSource
from torchgco.native.codegen.dynamics import DynamicsSource
from torchgco.native.codegen.emit import PRELUDE, literal
from torchgco.native.codegen.knot import KnotSource
from torchgco.native.compiler import lanes
from torchgco.native.declarations import defines, head
from torchgco.native.structures import CONSTANTS, COST_ARRAYS, ENUMERATIONS, STRUCTURES, Quadratic, TracedCost

C = Path(__file__).parents[1] / "c"
LANES = lanes()
KEPT = 64  # texts, the most recent ones
WRITTEN_OUT = 400  # nonzeros of a Jacobian, at most, that are written out one by one
LOOPS = """
static inline V entry(int e, const V *f) { return F_place[e] < 0 ? SET(F_value[e]) : f[F_place[e]]; }
static void tgco_gather(const V *restrict P, const V *restrict f, V *restrict T) {
    for (int i = 0; i < NX * (NX + NU); i++) T[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) {
        V a = entry(e, f), *to = T + F_column[e] * NX;
        const V *from = P + F_row[e] * NX;
        for (int r = 0; r < NX; r++) to[r] += a * from[r];
    }
}
static void tgco_product(const V *restrict f, const V *restrict T, V *restrict H) {
    for (int i = 0; i < (NX + NU) * (NX + NU); i++) H[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) {
        int c = F_column[e];
        V a = entry(e, f);
        for (int l = c; l < NX + NU; l++) H[c * (NX + NU) + l] += a * T[l * NX + F_row[e]];
    }
}
static void tgco_pull_back(const V *restrict p, const V *restrict f, V *restrict g) {
    for (int i = 0; i < NX + NU; i++) g[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) g[F_column[e]] += entry(e, f) * p[F_row[e]];
}
"""
COST = "quadratic.c"  # or traced.c
BOXES, FIELDS = ("box.h", "boxes.c"), ("field.c",)  # left out where there are no boxes, or no maps
TERMS = ("problem.c", COST, "penalty.c", *BOXES, *FIELDS, "knot.c")
SOLVER = (*TERMS, "cholesky.h", "passes.c", "ilqr.c", "trajectories.c", "outer.c")
SAMPLER = (*TERMS, "normal.c", "mppi.c")
PHASES = "_rows", "_step", "_memory", "_fixed", "_search", ""
INTERIOR = (*TERMS, "cholesky.h", *(f"interior{phase}.c" for phase in PHASES))


_sources: dict[tuple[Any, ...], str] = {}  # reading and joining the files takes longer than a small solve


@dataclass(frozen=True)
class Form:
    """Everything that a problem's code depends on; two problems of one form share a library."""

    dynamics: DynamicsSource
    position: slice | None
    cost: CostSource | None  # None: quadratic
    dense: bool  # the quadratic cost's weights are matrices
    functions: tuple[tuple[int, KnotSource], ...]  # the constraints that are traced, by their place
    boxes: bool = False  # whether there are boxes among the obstacles
    fields: bool = False  # the same of maps

    def source(self, parts: tuple[str, ...] = SOLVER, real: str = "double", lanes: int = LANES, more: str = "") -> str:
        """The C file of one of the solvers or the sampler, for numbers of type `real`; `more` is generated code."""
        key = (*self._key, parts, real, lanes, more)
        if key not in _sources:
            _sources[key] = self._written(parts, real, lanes, more)
            if len(_sources) > KEPT:
                del _sources[next(iter(_sources))]
        return _sources[key]

    @property
    def _key(self) -> tuple[Any, ...]:
        at = self.position
        cost = None if self.cost is None else (self.cost.stage.key, self.cost.last.key)
        functions = tuple((i, rows.key) for i, rows in self.functions)
        return self.dynamics.key, at and (at.start, at.stop), cost, self.dense, functions, self.boxes, self.fields

    def _written(self, parts: tuple[str, ...], real: str, lanes: int, more: str) -> str:
        model, at = self.dynamics, self.position
        sizes = {
            "REAL": real, "LANES": lanes, "NX": model.n, "NU": model.m, "NP": model.count, "NJ": model.computed,
            "DIM": 0 if at is None else at.stop - at.start, "POSITION": 0 if at is None else at.start,
            "QUADRATIC_FULL": int(self.dense), "WITH_BOXES": int(self.boxes), "WITH_FIELDS": int(self.fields),
            "COST_ARRAYS": COST_ARRAYS,
            "MAX_ROWS": max([1, *(rows.size for _, rows in self.functions)]),
        }  # fmt: skip
        cost = Quadratic if self.cost is None else TracedCost
        shared = head(STRUCTURES, (*ENUMERATIONS, cost), CONSTANTS)
        generated = [model.code, _products(model), "" if self.cost is None else self.cost.code]
        generated += [*dict.fromkeys(rows.code for _, rows in self.functions), _switches(self.functions)]
        generated += [more] if more else []
        # Without boxes or maps their code is left out, so that it can't change how the rest is compiled.
        absent = (*(() if self.boxes else BOXES), *(() if self.fields else FIELDS))
        names = [name for name in parts if name not in absent]
        names = ["traced.c" if name == COST and self.cost is not None else name for name in names]
        return "\n".join((defines(sizes), shared, PRELUDE, *generated, *((C / name).read_text() for name in names)))


def _products(model: DynamicsSource) -> str:
    """The products of a value function with F = [fx fu], over the nonzeros of F alone."""
    return _looped(model) if len(model.rows) > WRITTEN_OUT else _written_out(model)


def _looped(model: DynamicsSource) -> str:
    """Loops over a table of the nonzeros: code that writes out many of them would take long to compile."""
    tables = {"row": model.rows, "column": model.columns, "place": model.places}
    lines = [f"static const int F_{name}[] = {{{', '.join(map(str, values))}}};" for name, values in tables.items()]
    lines += [f"static const double F_value[] = {{{', '.join(map(literal, model.values))}}};", LOOPS]
    return "\n".join(lines).replace("COUNT", str(len(model.rows)))


def _written_out(model: DynamicsSource) -> str:
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


def _switches(functions: Iterable[tuple[int, KnotSource]]) -> str:
    """`tgco_rows` and `tgco_add_rows`, which call the functions of a constraint by its place."""
    values, adds = [], []
    for i, rows in functions:
        values.append(f"    case {i}: tgco_{rows.key}_rows(x, u, p, w, c); break;")
        adds.append(f"    case {i}: tgco_{rows.key}_add(x, u, p, w, by_c, by_cc, g, H); break;")
    return "\n".join(
        [
            "static inline void tgco_rows(int i, const V *x, const V *u, const V *p, const double *w, V *c) {",
            "    switch (i) {", *values, "    }", "}",
            "static inline void tgco_add_rows(",
            "    int i, const V *x, const V *u, const V *p, const double *w, const V *by_c, const V *by_cc,",
            "    V *g, V *H) {",
            "    switch (i) {", *adds, "    }", "}",
        ]
    )  # fmt: skip
