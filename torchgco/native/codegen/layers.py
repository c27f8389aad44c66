"""C of a network: values, products with its Jacobian on either side, and second derivatives, layer by layer.

Of a problem at a time, by the loops of c/net.h; lanes with the same numbers are computed once. The functions,
with inputs z (k), tangents T (k, d) column by column and outputs o (r), are

    tgco_net_KEY(w, z, o)
    tgco_net_KEY_ahead(w, z, T, o, TO, kept)     and the tangents TO (r, d) of the outputs, column by column
    tgco_net_KEY_back(w, kept, y, v, H)          v (k) = J' y, and H = sum_i y_i (second derivatives of o_i along T),
                                                 its upper triangle, row by row
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

from torchgco.native.codegen import emit
from torchgco.tracing.nets import Linear, Net, Neurons


@dataclass(frozen=True)
class Derivatives:
    """Of a layer of neurons: slopes by each source, and curvatures by each pair of sources that has one."""

    slopes: list[Any]
    curvatures: dict[tuple[int, int], Any]


class NetSource:
    """C of a network whose inputs have `d` tangents; d = 0: of its values alone.

    `plain`: the tangents are the unit matrix, and NULL stands for them.
    """

    def __init__(self, net: Net, d: int, plain: bool = False) -> None:
        self.net, self.d, self.plain = net, d, plain
        self._even = d + d % 2  # columns of arrays of tangents: second derivatives are computed by pairs of them
        self._derived = [_derived(layer) if isinstance(layer, Neurons) else None for layer in net.layers]

    @cached_property
    def key(self) -> str:
        return hashlib.sha256(self._text.encode()).hexdigest()[:16]

    @property
    def kept_bytes(self) -> int:
        """What the point of a call takes on the stack, of eight problems side by side."""
        neurons = self._even * sum(self.net.sizes[i] for i in self._bent) if self.d else 0
        for i, layer in enumerate(self.net.layers, 1):
            if self.d and isinstance(layer, Neurons):
                neurons += len(self._places(i)) * layer.h
        return 8 * 8 * neurons

    @cached_property
    def code(self) -> str:
        """The functions, once in a file however often this text stands there."""
        guard = f"TGCO_NET_{self.key}"
        text = self._text.replace("KEY", self.key)
        return "\n".join(['#include "net.h"', f"#ifndef {guard}", f"#define {guard}", text, "#endif"])

    @cached_property
    def _text(self) -> str:
        parts = [*self._functions(), self._value()]
        parts += [self._structure(), self._forward(), self._backward(), _LANES_DERIVED] if self.d else [_LANES_VALUE]
        text, sizes = "\n".join(parts), {"K": self.net.k, "R": self.net.size, "D": self.d, "E": self._even}
        for name, value in sizes.items():
            text = text.replace(f"COUNT_{name}", str(value))
        return text

    # The function of a layer's neurons

    def _functions(self) -> list[str]:
        made = []
        for i, layer in enumerate(self.net.layers, 1):
            if isinstance(layer, Neurons):
                made.append(emit.emit(f"tgco_net_KEY_f{i}", layer.function))
                if self.d:
                    made.append(emit.emit(f"tgco_net_KEY_g{i}", self._with_derivatives(i)))
        return made

    def _with_derivatives(self, i: int) -> Any:
        import casadi as ca

        layer, derived = self.net.layers[i - 1], self._derived[i - 1]
        assert isinstance(layer, Neurons) and derived is not None
        symbols, form = _form(layer)
        entries = [form, *self._computed(derived.slopes), *derived.curvatures.values()]
        return ca.Function("derived", symbols, [ca.cse(ca.densify(ca.vertcat(*entries)))])

    @staticmethod
    def _computed(slopes: list[Any]) -> list[Any]:
        """Of the slopes those that aren't the same at every neuron."""
        return [slope for slope in slopes if not slope.is_constant()]

    def _neurons(self, i: int, derived: bool) -> list[str]:
        """The loop over the neurons of layer i, with their slopes and curvatures."""
        layer = self.net.layers[i - 1]
        assert isinstance(layer, Neurons)
        vectors = [f"    REAL w{j}[NET_SIZE({layer.h})]; net_weights(w + {offset}, {layer.h}, w{j});"
                   for j, offset in enumerate(layer.vectors)]  # fmt: skip
        operands = [f"net_lanes(a{j} + i)" for j in layer.sources]
        operands += [f"net_lanes(w{j} + i)" for j in range(len(layer.vectors))]
        operands += [f"SET(w[{offset}])" for offset in layer.singles]
        names = [f"e{j}" for j in range(len(operands))]
        targets = [f"a{i}", *(self._places(i) if derived else ())]
        lines = ["    {", *vectors, f"    for (int i = 0; i < NET_SIZE({layer.h}); i += LANES) {{"]
        lines += [f"        V {name}[1] = {{{value}}};" for name, value in zip(names, operands, strict=True)]
        lines.append(f"        V e[{len(targets)}];")
        lines.append(f"        tgco_net_KEY_{'g' if derived else 'f'}{i}({', '.join((*names, 'e'))});")
        lines += [f"        net_store({target} + i, e[{j}]);" for j, target in enumerate(targets)]
        return [*lines, "    }", "    }"]

    def _places(self, i: int) -> list[str]:
        """The arrays that keep slopes and curvatures of layer i, in the order in which they are computed."""
        derived = self._derived[i - 1]
        assert derived is not None
        slopes = [f"kept->d{i}_{j}" for j, slope in enumerate(derived.slopes) if not slope.is_constant()]
        return [*slopes, *(f"kept->c{i}_{a}_{b}" for a, b in derived.curvatures)]

    # One problem

    def _value(self) -> str:
        lines = ["static void tgco_net_KEY_one(const double *w, const REAL *a0, REAL *o) {"]
        for i, layer in enumerate(self.net.layers, 1):
            lines.append(f"    REAL a{i}[NET_SIZE({layer.h})];")
            lines += [_affine(i, layer)] if isinstance(layer, Linear) else self._neurons(i, False)
        return "\n".join([*lines, *self._copied("o"), "}"])

    def _copied(self, to: str) -> list[str]:
        lines, offset = [], 0
        for i in self.net.outputs:
            lines.append(f"    memcpy({to} + {offset}, a{i}, {self.net.sizes[i]} * sizeof(REAL));")
            offset += self.net.sizes[i]
        return lines

    @property
    def _bent(self) -> list[int]:
        """The layers whose tangents the second derivatives need."""
        bent = set()
        for layer, derived in zip(self.net.layers, self._derived, strict=True):
            if isinstance(layer, Neurons) and derived is not None:
                bent |= {layer.sources[j] for pair in derived.curvatures for j in pair}
        return sorted(bent)

    def _structure(self) -> str:
        arrays = [f"    REAL t{i}[{self._even} * NET_SIZE({self.net.sizes[i]})];" for i in self._bent]
        for i, layer in enumerate(self.net.layers, 1):
            if isinstance(layer, Neurons):
                names = [path.removeprefix("kept->") for path in self._places(i)]
                arrays += [f"    REAL {name}[NET_SIZE({layer.h})];" for name in names]
        return "\n".join(["typedef struct {", *arrays, "    int none;", "} tgco_net_KEY_point;"])

    def _forward(self) -> str:
        lines = ["static void tgco_net_KEY_ahead_one(", "    const double *w, const REAL *a0, const REAL *z0, REAL *o,"]
        lines.append("    REAL *to, tgco_net_KEY_point *kept) {")
        if 0 in self._bent:
            lines.append("    memcpy(kept->t0, z0, sizeof kept->t0);")
        lines.append("    const REAL *t0 = z0;")
        for i, layer in enumerate(self.net.layers, 1):
            size = f"{self._even} * NET_SIZE({layer.h})"
            lines.append(f"    REAL a{i}[NET_SIZE({layer.h})];")
            lines.append(f"    REAL *t{i} = kept->t{i};" if i in self._bent else f"    REAL t{i}[{size}];")
            if isinstance(layer, Linear):
                lines.append(_affine(i, layer))
                arguments = f"{_matrices(layer)}, {layer.k}, {layer.h}, {self.d}, t{layer.source}, t{i}"
                if self.plain and layer.source == 0:
                    row, to = f"w + {layer.matrix} + c * {layer.h}", f"t{i} + c * NET_SIZE({layer.h})"
                    lines.append(f"    for (int c = 0; c < {self.d}; c++) net_weights({row}, {layer.h}, {to});")
                else:
                    lines.append(f"    net_columns({arguments});")
            else:
                lines += [*self._neurons(i, True), self._tangents(i)]
        offset = 0
        for i in self.net.outputs:
            size = self.net.sizes[i]
            row, column = f"to + c * {self.net.size} + {offset}", f"t{i} + c * NET_SIZE({size})"
            lines.append(f"    for (int c = 0; c < {self.d}; c++) memcpy({row}, {column}, {size} * sizeof(REAL));")
            offset += size
        return "\n".join([*lines, *self._copied("o"), "}"])

    def _slope(self, i: int, j: int, index: str) -> str:
        """The slope of neuron `index` of layer i by its source j; empty: 1."""
        derived = self._derived[i - 1]
        assert derived is not None
        slope = derived.slopes[j]
        if not slope.is_constant():
            return f"kept->d{i}_{j}[{index}]"
        return "" if float(slope) == 1.0 else f"(REAL){emit.literal(float(slope))}"

    def _tangents(self, i: int) -> str:
        layer = self.net.layers[i - 1]
        assert isinstance(layer, Neurons)
        k = f"c * NET_SIZE({layer.h}) + i"
        slopes = [self._slope(i, j, "i") for j in range(len(layer.sources))]
        parts = [f"{slope}{' * ' if slope else ''}t{j}[{k}]" for slope, j in zip(slopes, layer.sources, strict=True)]
        total = " + ".join(parts)
        return f"    for (int c = 0; c < {self.d}; c++) for (int i = 0; i < {layer.h}; i++) t{i}[{k}] = {total or '0'};"

    def _backward(self) -> str:
        sizes = self.net.sizes
        lines = ["static void tgco_net_KEY_back_one(", "    const double *w, const tgco_net_KEY_point *kept,"]
        lines.append("    const REAL *y, REAL *v, REAL *H) {")
        lines += [f"    REAL v{i}[NET_SIZE({size})] = {{0}};" for i, size in enumerate(sizes)]
        offset = 0
        for i in self.net.outputs:
            lines.append(f"    for (int i = 0; i < {sizes[i]}; i++) v{i}[i] += y[{offset} + i];")
            offset += sizes[i]
        for i in range(len(self.net.layers), 0, -1):
            layer = self.net.layers[i - 1]
            if isinstance(layer, Linear):
                arguments = f"{_matrices(layer)}, {layer.k}, {layer.h}, v{i}, v{layer.source}"
                lines.append(f"    {{ REAL s[NET_SIZE({layer.k})]; net_back({arguments}, s); }}")
            else:
                lines += self._bend(i, layer)
        lines.append(f"    memcpy(v, v0, {sizes[0]} * sizeof(REAL));")
        return "\n".join([*lines, "}"])

    def _bend(self, i: int, layer: Neurons) -> list[str]:
        derived, lines = self._derived[i - 1], []
        assert derived is not None
        for a, b in derived.curvatures:
            lines.append(f"    {{ REAL by[{layer.h}];")
            factor = f"net_counted(v{i}[i], kept->c{i}_{a}_{b}[i])"
            lines.append(f"    for (int i = 0; i < {layer.h}; i++) by[i] = {factor};")
            for p, q in sorted({(a, b), (b, a)}):
                s, t = layer.sources[p], layer.sources[q]
                lines.append(f"    net_congruence({layer.h}, {self.d}, by, kept->t{s}, kept->t{t}, H);")
            lines.append("    }")
        for j, source in enumerate(layer.sources):
            term = f"net_counted(v{i}[i], {self._slope(i, j, 'i') or '1'})"
            lines.append(f"    for (int i = 0; i < {layer.h}; i++) v{source}[i] += {term};")
        return lines


