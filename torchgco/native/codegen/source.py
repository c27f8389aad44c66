"""The units of C that a library for a form of problems is linked from: the form's own, with its model, products with
the sparse Jacobian and its functions, and those of the solver, which are compiled once for all forms.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchgco.native.codegen.cost import CostSource
from torchgco.native.codegen.curvature import curvature_code
from torchgco.native.codegen.dynamics import DynamicsSource
from torchgco.native.codegen.emit import literal, switch, whole
from torchgco.native.codegen.knot import KnotSource
from torchgco.native.compiler import Unit, lanes, neurons
from torchgco.native.declarations import defines
from torchgco.native.includes import included, joined
from torchgco.native.structures import HEADER, constants

LANES = lanes()
FEW_LANES = 2, 4  # lanes of libraries for few problems: lanes without a problem take time, too
LIBRARIES_KEPT = 64  # libraries, the most recent ones
WRITTEN_OUT = 400  # nonzeros of a Jacobian, at most, that are written out one by one
OFFERED = "TGCO_BETWEEN_UNITS"  # of functions that other units call
LOOPS = """
static inline V entry(int e, IN f) { return F_place[e] < 0 ? SET(F_value[e]) : f[F_place[e]]; }
static void tgco_gather(IN ALONE P, IN ALONE f, OUT ALONE T) {
    for (int i = 0; i < NX * (NX + NU); i++) T[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) {
        V a = entry(e, f);
        OUT to = T + F_column[e] * NX;
        IN from = P + F_row[e] * NX;
        for (int r = 0; r < NX; r++) ADD(to[r], a, from[r]);
    }
}
static void tgco_product(IN ALONE f, IN ALONE T, OUT ALONE H) {
    for (int i = 0; i < (NX + NU) * (NX + NU); i++) H[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) {
        int c = F_column[e];
        V a = entry(e, f);
        for (int l = c; l < NX + NU; l++) ADD(H[c * (NX + NU) + l], a, T[l * NX + F_row[e]]);
    }
}
static void tgco_pull_back(IN ALONE p, IN ALONE f, OUT ALONE g) {
    for (int i = 0; i < NX + NU; i++) g[i] = SET(0.0);
    for (int e = 0; e < COUNT; e++) ADD(g[F_column[e]], entry(e, f), p[F_row[e]]);
}
"""


def lanes_for(B: int, least: int = 1) -> int:
    """How many lanes a library has that solves B problems, all in all, of which one makes use of `least`."""
    return next((lanes for lanes in FEW_LANES if max(B, least) <= lanes < LANES), LANES)


@dataclass(frozen=True)
class Library:
    """What a library is linked from beside a form's own code: files of C, each with those that it includes.

    Attributes:
        model: files that are compiled with the model. They take the numbers of states and controls as constants: their
            loops are short, and take up to a quarter longer otherwise.
        curvature: the same of the unit with second derivatives; none: there is no such unit.
        shared: files that read these numbers from the model, so that one object serves all models.
    """

    model: tuple[str, ...]
    curvature: tuple[str, ...]
    shared: tuple[str, ...]


PASS_SOURCES = "model.c", "passes.c"
SOLVER_LIBRARY = Library(PASS_SOURCES, (), ("trajectories.c", "outer.c", "verdict.c"))
SAMPLER = Library(("model.c",), (), ("mppi.c",))
# The model's unit is that of SOLVER_LIBRARY: it is compiled once for both.
INTERIOR = Library(PASS_SOURCES, ("riccati.c",), ("interior.c", "interior_kkt.c"))
# The same where Python computes the functions.
CALLED = Library(("called.c",), INTERIOR.curvature, INTERIOR.shared)
# Sizes that the model's unit defines for the others.
SIZES = {name: f"tgco_{name.lower()}" for name in ("NX", "NU", "NP", "NJ", "MAX_ROWS")}
SIZES_DEFINED = f"const int {', '.join(f'{name} = {size}' for size, name in SIZES.items())};\n"
SIZES_DECLARED = f'extern __attribute__((visibility("hidden"))) const int {", ".join(SIZES.values())};\n'


_units: dict[tuple[Any, ...], tuple[Unit, ...]] = {}  # reading and joining files takes longer than a small solve


@dataclass(frozen=True)
class Form:
    """Everything that a problem's code depends on; two problems of one form share a library."""

    dynamics: DynamicsSource
    position: slice | None
    cost: CostSource | None  # None: quadratic
    dense: bool  # the quadratic cost's weights are matrices
    functions: tuple[tuple[int, KnotSource], ...]  # the constraints that are traced, by their place
    lifted: frozenset[int] = frozenset()  # those of which the places of a body's balls are traced

    def units(self, library: Library = SOLVER_LIBRARY, real: str = "double", lanes: int = LANES) -> tuple[Unit, ...]:
        """The units of a library, for numbers of type `real`."""
        key = (*self._key, library, real, lanes)
        if key not in _units:
            _units[key] = self._written(library, {"REAL": real, "LANES": lanes})
            if len(_units) > LIBRARIES_KEPT:
                del _units[next(iter(_units))]
        return _units[key]

    @property
    def _key(self) -> tuple[Any, ...]:
        p = self.position
        cost = None if self.cost is None else (self.cost.stage.key, self.cost.last.key)
        functions = tuple((i, rows.key) for i, rows in self.functions)
        return self.dynamics.key, p and (p.start, p.stop), cost, self.dense, functions, tuple(sorted(self.lifted))

    def alone(self, files: Sequence[str], given: Mapping[str, str], declared: str = "", **constants_of: Any) -> str:
        """C of a single lane that needs no other unit.

        Args:
            files: of C, beside those of the model and its cost.
            given: texts that stand for vectors.h and others, by their names.
            declared: what comes after the structures.
            constants_of: macros, such as the type REAL or KINDS, the bits of the kinds of rows that there are.
        """
        generated = self._model_code()
        if "riccati.c" in files:
            generated.append(curvature_code(self.dynamics, self.functions))
        texts = {"constants.h": constants(), "code.h": whole("\n".join(generated))}
        kept = {"NET_WIDTH": neurons(), "REAL": "double", "LANES": 1} | constants_of
        sizes = kept | self._sizes | _space(self.position)
        sizes["MAX_ROWS"] = max(sizes["MAX_ROWS"], sizes["DIM"])  # of places of balls, be there none
        files = "model.c", self._cost_file, *files
        text = defines(sizes) + included("structures.h") + declared + included(*files)
        return joined(text, given=texts | dict(given))

    @property
    def _sizes(self) -> dict[str, Any]:
        model = self.dynamics
        return {
            "NX": model.n, "NU": model.m, "NP": model.count, "NJ": model.computed,
            "MAX_ROWS": max([1, *(rows.size for _, rows in self.functions)]), "QUADRATIC_FULL": int(self.dense),
        }  # fmt: skip

    @property
    def _cost_file(self) -> str:
        return "quadratic.c" if self.cost is None else "traced.c"

    def _written(self, library: Library, vectors: dict[str, Any]) -> tuple[Unit, ...]:
        model, sizes = self.dynamics, vectors | self._sizes
        text = _text(sizes, self._model_code(), self._cost_file, *library.model) + SIZES_DEFINED
        units = [Unit(text, own=True)]
        if library.curvature:
            generated = [curvature_code(model, self.functions), _products(model)]
            units.append(Unit(_text(sizes, generated, *library.curvature), own=True))
        return (*units, _shared_unit(vectors, self.position, library))

    def _model_code(self) -> list[str]:
        generated = [self.dynamics.code, _products(self.dynamics), "" if self.cost is None else self.cost.code]
        code = dict.fromkeys(rows.code for _, rows in self.functions)
        return [*generated, *code, _switches(self.functions, self.lifted)]


