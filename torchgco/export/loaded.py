"""load_c: an exported controller, compiled for this machine and called as `MPC` is."""

from __future__ import annotations

import ctypes
import math
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Floats, as_floats, measured
from torchgco.base.options import PositiveOrInfinite, Seconds, check_value
from torchgco.base.status import Status
from torchgco.native.compiler import Unit, build
from torchgco.receding.plan import stages_between

BAD_STATE, BAD_NUMBER = -1, -2
WITHOUT_ERRNO = "-fno-math-errno"
# gcc 12.2 -O2 with AVX-512 places arrays of floats in the red zone, below a function's frame, without their alignment.
WITHOUT_RED_ZONE = ("-mno-red-zone",)
_MEMBER = re.compile(r"^    (double|float|int) ([^;]+);(?: /\* ([\d x]+): ([^\s,]+)[^*]* \*/)?", re.MULTILINE)
_ONE, _CLOCK = re.compile(r"(\w+)(?:\[(\d+)\])?"), "double (*clock)(void);"
_SIZE = re.compile(r"^#define \w+_(NX|NU|N|STAGES|PERIOD|ELEMENTS) (\S+)(?:.* ([\d.e-]+) s \*/)?", re.MULTILINE)
_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_double)
_KINDS = {"double": ctypes.c_double, "float": ctypes.c_float, "int": ctypes.c_int}


def load_c(
    folder: str | Path, name: str | None = None, period: float | None = None, element: int = 0
) -> LoadedController:
    """The controller of a folder that `export_c` has written, compiled by this machine's compiler.

        controller = torchgco.load_c("car_c")
        u = controller.step(x, x_ref=reference)

    Its bits are those of `MPC` on this machine, as products and sums are fused alike; where obstacles move, if both are
    told in every step where they are.

    Args:
        name: of the controller; None: the only one in the folder.
        period: s, from one step to the next; None: what the horizon moves by at each step.
        element: of those that were exported: each has a controller of its own.

    Raises:
        InputError: no folder with such a controller, or several; no such element.
        NativeError: there is no compiler, or it refuses the code.
    """
    folder = Path(folder)
    paths = [path for path in (*folder.glob("src/*.h"), *folder.glob("*.h")) if path.with_suffix(".c").is_file()]
    headers, found = {path.stem: path for path in paths}, sorted(path.stem for path in paths)
    if name is None and len(found) == 1:
        name = found[0]
    if name is None or found.count(name) != 1:  # two: of one name for two kinds of `build`
        raise InputError("folder", "one with a controller of `export_c`", f"{', '.join(found) or 'none'} in {folder}")
    code = headers[name].with_suffix(".c").read_text()
    return LoadedController(headers[name].read_text(), code, name, period, element)


