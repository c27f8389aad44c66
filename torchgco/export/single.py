"""C of numbers in single precision, from text in double: for processors whose floating-point unit has no other."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import torch

from torchgco.lagrangian.barrier import BarrierOptions, fitted
from torchgco.native.codegen.emit import literal

_APART = re.compile(r'(/\*.*?\*/|"[^"\n]*")', re.DOTALL)  # comments and texts
# Times stay: a clock's last bit after a day is 8 ms in single precision. So does what other types are placed in.
_DOUBLE = re.compile(r"(?<!sizeof\()\bdouble\b(?!\s*\(?\*?(?:clock|seconds|seconds_of|max_seconds|until|begun|room)\b)")
_LITERAL = re.compile(
    r"(?<![\w.])(0x[\da-fA-F]*\.?[\da-fA-F]*p[+-]?\d+|\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])"
)
_CALL = re.compile(r"(?<![\w.>])(fabs|floor|sqrt|pow|fma|log|exp|sin|cos|tan)\(")
VIOLATION = 1e-4  # m, that rounding along a rollout over some ten metres stays below


def single(text: str) -> str:
    """The same C with `float` for `double`, constants and functions of libm of that type."""
    parts = _APART.split(text)
    for i in range(0, len(parts), 2):
        parts[i] = _CALL.sub(r"\1f(", _LITERAL.sub(_rounded, _DOUBLE.sub("float", parts[i])))
    return "".join(parts)


def _rounded(found: re.Match[str]) -> str:
    value = float.fromhex(found[1]) if found[1].startswith("0x") else float(found[1])
    with np.errstate(over="ignore", under="ignore"):
        number = literal(float(np.float32(value)))
    return number if number == "INFINITY" else f"{number}f"


def options_in_single(options: BarrierOptions) -> BarrierOptions:
    """Options of an interior point that computes all in single precision.

    It goes on until the error falls by half no more in two iterations, as it can't be met to the last bit, and ends
    where it is below 1e-4 then. A barrier that makes up 1e-3 of the cost is pressed further: rounding hides less.
    """
    return replace(
        fitted(options, torch.float32),
        tol=max(options.tol, 1e-6), rounding=1e-6, acceptable_tol=1e-4, acceptable_iter=2,
        counts=max(options.counts, 1e-3), mu_min=1e-20,
    )  # fmt: skip