@dataclass(frozen=True)
class CalledForm:
    """What the code of a problem depends on of which Python computes the functions: sizes."""

    n: int
    m: int
    rows: int  # of a function at a knot, at most
    position: slice | None  # that obstacles which C knows read
    dense: bool | None  # of a quadratic cost, whether its weights are matrices; None: Python computes the cost

    def units(self, lanes: int) -> tuple[Unit, ...]:
        """The units of `CALLED`."""
        n, S = self.n, self.n + self.m
        sizes = {
            "NX": n, "NU": self.m, "NP": n + n * S + S * S, "NJ": n * S, "MAX_ROWS": max(1, self.rows),
            "QUADRATIC_FULL": int(bool(self.dense)),
        }  # fmt: skip
        vectors, dense = {"REAL": "double", "LANES": lanes}, [included("dense.h")]
        cost = "called_cost.c" if self.dense is None else "quadratic.c"
        model, curvature = (_text(vectors | sizes, dense, *own) for own in ((cost, *CALLED.model), CALLED.curvature))
        units = Unit(model + SIZES_DEFINED, own=True), Unit(curvature, own=True)
        return (*units, _shared_unit(vectors, self.position, CALLED))


def _text(sizes: dict[str, Any], generated: list[str], *files: str) -> str:
    """The C file of a unit."""
    headers = {"constants.h": constants(), "code.h": "\n".join(generated)}
    return joined(defines(sizes) + included(*files), given=headers) + HEADER.layout


