"""Networks in a recorded function: layers of products with shared matrices, and functions of each neuron.

Replayed by scalars a layer of h by h weights is h^2 operations, and its derivatives are many times as many. A network
stays whole instead: a `Call` stands for it in the expressions, with symbols for its outputs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from torchgco.tracing.arrays import boxed
from torchgco.tracing.dtypes import replay
from torchgco.tracing.operations import to_single
from torchgco.tracing.recorder import Operation, Slot, name_of

LEAST_NET = 128  # entries of all matrices of a network: below, code of scalars is faster
MOST_WEIGHTS = 300_000  # of all networks of a function: beyond, PyTorch's products of whole batches are faster
LINE = 8  # numbers of a line of the cache
PRODUCTS = ("aten.addmm", "aten.mm")
# Operations that keep the rows and neurons of an array, whatever they make of its shape.
RESHAPES = ("view", "reshape", "_unsafe_view", "unsqueeze", "squeeze", "expand", "clone", "alias", "detach", "_to_copy")
LINEAR = ("add", "sub", "rsub", "neg", "full_like", "zeros_like", "ones_like")
CURVED = (
    "mul", "div", "reciprocal", "pow", "square", "sqrt", "rsqrt", "abs", "sign", "sin", "cos", "tan", "asin", "acos",
    "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "expm1", "log", "log1p", "erf", "sinc", "sigmoid",
    "elu", "log_sigmoid_forward", "relu", "leaky_relu", "softplus", "gelu", "where", "clamp", "clamp_min", "clamp_max",
    "hardtanh", "maximum", "minimum", "lt", "le", "gt", "ge", "eq", "ne", "logical_and", "logical_or", "logical_not",
)  # fmt: skip
KEEPS = {f"aten.{name}" for name in RESHAPES} | {"prims.convert_element_type"}
NEURONWISE = {f"aten.{name}" for name in (*LINEAR, *CURVED)}


@dataclass(frozen=True)
class Linear:
    """A layer y = b + M' a, for a of an earlier layer; layer 0 is the network's input.

    M (k, h) and b (h) lie at these places among the shared numbers, the transpose of M at `turned`.
    """

    source: int
    k: int
    h: int
    matrix: int
    turned: int
    bias: int | None


@dataclass(frozen=True)
class Neurons:
    """A layer whose neuron i is a function of neurons i of earlier layers, of entries i of vectors of weights, and of
    single weights.

    `function` is CasADi's, of one scalar each. Vectors and single weights lie at these places among the shared numbers.
    """

    sources: tuple[int, ...]
    vectors: tuple[int, ...]
    singles: tuple[int, ...]
    h: int
    function: Any = field(compare=False)


@dataclass(frozen=True)
class Net:
    """Layers 1, 2, ... of a network with k inputs, and which layers are its outputs, one after another."""

    k: int
    layers: tuple[Linear | Neurons, ...]
    outputs: tuple[int, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Neurons of all layers, the input's first."""
        return self.k, *(layer.h for layer in self.layers)

    @property
    def size(self) -> int:
        """Number of outputs."""
        return sum(self.sizes[i] for i in self.outputs)


@dataclass(frozen=True)
class Call:
    """A network at one point: CasADi's columns of its inputs (k), expressions, and of its outputs, symbols.

    In its place may be the root of an equation, `tracing.roots.Root`.
    """

    net: Any
    inputs: Any
    outputs: Any


@dataclass(eq=False)
class Part:
    """The operations of a network in a recording: of the rows of one array, each row by itself."""

    source: Slot
    k: int
    rows: int
    operations: list[Operation] = field(default_factory=list)
    widths: dict[Slot, int] = field(default_factory=dict)  # of what the operations make: its neurons
    outputs: list[Slot] = field(default_factory=list)  # what others read
    vectors: list[Slot] = field(default_factory=list)  # weights that are read neuron by neuron, and biases
    matrices: list[Slot] = field(default_factory=list)

    @property
    def weights(self) -> list[Slot]:
        return [*self.vectors, *self.matrices]