class LoadedController:
    """An exported controller; `load_c` makes it.

    Attributes:
        n, m, N: numbers of states, controls and stages; dt: of a stage, s.
        elements: how many were exported.
        t: time of the last step, s.
    """

    def __init__(self, header: str, code: str, name: str, period: float | None, element: int) -> None:
        sizes = {size: (_value(text), unit) for size, text, unit in _SIZE.findall(header)}
        self.n, self.m, self.N = (int(sizes[size][0]) for size in ("NX", "NU", "N"))
        self.dt, self._is_free = float(sizes["N"][1]), "PERIOD" in sizes
        usual = sizes["PERIOD"][0] if self._is_free else sizes["STAGES"][0] * self.dt
        self.period = usual if period is None else check_value(period, Seconds, "period")
        self.elements = int(sizes.get("ELEMENTS", (1, ""))[0])
        if isinstance(element, bool) or not isinstance(element, int) or not 0 <= element < self.elements:
            raise InputError("element", f"one of the {self.elements} that were exported, from 0 on", shown(element))
        self._shapes, kinds = _layout(header)
        single = f"float u[{name}_NU]" in header
        self._dtype: Any = np.float32 if single else np.float64
        self._real: Any = ctypes.c_float if single else ctypes.c_double
        source = code.replace(f'#include "{name}.h"', header)
        source += f'\n_Static_assert(sizeof({name}_workspace) == {ctypes.sizeof(kinds)}, "layout");\n'
        flags = (WITHOUT_ERRNO, *(WITHOUT_RED_ZONE if single and platform.machine() in ("x86_64", "AMD64") else ()))
        library = build((Unit(source, own=True),), flags)
        self._functions = {word: getattr(library, f"{name}_{word}") for word in ("init", "reset", "guess", "step")}
        self._functions["step"].restype = ctypes.c_int
        self._workspace = kinds()
        several = self.elements > 1
        self._functions["init"](ctypes.byref(self._workspace), *([ctypes.c_int(element)] if several else []))
        if period is not None:
            self._workspace.period = self.period
        self._workspace.clock = self._clock = _CALLBACK(clock.seconds)
        self._numbers = _views(self._workspace, self._shapes)
        self.t, self._begun = 0.0, False

    @property
    def numbers(self) -> dict[str, Floats]:
        """What steps may change, by name: the memory that C reads."""
        return self._numbers

    @property
    def workspace(self) -> ctypes.Structure:
        """The C workspace: `status`, `held`, `warm`, `iterations`, `violation`, the plan `X`, `U`, `K`, `age`, ..."""
        return self._workspace

    @property
    def status(self) -> Status:
        """How the last step's solve ended.

        Raises:
            InputError: no step yet, or numbers that the problem can't have.
        """
        if self._workspace.status == BAD_NUMBER:
            raise InputError("numbers", "numbers that the problem can have", "others")
        return Status(self._workspace.status)

    @property
    def held(self) -> bool:
        """Whether the last controls aren't of a plan that was found for their time."""
        return bool(self._workspace.held)

    @property
    def plan(self) -> tuple[Tensor, Tensor, Tensor]:
        """States (N+1, n), controls (N, m) and gains (N, m, n) of what is flown, from its first knot on."""
        shapes = {"X": (self.N + 1, self.n), "U": (self.N, self.m), "K": (self.N, self.m, self.n)}
        arrays = (np.array(getattr(self._workspace, name)).reshape(shape) for name, shape in shapes.items())
        X, U, K = (torch.from_numpy(array).double() for array in arrays)
        return X, U, K

    @property
    def times(self) -> Tensor:
        """Times of the knots of `plan`, (N+1,), s, from its first one on."""
        if not self._is_free:
            return self.dt * torch.arange(self.N + 1, dtype=torch.float64)
        return torch.from_numpy(np.array(self._workspace.t)).double()

    def reset(self) -> None:
        """Forget the plan; numbers stay, but for those that steps write."""
        self._functions["reset"](ctypes.byref(self._workspace))
        self.t, self._begun = 0.0, False

    def guess(self, X: Any, U: Any, times: Any = None) -> None:
        """Begin the next step with a plan of states X (N+1, n) and controls U (N, m).

        Args:
            times: of its knots, (N+1,), s, such as `solution.t[0]`, where the time is free; else None.

        Raises:
            InputError: another shape; no times where the time is free, or times where it isn't.
        """
        arrays, parts = [], [("X", X, (self.N + 1, self.n)), ("U", U, (self.N, self.m))]
        if (times is not None) != self._is_free:
            expected = "times of the knots, as the time is free" if self._is_free else "None, as the time is fixed"
            raise InputError("times", expected, shown(times))
        for name, value, shape in (*parts, *([("times", times, (self.N + 1,))] if self._is_free else [])):
            array = np.ascontiguousarray(as_floats(value, name))
            if array.shape != shape:
                raise InputError(name, f"shape {shape}", array.shape)
            arrays.append(array.astype(self._dtype))
        self._functions["guess"](ctypes.byref(self._workspace), *map(self._pointer, arrays))

    def step(
        self,
        x: Any,
        *,
        t: float | None = None,
        max_seconds: float | None = None,
        numbers: Mapping[str, Any] | None = None,
        **named: Any,
    ) -> Tensor:
        """The controls (m,) for the next period, from states x (n,) measured now; as of `MPC.step`.

        Raises:
            InputError: states, a time or numbers that don't fit. Nothing is changed then.
        """
        state = np.ascontiguousarray(measured(x, 1, self.n).reshape(self.n), self._dtype)
        later = self.period if t is None else t - self.t
        if t is not None and (not math.isfinite(t) or (self._begun and t <= self.t)):
            raise InputError("t", f"a time after {self.t:g} s", shown(t))
        limit = check_value(max_seconds, PositiveOrInfinite | None, "max_seconds")
        if twice := (numbers or {}).keys() & named.keys():
            raise InputError("numbers", "each number once", f"{min(twice)} twice")
        new = {name: self._fitting(name, value) for name, value in {**(numbers or {}), **named}.items()}
        for name, floats in new.items():
            self._numbers[name][...] = floats
        moved = (later if self._is_free else stages_between(later / self.dt)) if self._begun else 0.0
        u = np.zeros(self.m, self._dtype)
        self.raw_step(state, moved, math.inf if limit is None else limit, u)
        self.t = (self.t + self.period if self._begun else 0.0) if t is None else t
        self._begun = True
        return torch.from_numpy(u).double()

    def raw_step(self, x: Floats, moved: float, max_seconds: float, u: Floats) -> int:
        """`NAME_step` itself, with states x (n,) and room for controls u (m,), of C's type; returns what C returns."""
        times = self._real(moved), ctypes.c_double(max_seconds)
        return int(self._functions["step"](ctypes.byref(self._workspace), self._pointer(x), *times, self._pointer(u)))

    def _pointer(self, array: np.ndarray) -> Any:
        return array.ctypes.data_as(ctypes.POINTER(self._real))

    def _fitting(self, name: str, value: Any) -> Floats:
        if name not in self._numbers:
            raise InputError("numbers", f"one of {', '.join(self._numbers) or 'none'}", name)
        floats, there = as_floats(value, name), self._numbers[name]
        if floats.shape not in (there.shape, (1, *there.shape)):
            raise InputError(name, f"shape {there.shape}", floats.shape)
        return floats


