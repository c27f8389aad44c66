"""A packed problem's structures as C, and what they point to as constant tables."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchgco.export.tables import table
from torchgco.native import structures as c
from torchgco.native.codegen.emit import literal
from torchgco.native.declarations import Structure

TYPES = {
    torch.float64: "double", torch.float32: "float", torch.int64: "int64_t", torch.int32: "int32_t",
    torch.bool: "uint8_t",
}  # fmt: skip
OF_ELEMENTS = "constant", "least_cost", "free_start", "map_of"  # pointers to numbers of every element


@dataclass
class Writer:
    """Structures as initialisers of C; what they point to is a table, or has a place in the workspace.

    Attributes:
        places: expressions by address.
        elements: how many problems tables have numbers of, one after the other; `element` is the one in C.
        tables: definitions of constant arrays.
    """

    tensors: dict[int, Tensor]
    places: dict[int, str]
    elements: int = 1
    tables: list[str] = field(default_factory=list)
    flash: int = 0  # bytes of tables
    number: int = 8  # of a number

    def table(self, tensor: Tensor) -> str:
        """The name of a constant array with these numbers."""
        name = f"table_{len(self.tables)}"
        self.flash += tensor.numel() * min(tensor.element_size(), self.number)
        self.tables.append(table(f"static const {TYPES[tensor.dtype]} {name}[]", tensor))
        return name

    def body(self, structure: Structure, **given: str) -> str:
        """An initialiser; `given` are expressions of fields."""
        rows = []
        for name, declared in structure.declared.items():
            value = getattr(structure, name)
            if name in given:
                rows.append(f".{name} = {given[name]}")
            elif isinstance(value, c.Array):
                rows += [f".{name} = {self._array(value)}"] if value.data else []
            elif isinstance(value, Structure):
                inner = self.body(value)
                rows += [] if inner == "{0}" else [f".{name} = {inner}"]
            elif isinstance(value, ctypes.Array):
                rows.append(f".{name} = {{{', '.join(self.body(one) for one in value)}}}")
            elif declared.pointer:
                rows += [f".{name} = {self.pointer(value, name in OF_ELEMENTS)}"] if value else []
            elif value != 0:
                rows.append(f".{name} = {literal(value) if isinstance(value, float) else value}")
        return f"{{{', '.join(rows) or '0'}}}"

    def _array(self, array: c.Array) -> str:
        """That of the element."""
        place = self.pointer(array.data, array.element != 0)
        fields = {"data": place, "knot": array.knot, "size": array.size}
        return f"{{{', '.join(f'.{name} = {value}' for name, value in fields.items() if value)}}}"

    def pointer(self, address: int, by_element: bool) -> str:
        """Where it begins, of arrays with numbers of every element at those of one."""
        if address not in self.places:
            tensor = self.tensors[address]
            self.places[address] = self.table(tensor)
            if by_element and self.elements > 1:
                self.places[address] += f" + element * {tensor.numel() // self.elements}"
        return self.places[address]
