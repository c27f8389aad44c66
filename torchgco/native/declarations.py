"""What Python and C share: structures that a header of C declares, and enumerations and constants that Python does."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.native.codegen.emit import literal

NUMBERS = {"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64, "double": ctypes.c_double}
TENSOR_TYPES = {
    "double": torch.float64, "float": torch.float32, "int32_t": torch.int32, "int64_t": torch.int64,
    "uint64_t": torch.int64, "uint8_t": torch.bool,
}  # fmt: skip
PLAIN = (int, float, type(None))  # values that a field has as they are: numbers, and no address
_set = ctypes.Structure.__setattr__
_COMMENT, _STRUCTURE = re.compile(r"/\*.*?\*/", re.DOTALL), re.compile(r"typedef struct \{(.*?)\} (\w+);", re.DOTALL)
_DECLARATION, _NAMED = re.compile(r"(const )?(\w+) ([^;]+);"), re.compile(r"(\*?)(\w+)(?:\[(\w+)\])?")


@dataclass(frozen=True)
class Field:
    """A field of a structure: a number, a structure, `count` of them, or a pointer."""

    kind: str
    pointer: bool
    count: str = ""
    const: bool = False  # C doesn't write to what it points to


class Structure(ctypes.Structure):
    """A structure that Python and C share (see `Header`), filled by name; other names are refused.

    A pointer takes a contiguous tensor of the type that it points to, a structure or a list of them; the structure
    keeps them alive.
    """

    declared: ClassVar[Mapping[str, Field]] = {}
    tensors: ClassVar[Mapping[str, torch.dtype]] = {}  # what the tensors hold that fields point to
    kept: list[Any]

    def __init__(self, **values: Any) -> None:
        super().__init__()
        _set(self, "kept", [])
        if values:
            self.fill(values)

    def fill(self, values: Mapping[str, Any], copied: bool = False) -> Self:
        """This structure, or a copy where it is `copied`, with other values of fields by name."""
        filled = self
        if copied:
            filled = type(self).from_buffer_copy(self)
            _set(filled, "kept", [self])
        declared, tensors, kept = self.declared, self.tensors, filled.kept
        for name, value in values.items():
            # Most fields of a call are tensors or numbers, and each solve makes thousands of calls.
            if type(value) is Tensor and value.dtype is tensors.get(name) and value.is_contiguous():
                kept.append(value)
                _set(filled, name, value.data_ptr())
            elif isinstance(value, PLAIN) and name in declared:
                _set(filled, name, value)
            else:
                filled.__setattr__(name, value)
        return filled

    @classmethod
    def complete(cls, **values: Any) -> Self:
        """One with a value for each field; a field without one is an error, too."""
        if missing := set(cls.declared) - set(values):
            raise TypeError(f"{cls.__name__} lacks {', '.join(sorted(missing))}")
        return cls(**values)

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.declared:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        if isinstance(value, list):
            self.kept.append(value)
            of: Any = type(value[0]) if value else None
            value = (of * len(value))(*value) if value else None
        if isinstance(value, Tensor):
            expected, dtype = self.tensors.get(name), value.dtype
            if dtype != expected or not value.is_contiguous():
                raise TypeError(f"{name}: expected a contiguous tensor of {expected}, got {dtype}, {value.stride()}")
            self.kept.append(value)
            value = value.data_ptr()
        elif isinstance(value, (ctypes.Structure, ctypes.Array)):
            self.kept.append(value)
            value = ctypes.addressof(value) if self.declared[name].pointer else value
        return _set(self, name, value)


def kept_by(structure: Structure) -> dict[int, Any]:
    """All tensors, structures and arrays of these that a structure and those in it point to, by address."""
    todo: list[Any] = [structure]
    found = dict[int, Any]()
    while todo:
        one = todo.pop()
        if isinstance(one, list):
            todo += one
        elif isinstance(one, Tensor):
            found.setdefault(one.data_ptr(), one)
        elif isinstance(one, (ctypes.Structure, ctypes.Array)):
            known = found.setdefault(ctypes.addressof(one), one)
            todo += one.kept if known is one and isinstance(one, Structure) else []
    return found


class Header:
    """The structures of a header of C, typedef struct { ... } NAME; of numbers, pointers, structures, arrays of these.

    Args:
        text: of the header.
        sizes: of arrays of structures, by the names that stand for them there.
    """

    def __init__(self, text: str, sizes: Mapping[str, int] | None = None) -> None:
        self.made = dict[str, type[Structure]]()
        self._sizes = sizes or {}
        self._fields = {name: _fields(body) for body, name in _STRUCTURE.findall(_COMMENT.sub("", text))}

    def declare(self, *kinds: type[Structure]) -> None:
        """Give classes the fields of the structures of their names; those that others hold come before these."""
        for kind in kinds:
            declared = kind.declared = self._fields[kind.__name__]
            pointed = {name: TENSOR_TYPES.get(field.kind) for name, field in declared.items() if field.pointer}
            kind.tensors = {name: dtype for name, dtype in pointed.items() if dtype is not None}
            kind._fields_ = [(name, self._type(field)) for name, field in declared.items()]
            self.made[kind.__name__] = kind

    def _type(self, field: Field) -> Any:
        if field.pointer:
            return ctypes.c_void_p
        ctype = NUMBERS.get(field.kind) or self.made[field.kind]
        return ctype * self._sizes[field.count] if field.count else ctype

    @property
    def layout(self) -> str:
        """C that doesn't compile where a structure has another size there than in Python."""
        return "".join(
            f'_Static_assert(sizeof({name}) == {ctypes.sizeof(kind)}, "{name} has another size in Python");\n'
            for name, kind in self.made.items()
        )


def _fields(body: str) -> dict[str, Field]:
    fields = dict[str, Field]()
    for const, kind, names in _DECLARATION.findall(body):
        for pointer, name, count in _NAMED.findall(names):
            fields[name] = Field(kind, pointer == "*", count, bool(const))
    return fields


def enumerations(kinds: Iterable[type[IntEnum]]) -> str:
    """C that declares them."""
    return "".join(f"enum {{ {', '.join(f'{each.name} = {each.value}' for each in kind)} }};\n" for kind in kinds)


def defines(constants: Mapping[str, Any]) -> str:
    """Macros: numbers, exact to the last bit, or words."""
    texts = {name: literal(value) if isinstance(value, float) else str(value) for name, value in constants.items()}
    return "".join(f"#define {name} {text}\n" for name, text in texts.items())