def _affine(i: int, layer: Linear) -> str:
    bias = "0" if layer.bias is None else f"w + {layer.bias}"
    return f"    net_affine({_matrices(layer)}, {bias}, {layer.k}, {layer.h}, a{layer.source}, a{i});"


def _matrices(layer: Linear) -> str:
    return f"w + {layer.matrix}, w + {layer.turned}"


def _form(layer: Neurons) -> tuple[list[Any], Any]:
    """The symbols that a neuron is a function of, none where it is a constant, and its expression."""
    import casadi as ca

    symbols = layer.function.sx_in()
    return symbols, ca.SX(layer.function.call(symbols)[0])


def _derived(layer: Neurons) -> Derivatives:
    import casadi as ca

    symbols, form = _form(layer)
    sources, forward = symbols[: len(layer.sources)], {"allow_reverse": False}
    # Forward mode only: in reverse mode, a NaN of the branch not taken would come through as 0 * NaN.
    slopes = [ca.densify(ca.jacobian(form, source, forward)) for source in sources]
    curvatures = {}
    for a, b in combinations_with_replacement(range(len(sources)), 2):
        entry = ca.jacobian(slopes[a], sources[b], forward)
        if entry.nnz() and not entry.is_zero():
            curvatures[a, b] = entry
    return Derivatives(slopes, curvatures)