class Nets:
    """The networks among the operations that depend on a function's variables.

    Args:
        operations: in order.
        shapes: of all slots.
        shared: numbers that all problems share.
        result: of the function.
    """

    def __init__(
        self,
        operations: Sequence[Operation],
        shapes: Mapping[Slot, tuple[int, ...]],
        shared: Sequence[Slot],
        result: Slot,
    ) -> None:
        search = _Search(shapes, set(shared))
        for operation in operations:
            search.take(operation)
        parts = [net for net in search.parts if _is_worth_it(net, shapes)]
        self._part = {id(operation): net for net in parts for operation in net.operations}
        read = {slot for op in operations if id(op) not in self._part for slot in op.inputs}
        read |= {result, *(net.source for net in parts)}
        for net in parts:
            net.outputs = [slot for slot in net.widths if slot in read]
        self._matrices = list(dict.fromkeys(slot for net in parts for slot in net.matrices))
        weights = dict.fromkeys(slot for net in parts for slot in net.vectors)
        self._weights = [*weights, *(slot for slot in self._matrices if slot not in weights)]
        self.shapes = {slot: shapes[slot] for slot in self._weights}
        self.alone = {slot for slot in self._weights if slot not in read}  # weights that only networks read
        self._shapes = {slot: shapes[slot] for net in parts for slot in (*net.widths, *net.weights, net.source)}

    @property
    def size(self) -> int:
        """Entries of all matrices."""
        return sum(math.prod(self.shapes[slot]) for slot in self._matrices)

    def numbers(self, known: Mapping[Slot, torch.Tensor], first: int) -> torch.Tensor:
        """The weights (w,) float64, and after them the transposes of matrices, whose places C knows.

        `first` is their place among all shared numbers.
        """
        places, end = self._places(first)
        numbers = torch.zeros(end - first, dtype=torch.float64, device="cpu")
        for (slot, turned), start in places.items():
            value = known[slot].detach().to_dense()
            entries = numbers[start - first :][: value.numel()]
            entries.copy_((value.T if turned else value).reshape(-1))
        return numbers

    def steps(self, operations: Sequence[Operation], whole: bool) -> Iterator[tuple[Part | None, Operation]]:
        """Operations in order; if networks stay whole, each with the first of its operations, without the others."""
        begun = set()
        for operation in operations:
            net = self._part.get(id(operation)) if whole else None
            if net is None or id(net) not in begun:
                yield net, operation
            begun.add(id(net))

    def call(self, part: Part, known: dict[Slot, Any], first: int, precision: torch.dtype, calls: list[Call]) -> None:
        """Add a network's calls to `calls`, one a row, and its outputs, symbols, to `known`.

        Args:
            first: the place of `numbers` among all shared numbers.
            precision: of the variables.

        Raises:
            NoCounterpart: an operation that CasADi has none for with these arguments.
        """
        import casadi as ca

        net = _Layers(part, self._shapes, self._places(first)[0], precision).net()
        inputs, made = np.asarray(known[part.source]).reshape(part.rows, part.k), []
        for row in inputs:
            outputs = ca.SX.sym("o", net.size)
            calls.append(Call(net, ca.densify(ca.SX(ca.vertcat(*row))), outputs))
            made.append([outputs[i] for i in range(net.size)])
        place = 0
        for slot in part.outputs:
            width, array = part.widths[slot], np.empty((part.rows, part.widths[slot]), dtype=object)
            for r, row in enumerate(made):
                array[r, :] = row[place : place + width]
            known[slot], place = array.reshape(self._shapes[slot]), place + width

    def _places(self, first: int) -> tuple[dict[tuple[Slot, bool], int], int]:
        """Where weights (False) and transposes (True) lie among the shared numbers, and where they end.

        Each begins a line of the cache, which loads of whole vectors then don't cross.
        """
        places, start = {}, first
        for slot, turned in (*((slot, False) for slot in self._weights), *((slot, True) for slot in self._matrices)):
            start = -(-start // LINE) * LINE
            places[slot, turned] = start
            start += math.prod(self.shapes[slot])
        return places, start


def _is_worth_it(net: Part, shapes: Mapping[Slot, tuple[int, ...]]) -> bool:
    """Whether there are enough weights, and a function that isn't linear: linear systems keep zeros and ones."""
    curved = any(name_of(op.function).removeprefix("aten.") in CURVED for op in net.operations)
    return curved and sum(math.prod(shapes[slot]) for slot in net.matrices) >= LEAST_NET


class _Search:
    """Grows networks along the operations in order. Each reads one array, so it can stand where it begins."""

    def __init__(self, shapes: Mapping[Slot, tuple[int, ...]], shared: set[Slot]) -> None:
        self._shapes, self._shared = shapes, shared
        self.parts: list[Part] = []
        self._of: dict[Slot, Part] = {}  # the network that makes a slot

    def take(self, operation: Operation) -> None:
        name = name_of(operation.function)
        if name in PRODUCTS:
            self._take_product(operation)
        elif name in KEEPS or name in NEURONWISE:
            self._take_neurons(operation)

    def _take_product(self, operation: Operation) -> None:
        *bias, source, matrix = operation.args
        shape, (rows, k) = self._shapes[matrix], self._shapes[source]
        if operation.kwargs or matrix not in self._shared:
            return
        if any(b not in self._shared or self._shapes[b] not in ((shape[1],), (1, shape[1])) for b in bias):
            return
        if len({slot.dtype for slot in operation.inputs}) > 1:
            return
        net = self._of.get(source) or next((net for net in self.parts if net.source == source), None)
        if net is None:
            net = Part(source, k, rows)
            self.parts.append(net)
        elif net.rows != rows:
            return
        net.vectors += bias
        net.matrices.append(matrix)
        self._add(net, operation)

    def _take_neurons(self, operation: Operation) -> None:
        parts = {id(self._of[slot]): self._of[slot] for slot in operation.inputs if slot in self._of}
        if len(parts) != 1:
            return
        (net,) = parts.values()
        widths = {self._width(slot, net.rows) for slot in operation.outputs}
        read = [slot for slot in operation.inputs if slot not in self._of]
        if None in widths or len(widths) > 1 or not self._shared.issuperset(read):
            return
        (width,) = widths
        if any(net.widths[slot] != width for slot in operation.inputs if slot in self._of):
            return
        if not all(self._is_of_neurons(slot, width) for slot in read):
            return
        net.vectors += read
        self._add(net, operation)

    def _is_of_neurons(self, slot: Slot, width: int | None) -> bool:
        """Whether all rows are combined with the same weights: one, or one of each neuron, but not one of each row."""
        shape = self._shapes[slot]
        return math.prod(shape[:-1]) == 1 and shape[-1:] in ((), (1,), (width,))

    def _width(self, slot: Slot, rows: int) -> int | None:
        """The neurons of an array with so many rows; None of other shapes."""
        shape = self._shapes[slot]
        return shape[-1] if shape and math.prod(shape[:-1]) == rows else None

    def _add(self, net: Part, operation: Operation) -> None:
        net.operations.append(operation)
        for slot in operation.outputs:
            self._of[slot] = net
            net.widths[slot] = self._shapes[slot][-1]


class _Layers:
    """Makes the layers of a network: neighbouring functions of neurons become one."""

    def __init__(
        self,
        net: Part,
        shapes: Mapping[Slot, tuple[int, ...]],
        places: Mapping[tuple[Slot, bool], int],
        precision: torch.dtype,
    ) -> None:
        import casadi as ca

        self._part, self._shapes, self._places, self._precision = net, shapes, places, precision
        self._layers: list[Linear | Neurons] = []
        self._symbols = [ca.SX.sym("a0")]  # of a neuron of each layer
        self._read: dict[Slot, Any] = {}  # symbols of an entry of a vector of weights, or of a single weight
        self._forms: dict[Slot, Any] = {net.source: self._symbols[0]}  # a neuron of each slot, of these symbols

    def net(self) -> Net:
        for operation in self._part.operations:
            if name_of(operation.function) in PRODUCTS:
                self._multiply(operation)
            else:
                self._compute(operation)
        outputs = tuple(self._layer(slot) for slot in self._part.outputs)
        return Net(self._part.k, tuple(self._layers), outputs)

    def _multiply(self, operation: Operation) -> None:
        *bias, source, matrix = operation.args
        k, h = self._shapes[matrix]
        turned = self._places[matrix, True]
        bias_start = self._places[bias[0], False] if bias else None
        symbol = self._add(Linear(self._layer(source), k, h, self._places[matrix, False], turned, bias_start))
        (made,) = operation.outputs
        narrow = torch.finfo(made.dtype).eps > torch.finfo(self._precision).eps
        self._forms[made] = to_single(symbol) if narrow else symbol

    def _compute(self, operation: Operation) -> None:
        if name_of(operation.function) in KEEPS:
            (made,), (source, *_) = operation.outputs, operation.inputs
            if made.dtype == source.dtype:
                self._forms[made] = self._forms[source]
                return
        known = {slot: self._one(slot) for slot in operation.inputs}
        replay(operation, known, self._precision)
        for slot in operation.outputs:
            self._forms[slot] = np.asarray(known[slot]).reshape(-1)[0]

    def _one(self, slot: Slot) -> np.ndarray:
        """A neuron of an array, with as many axes."""
        import casadi as ca

        if slot not in self._forms and slot not in self._read:
            self._read[slot] = ca.SX.sym(f"w{len(self._read)}")
        value = self._forms[slot] if slot in self._forms else self._read[slot]
        return boxed(value).reshape((1,) * len(self._shapes[slot]))

    def _layer(self, slot: Slot) -> int:
        """The layer that has the values of a slot, made of its form where there is none yet."""
        import casadi as ca

        form = ca.SX(self._forms[slot])
        for i, symbol in enumerate(self._symbols):
            if ca.is_equal(form, symbol):
                return i
        used = {free.element_hash() for free in ca.symvar(form)}
        sources = [i for i, symbol in enumerate(self._symbols) if symbol.element_hash() in used]
        read = [other for other, symbol in self._read.items() if symbol.element_hash() in used]
        read.sort(key=lambda other: math.prod(self._shapes[other]) == 1)
        symbols = [*(self._symbols[i] for i in sources), *(self._read[other] for other in read)]
        function = ca.Function("neuron", symbols, [form])
        vectors, singles = [
            tuple(self._places[other, False] for other in read if (math.prod(self._shapes[other]) == 1) is single)
            for single in (False, True)
        ]
        self._forms[slot] = self._add(Neurons(tuple(sources), vectors, singles, self._part.widths[slot], function))
        return len(self._layers)

    def _add(self, layer: Linear | Neurons) -> Any:
        import casadi as ca

        self._layers.append(layer)
        self._symbols.append(ca.SX.sym(f"a{len(self._layers)}"))
        return self._symbols[-1]
