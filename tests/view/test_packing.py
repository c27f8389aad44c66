"""Numbers of the page against a reader that is written as simply as can be."""

from __future__ import annotations

import base64
import json
import zlib
from itertools import accumulate
from typing import Any

import numpy as np
import pytest

from torchgco.view.packing import LARGEST_HALF, Packing, number


def read(sealed: str) -> Any:
    whole = zlib.decompress(base64.b64decode(sealed))
    length = int.from_bytes(whole[:4], "little")
    text, planes = json.loads(whole[4 : 4 + length]), whole[4 + length :]

    def array(held: dict[str, Any]) -> np.ndarray:
        count, at = int(np.prod(held["shape"])), held["$"]
        if held.get("whole"):
            parts = [planes[at + plane * count : at + (plane + 1) * count] for plane in range(4)]
            steps = [sum(part[i] << 8 * plane for plane, part in enumerate(parts)) for i in range(count)]
            return np.array(list(accumulate(steps, lambda a, b: (a + b) % 2**32)), dtype=np.int64)
        low, high = planes[at : at + count], planes[at + count : at + 2 * count]
        halves = np.frombuffer(bytes(b for pair in zip(low, high, strict=True) for b in pair), dtype="<f2")
        values = halves.astype(float).reshape(held["shape"])
        return np.cumsum(values, axis=0) if held["steps"] else values

    def resolved(value: Any) -> Any:
        if isinstance(value, dict):
            return array(value) if "$" in value else {name: resolved(one) for name, one in value.items()}
        return [resolved(one) for one in value] if isinstance(value, list) else value

    return resolved(text)


def part(page: str, name: str) -> Any:
    """A part of a page's text, read."""
    at = page.index(f'id="{name}"')
    return read(page[page.index(">", at) + 1 : page.index("</script>", at)])


def test_a_part_is_read_as_it_was_written() -> None:
    packing, values = Packing(), np.array([[1.0, -2.5], [0.0, 1024.0], [0.125, 6.1e-5]])
    held = read(packing.sealed({"name": "ä </script>", "one": packing.put(values), "more": [packing.put(values[:1])]}))
    assert held["name"] == "ä </script>"
    np.testing.assert_allclose(held["one"], values, rtol=2e-3)
    np.testing.assert_array_equal(held["more"][0], values[:1])


def test_whole_numbers_are_kept_as_they_are() -> None:
    packing, values = Packing(), np.array([7, 7, 2**32 - 1, 0, 70_000, 3])
    held = read(packing.sealed({"first": packing.put(np.ones(2)), "whole": packing.put_whole(values)}))
    np.testing.assert_array_equal(held["whole"], values)
    assert read(packing.sealed({"none": packing.put_whole(values[:0])}))["none"].shape == (0,)


def test_rounding_of_a_path_does_not_add_up() -> None:
    rng, packing = np.random.default_rng(0), Packing()
    path = 50.0 + np.cumsum(rng.uniform(-0.3, 0.3, (1000, 3)), axis=0)
    held = read(packing.sealed({"path": packing.put(path, steps=True)}))["path"]
    assert np.abs(held - path)[1:].max() < 2e-4
    assert np.abs(path.astype("<f2").astype(float) - path).max() > 5e-3  # what half precision alone would do


@pytest.mark.parametrize("steps", [False, True])
def test_what_is_too_large_is_cut_off(steps: bool) -> None:
    packing = Packing()
    held = read(packing.sealed({"far": packing.put(np.array([[1e9], [-1e9], [0.0]]), steps)}))["far"]
    assert np.isfinite(held).all() and held.max() <= LARGEST_HALF + 32


def test_no_array_and_no_row_is_written_too() -> None:
    packing = Packing()
    held = read(packing.sealed({"none": packing.put(np.empty((0, 3)), True), "one": packing.put(np.ones(1))}))
    assert held["none"].shape == (0, 3) and held["one"].tolist() == [1.0]


def test_numbers_that_json_lacks_are_none() -> None:
    assert [number(x) for x in (np.nan, np.inf, 1.23456789)] == [None, None, 1.23457]
