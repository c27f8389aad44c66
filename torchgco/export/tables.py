"""Constant arrays in C."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor

from torchgco.native.codegen.emit import literal


def table(declared: str, values: Tensor | Iterable[float]) -> str:
    """The definition of a constant array."""
    numbers = values.flatten().tolist() if isinstance(values, Tensor) else list(values)
    texts = [literal(number) if isinstance(number, float) else str(int(number)) for number in numbers]
    lines, line = [], "   "
    for text in texts or ["0"]:
        if len(line) + len(text) > 116:
            lines.append(line)
            line = "   "
        line += f" {text},"
    return "\n".join([f"{declared} = {{", *lines, line, "};"])