def _shared_unit(vectors: dict[str, Any], at: slice | None, library: Library) -> Unit:
    """The unit that reads sizes from the model."""
    return Unit(SIZES_DECLARED + _text(vectors | SIZES | _space(at), [], *library.shared))


def _space(at: slice | None) -> dict[str, int]:
    """Where the position is among the states."""
    return {"DIM": 0, "POSITION": 0} if at is None else {"DIM": at.stop - at.start, "POSITION": at.start}


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
    for row, column, index, value in zip(model.rows, model.columns, model.places, model.values, strict=True):
        factor = f"f[{index}]" if index >= 0 else "" if value == 1.0 else f"SET({literal(value)})"
        by_column[column].append((row, factor))

    def total(entries: list[tuple[int, str]], source: str) -> str:
        text = ""
        for row, factor in entries:
            each = source.format(row)
            if text:
                text = f"tgco_fused({factor}, {each}, {text})" if factor else f"{text} + {each}"
            else:
                text = f"{factor} * {each}" if factor else each
        return text or "SET(0.0)"

    columns = range(len(by_column))
    gather = [f"        T[{c} * NX + r] = {total(by_column[c], 'p[{} * NX]')};" for c in columns]
    product = [
        f"    for (int l = {c}; l < NX + NU; l++) H[{c} * (NX + NU) + l] = {total(by_column[c], 'T[l * NX + {}]')};"
        for c in columns
    ]
    pull_back = [f"    g[{c}] = {total(by_column[c], 'p[{}]')};" for c in columns]
    return "\n".join(
        [
            "static inline void tgco_gather(IN ALONE P, IN ALONE f, OUT ALONE T) {",
            "    for (int r = 0; r < NX; r++) {", "        IN p = P + r;", *gather, "    }", "}",
            "static inline void tgco_product(IN ALONE f, IN ALONE T, OUT ALONE H) {", *product, "}",
            "static inline void tgco_pull_back(IN ALONE p, IN ALONE f, OUT ALONE g) {",
            *pull_back, "}",
        ]
    )  # fmt: skip


def _switches(functions: Iterable[tuple[int, KnotSource]], lifted: Container[int]) -> str:
    """`model_rows`, `model_add_rows` and `model_slopes`, which call the functions of a constraint by its place."""
    values, adds, slopes = [], [], []
    for i, rows in functions:
        name = f"tgco_{rows.key}"
        values.append(f"    case {i}: {name}_rows(x, u, p, w, c); break;")
        if i in lifted:
            slopes.append(f"    case {i}: {name}_slopes(x, u, p, w, e);")
            slopes.append(f"        *columns = {name}_columns; return {name}_count;")
        else:
            adds.append(f"    case {i}: {name}_add(x, u, p, w, by_c, by_cc, g, H); break;")
    arguments = "int i, IN x, IN u, IN p, const double *w"
    return "\n".join(
        (
            switch(f"{OFFERED} void model_rows({arguments}, OUT c)", values),
            switch(f"{OFFERED} void model_add_rows(\n    {arguments}, IN by_c, IN by_cc,\n    OUT g, OUT H)", adds),
            switch(
                f"{OFFERED} int model_slopes(\n    {arguments}, OUT e, const int **columns)", slopes, "    return 0;"
            ),
        )
    )
