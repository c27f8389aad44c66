"""Emitted C functions, called on any number of problems."""

import ctypes

import numpy as np
import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, words
from torchgco.native.codegen.dynamics import JACOBIAN, STEP_FUNCTION, DynamicsSource
from torchgco.native.codegen.emit import SHARED_AT
from torchgco.native.compiler import build
from torchgco.native.declarations import defines
from torchgco.native.includes import included, joined
from torchgco.native.structures import constants

LANES = 8


class Emitted:
    """A C function `name` on arrays (B, size); `inputs` and `outputs` are the sizes of its arguments.

    Input `shared`, if any, is one array (size,) for all problems.
    """

    def __init__(
        self,
        code: str,
        name: str,
        inputs: list[int],
        outputs: list[int],
        real: str = "double",
        lanes: int = LANES,
        shared: int | None = None,
    ) -> None:
        sizes = [max(size, 1) for size in (*inputs, *outputs)]
        arguments = [f"a{i}" for i in range(len(sizes))]
        given = ", ".join(f"REAL *{argument}" for argument in arguments)
        local = " ".join(f"V v{i}[{size}];" for i, size in enumerate(sizes))
        copies = [f"memcpy(v{i}, a{i}, sizeof v{i});" for i in range(len(inputs)) if i != shared]
        passed = [f"(const double *)a{i}" if i == shared else f"v{i}" for i in range(len(sizes))]
        copies += [f"{name}({', '.join(passed)});"]
        copies += [f"memcpy(a{i}, v{i}, sizeof v{i});" for i in range(len(inputs), len(sizes))]
        driver = f"#include <string.h>\nvoid tgco_run({given}) {{ {local} {' '.join(copies)} }}\n"
        header = defines({"REAL": real, "LANES": lanes}) + included("functions.h")
        self._run = build(joined(header + code) + driver).tgco_run
        self._dtype, self._lanes = np.dtype(real.replace("float", "f4")), lanes
        self._outputs, self._sizes, self._shared = outputs, sizes, shared

    def __call__(self, *values: np.ndarray) -> list[np.ndarray]:
        """Outputs (B, size). The last group of lanes is filled up by repeating its problems."""
        B = len(values[0])
        made = [np.zeros((B, size), self._dtype) for size in self._outputs]
        for first in range(0, B, self._lanes):
            rows = np.resize(np.arange(first, min(first + self._lanes, B)), self._lanes)
            arrays = [np.zeros((size, self._lanes), self._dtype) for size in self._sizes]
            for i, value in enumerate(values):
                if i == self._shared:
                    arrays[i] = value
                else:
                    arrays[i][: value.shape[1]] = value[rows].T
            self._run(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))
            for out, array in zip(made, arrays[len(values) :], strict=True):
                out[rows] = array[: out.shape[1]].T
        return made


def drawn(key: DrawKey, rows: int, samples: int, stream: int = 0) -> Tensor:
    """Standard normal draws (rows, B, samples), float64, of the native sampler."""
    code = """
void tgco_draw(uint64_t key, int64_t samples, int64_t rows, double *z) {
    V block[rows];
    for (int64_t first = 0; first < samples; first += LANES) {
        normal(key, first, rows, block);
        for (int64_t i = 0; i < rows; i++)
            for (int l = 0; l < LANES && first + l < samples; l++) z[i * samples + first + l] = block[i][l];
    }
}
"""
    header = defines({"REAL": "double", "LANES": LANES}) + included("normal.h")
    library = build(joined(header, given={"constants.h": constants()}) + code)
    made = torch.empty(key.ids.numel(), rows, samples, dtype=torch.float64)
    for z, word in zip(made, words(key, stream).tolist(), strict=True):
        library.tgco_draw(*(ctypes.c_int64(number) for number in (word, samples, rows)), ctypes.c_void_p(z.data_ptr()))
    return made.transpose(0, 1)


class Model:
    """Step and Jacobian of a model in C."""

    def __init__(self, source: DynamicsSource, real: str = "double", lanes: int = LANES) -> None:
        inputs = [source.n, source.m, source.count, len(source.traced.pattern)]
        self._source = source
        self._step = Emitted(source.code, STEP_FUNCTION, inputs, [source.n], real, lanes, SHARED_AT)
        self._jacobian = Emitted(source.code, JACOBIAN, inputs, [source.computed], real, lanes, SHARED_AT)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """(B, n) by (B, n), (B, m), for the problems 0 to B - 1."""
        return torch.from_numpy(self._step(*self._inputs(x, u))[0])

    def jacobian(self, x: Tensor, u: Tensor) -> Tensor:
        """[fx, fu] (B, n, n+m), assembled from computed and constant entries."""
        source, (entries,) = self._source, self._jacobian(*self._inputs(x, u))
        whole = torch.zeros(len(x), source.n, source.n + source.m, dtype=torch.from_numpy(entries).dtype)
        places = zip(source.rows, source.columns, source.places, source.values, strict=True)
        for row, column, place, value in places:
            whole[:, row, column] = torch.from_numpy(entries)[:, place] if place >= 0 else value
        return whole

    def _inputs(self, x: Tensor, u: Tensor) -> tuple[np.ndarray, ...]:
        shared = self._source.traced.shared_numbers()
        assert shared is not None
        return x.numpy(), u.numpy(), self._source.parameters(torch.arange(len(x))).numpy(), shared.numpy()
