"""Numbers for the page: half precision, compressed. `static/data.js` reads what is written here.

A part of the page is a text (JSON) and arrays. The text refers to an array as {"$": place, "shape": [...], "steps":
bool}, or "whole": true where its numbers are whole; the arrays follow it, all lowest bytes of one, then all higher
ones, which compresses better than the numbers one after the other.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np

LARGEST_HALF = 6e4  # the largest magnitude that is kept; half precision ends at 65,504
KEY = "$"
WHOLE_BYTES = 4  # bytes of a whole number


class Packing:
    """The arrays of one part, to which its text refers."""

    def __init__(self) -> None:
        self.planes: list[bytes] = []
        self.size = 0

    def put(self, values: np.ndarray, steps: bool = False) -> dict[str, Any]:
        """Keep an array; returns the reference to it.

        Args:
            steps: along the first axis only the differences are kept. Each is taken from what the reader has added up
                so far, so that rounding doesn't add up: with steps of 0.3 m a path is right to 0.1 mm anywhere.
        """
        values = np.asarray(values, dtype=float)
        halves = differences(values) if steps else values.clip(-LARGEST_HALF, LARGEST_HALF).astype("<f2")
        raw = np.frombuffer(np.ascontiguousarray(halves).tobytes(), dtype=np.uint8).reshape(-1, 2)
        offset = self.size
        self.planes.append(raw.T.tobytes())
        self.size += raw.size
        return {KEY: offset, "shape": list(values.shape), "steps": steps}

    def put_whole(self, values: np.ndarray) -> dict[str, Any]:
        """Keep whole numbers (K,) from 0 up to below 2^32, as the differences between one and the next, modulo 2^32."""
        steps = np.diff(np.asarray(values, dtype=np.uint32), prepend=np.uint32(0))
        raw = np.frombuffer(steps.astype("<u4").tobytes(), dtype=np.uint8).reshape(-1, WHOLE_BYTES)
        offset = self.size
        self.planes.append(raw.T.tobytes())
        self.size += raw.size
        return {KEY: offset, "shape": list(steps.shape), "whole": True}

    def sealed(self, text: dict[str, Any]) -> str:
        """Text and arrays in one, compressed, as base64."""
        head = json.dumps(text, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
        whole = len(head).to_bytes(4, "little") + head + b"".join(self.planes)
        return base64.b64encode(zlib.compress(whole, 9)).decode()


def differences(values: np.ndarray) -> np.ndarray:
    """Half-precision steps (K, ...) along the first axis, whose sums follow the values (K, ...)."""
    steps, reached = np.empty(values.shape, dtype="<f2"), np.zeros(values.shape[1:])
    for k, value in enumerate(values.clip(-LARGEST_HALF, LARGEST_HALF)):
        steps[k] = (value - reached).clip(-LARGEST_HALF, LARGEST_HALF)
        reached = reached + steps[k].astype(float)
    return steps


def number(value: Any, digits: int = 6) -> float | None:
    """A number as JSON can hold it: None where it isn't finite."""
    value = float(value)
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