_LANES_VALUE = """
TGCO_APART void tgco_net_KEY(const double *w, const V *z, V *o) {
    for (I left = SET(0.0) == SET(0.0), same; tgco_any(left); left &= NOT(same)) {
        int l = net_first(left);
        REAL a[NET_SIZE(COUNT_K)], out[COUNT_R];
        same = left;
        for (int i = 0; i < COUNT_K; i++) { same &= net_alike(z[i], l); a[i] = LANE(z[i], l); }
        tgco_net_KEY_one(w, a, out);
        for (int i = 0; i < COUNT_R; i++) o[i] = tgco_choose(same, SET(out[i]), o[i]);
    }
}"""

_LANES_DERIVED = """
typedef struct { V of[1]; tgco_net_KEY_point at[LANES]; } tgco_net_KEY_kept;
TGCO_APART void tgco_net_KEY_ahead(
    const double *w, const V *z, const V *T, V *o, V *to, tgco_net_KEY_kept *kept) {
    for (I left = SET(0.0) == SET(0.0), same; tgco_any(left); left &= NOT(same)) {
        int l = net_first(left);
        REAL a[NET_SIZE(COUNT_K)], t[COUNT_E * NET_SIZE(COUNT_K)], out[COUNT_R], made[COUNT_D * COUNT_R];
        same = left;
        for (int i = 0; i < COUNT_K; i++) { same &= net_alike(z[i], l); a[i] = LANE(z[i], l); }
        for (int c = 0; c < COUNT_D; c++) for (int i = 0; i < COUNT_K; i++) {
            if (T) same &= net_alike(T[c * COUNT_K + i], l);
            t[c * NET_SIZE(COUNT_K) + i] = T ? LANE(T[c * COUNT_K + i], l) : i == c;
        }
        tgco_net_KEY_ahead_one(w, a, t, out, made, kept->at + l);
        kept->of[0] = tgco_choose(same, SET(l), kept->of[0]);
        for (int i = 0; i < COUNT_R; i++) o[i] = tgco_choose(same, SET(out[i]), o[i]);
        for (int i = 0; i < COUNT_D * COUNT_R; i++) to[i] = tgco_choose(same, SET(made[i]), to[i]);
    }
}
TGCO_APART void tgco_net_KEY_back(
    const double *w, const tgco_net_KEY_kept *kept, const V *y, V *v, V *H) {
    for (I left = SET(0.0) == SET(0.0), same; tgco_any(left); left &= NOT(same)) {
        int l = net_first(left), at = (int)LANE(kept->of[0], l);
        REAL b[COUNT_R], out[COUNT_K] = {0}, made[COUNT_E * COUNT_E] = {0};
        int counts = 0; /* all is 0 where y is, be the network's derivatives NaN: of a branch that isn't taken */
        same = left & (kept->of[0] == SET(at));
        for (int i = 0; i < COUNT_R; i++) { same &= net_alike(y[i], l); b[i] = LANE(y[i], l); counts |= b[i] != 0; }
        if (counts) tgco_net_KEY_back_one(w, kept->at + at, b, out, made);
        for (int i = 0; i < COUNT_K; i++) v[i] = tgco_choose(same, SET(out[i]), v[i]);
        for (int p = 0, e = 0; p < COUNT_D; p++) for (int q = p; q < COUNT_D; q++, e++)
            H[e] = tgco_choose(same, SET(made[p * COUNT_E + q]), H[e]);
    }
}"""
