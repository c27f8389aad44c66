"""What Python and C share is declared once, in Python, and written into the head of a C file: structures, enumerations,
constants. A loaded library says how large its structures are, so that no other layout is ever read.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.native.codegen.emit import literal
from torchgco.native.compiler import NativeError, Unit, build

NUMBERS = {"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64, "double": ctypes.c_double}
TENSOR_TYPES = {
    "double": torch.float64, "float": torch.float32, "int32_t": torch.int32, "int64_t": torch.int64,
    "uint64_t": torch.int64, "uint8_t": torch.bool,
}  # fmt: skip
PLAIN_NUMBERS = (int, float, bool)
_set = ctypes.Structure.__setattr__
INCLUDES = "#define _POSIX_C_SOURCE 199309L /* a clock that nobody sets */\n#include <stdint.h>\n"


class Structure(ctypes.Structure):
    """A structure that Python and C share. A subclass declares it, and is filled by name; other names are refused.

    A pointer takes a contiguous tensor of the type that it points to, a structure or a list of them; the structure
    keeps them alive.

    Attributes:
        declared: C type and names of some fields, in order. A type is a number's, a pointer's, a structure, or a
            structure and how many of it.
    """

    declared: ClassVar[tuple[tuple[Any, str], ...]] = ()
    kinds: ClassVar[dict[str, Any]] = {}  # C type of each field
    tensors: ClassVar[dict[str, torch.dtype]] = {}  # what the tensors hold that fields point to
    kept: list[Any]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.kinds = {name: kind for kind, names in cls.declared for name in names.split()}
        known = {name: _held(kind) for name, kind in cls.kinds.items() if isinstance(kind, str) and kind.endswith("*")}
        cls.tensors = {name: dtype for name, dtype in known.items() if dtype is not None}

    def __init__(self, **values: Any) -> None:
        super().__init__()
        _set(self, "kept", [])
        self.fill(values)

    def fill(self, values: Mapping[str, Any]) -> None:
        """Set fields by name."""
        kinds, tensors, kept = self.kinds, self.tensors, self.kept
        for name, value in values.items():
            # Most fields of a call are tensors or numbers, and each solve makes thousands of calls.
            if type(value) is Tensor and value.dtype is tensors.get(name) and value.is_contiguous():
                kept.append(value)
                _set(self, name, value.data_ptr())
            elif type(value) in PLAIN_NUMBERS and name in kinds:
                _set(self, name, value)
            else:
                self.__setattr__(name, value)

    @classmethod
    def complete(cls, **values: Any) -> Self:
        """One with a value for each field; a field without one is an error, too."""
        if missing := set(cls.kinds) - set(values):
            raise TypeError(f"{cls.__name__} lacks {', '.join(sorted(missing))}")
        return cls(**values)

    def copy(self) -> Self:
        other = type(self).from_buffer_copy(self)
        _set(other, "kept", [self])
        return other

    def __setattr__(self, name: str, value: Any) -> None:
        kind = self.kinds.get(name)
        if kind is None:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        if type(value) in PLAIN_NUMBERS:
            return _set(self, name, value)
        if isinstance(value, list):
            self.kept.append(value)
            of: Any = type(value[0]) if value else None
            value = (of * len(value))(*value) if value else None
        if isinstance(value, (Tensor, ctypes.Structure, ctypes.Array)):
            self.kept.append(value)
            value = _address(value, kind, name) if isinstance(kind, str) else value
        return _set(self, name, value)


def fields(declared: tuple[tuple[Any, str], ...]) -> list[tuple[str, Any]]:
    """The fields that ctypes expects."""
    return [(name, _ctype(kind)) for kind, names in declared for name in names.split()]


def load(source: str | Sequence[Unit], structures: Iterable[type[Structure]], flags: Sequence[str] = ()) -> ctypes.CDLL:
    """The library that a source, or units, with the `head` of these structures are compiled to.

    Raises:
        NativeError: see `build`; or a structure of another size in C, or of none.
    """
    library = build(source, flags)
    for structure in structures:
        name = structure.__name__
        try:
            size = getattr(library, f"tgco_size_of_{name}")()
        except AttributeError:
            raise NativeError(f"{library._name} isn't compiled from this source: it has no {name}") from None
        if size != ctypes.sizeof(structure):
            raise NativeError(f"{name} has {ctypes.sizeof(structure)} bytes in Python, {size} in the library")
    return library


def head(
    structures: Iterable[type[Structure]], enumerations: Iterable[type[IntEnum]], constants: Mapping[str, Any]
) -> str:
    """C that declares them all, and functions by which the library says how large its structures are."""
    lines = [INCLUDES, defines(constants)]
    lines += [f"enum {{ {', '.join(f'{each.name} = {each.value}' for each in kind)} }};" for kind in enumerations]
    for structure in structures:
        rows = "".join(f"    {_in_c(name, kind)};\n" for name, kind in structure.kinds.items())
        name = structure.__name__
        lines += [f"typedef struct {{\n{rows}}} {name};"]
        # Weak: each unit of a library has it.
        lines += [f"__attribute__((weak)) int tgco_size_of_{name}(void) {{ return sizeof({name}); }}"]
    return "\n".join(lines) + "\n"


def defines(constants: Mapping[str, Any]) -> str:
    """Macros: numbers, exact to the last bit, or words."""
    texts = {name: literal(value) if isinstance(value, float) else str(value) for name, value in constants.items()}
    return "".join(f"#define {name} {text}\n" for name, text in texts.items())


def _ctype(kind: Any) -> Any:
    if isinstance(kind, tuple):
        return kind[0] * kind[1]
    return kind if not isinstance(kind, str) else ctypes.c_void_p if kind.endswith("*") else NUMBERS[kind]


def _in_c(name: str, kind: Any) -> str:
    if isinstance(kind, tuple):
        return f"{kind[0].__name__} {name}[{kind[1]}]"
    return f"{kind} {name}" if isinstance(kind, str) else f"{kind.__name__} {name}"


def _held(kind: str) -> torch.dtype | None:
    """What a tensor holds that a pointer of this type points to; None for pointers to structures."""
    return TENSOR_TYPES.get(kind.removeprefix("const ").removesuffix(" *"))


def _address(value: Any, kind: str, name: str) -> int:
    """Where a value begins that a pointer of this type may point to."""
    if not isinstance(value, Tensor):
        return ctypes.addressof(value)
    expected = _held(kind)
    if value.dtype != expected or not value.is_contiguous():
        raise TypeError(f"{name}: expected a contiguous tensor of {expected}, got {value.dtype}, {value.stride()}")
    return value.data_ptr()