def _value(text: str) -> float:
    """A constant of C; those in single precision are hexadecimal."""
    return float.fromhex(text.rstrip("f")) if text.startswith("0x") else float(text)


def _layout(header: str) -> tuple[dict[str, tuple[int, ...]], Any]:
    """Shapes of the numbers by name, and the workspace as a structure of ctypes, from the header."""
    numbers, workspace = header.split("_numbers;", 1)[0], header.split("_numbers;", 1)[1].split("_workspace;", 1)[0]
    shapes, fields = dict[str, tuple[int, ...]](), list[tuple[str, Any]]()
    for kind, names, shape, _ in _MEMBER.findall(numbers[numbers.index("typedef struct") :]):
        for name, count in _ONE.findall(names):
            fields.append((name, _KINDS[kind] * int(count) if count else _KINDS[kind]))
            if shape:
                shapes[name] = tuple(map(int, shape.split(" x ")))
    own: list[tuple[str, Any]] = [("numbers", type("Numbers", (ctypes.Structure,), {"_fields_": fields}))]
    own.append(("clock", _CALLBACK))
    for kind, names, *_ in _MEMBER.findall(workspace.split(_CLOCK, 1)[1]):
        for name, count in _ONE.findall(names):
            own.append((name, _KINDS[kind] * int(count) if count else _KINDS[kind]))
    return shapes, type("Workspace", (ctypes.Structure,), {"_fields_": own})


def _views(workspace: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Floats]:
    views = {name: np.ctypeslib.as_array(getattr(workspace.numbers, name)) for name in shapes}
    return {name: view.reshape(shapes[name]) for name, view in views.items()}
