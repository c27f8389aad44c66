"""Shapes and places of arrays whose elements are CasADi expressions, by the conventions of PyTorch.

No function here writes into its arguments: the operations that call them are functional.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class NoCounterpart(Exception):
    """An operation is known, but not with these arguments."""


def boxed(value: Any) -> np.ndarray:
    """`value` as an array; NumPy would try to read a lone expression as a matrix."""
    if isinstance(value, np.ndarray):
        return value
    box = np.empty((), dtype=object)
    box[()] = value
    return box


def elements(column: Any) -> np.ndarray:
    """The scalars of a column of CasADi's, (size,) objects."""
    import casadi as ca

    scalars = np.empty(column.numel(), dtype=object)
    for i, element in enumerate(ca.vertsplit(column)):
        scalars[i] = element
    return scalars


def axes(a: np.ndarray, dim: int | Sequence[int] | None) -> tuple[int, ...]:
    """The axes that `dim` means, counted from the front; None and [] are all of them."""
    chosen = range(a.ndim) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
    return tuple(axis % a.ndim for axis in chosen) if a.ndim else ()


def _slice_at(a: np.ndarray, dim: int, start: int | None, end: int | None, step: int) -> tuple[slice, ...]:
    return (*[slice(None)] * (dim % a.ndim), slice(start, end, step))


def cut(a: np.ndarray, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> np.ndarray:
    return a[_slice_at(a, dim, start, end, step)]


def slice_scatter(
    a: np.ndarray, source: np.ndarray, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
) -> np.ndarray:
    return _written(a, _slice_at(a, dim, start, end, step), source)


def select(a: np.ndarray, dim: int, index: int) -> np.ndarray:
    return boxed(a[(*[slice(None)] * (dim % a.ndim), index)])


def select_scatter(a: np.ndarray, source: np.ndarray, dim: int, index: int) -> np.ndarray:
    return _written(a, (*[slice(None)] * (dim % a.ndim), index), source)


def diagonal_scatter(a: np.ndarray, source: np.ndarray, offset: int = 0, dim1: int = 0, dim2: int = 1) -> np.ndarray:
    copy = a.astype(object)
    i = np.arange(source.shape[-1])
    np.moveaxis(copy, (dim1, dim2), (-2, -1))[..., i + max(-offset, 0), i + max(offset, 0)] = source
    return copy


def _written(a: np.ndarray, key: tuple[Any, ...], source: np.ndarray) -> np.ndarray:
    copy = a.astype(object)
    copy[(*key, ...)] = source  # with the ellipsis, a single element is assigned as an array too
    return copy


def _places(indices: Sequence[Any]) -> tuple[Any, ...]:
    if any(i is not None and i.dtype == object for i in indices):
        raise NoCounterpart  # an index that depends on the state, or differs from problem to problem
    # PyTorch takes bytes for a mask, NumPy for places.
    return tuple(slice(None) if i is None else i.astype(bool) if i.dtype == np.uint8 else i for i in indices)


def index(a: np.ndarray, indices: Sequence[Any]) -> np.ndarray:
    return boxed(a[_places(indices)])


def index_put(a: np.ndarray, indices: Sequence[Any], source: np.ndarray, accumulate: bool = False) -> np.ndarray:
    places = _places(indices)
    if not accumulate:
        return _written(a, places, source)
    copy = a.astype(object)
    np.add.at(copy, places, source)
    return copy


def index_select(a: np.ndarray, dim: int, index: np.ndarray) -> np.ndarray:
    return a[(*[slice(None)] * (dim % a.ndim), *_places([np.atleast_1d(index)]))]


def gather(a: np.ndarray, dim: int, index: np.ndarray, **_: Any) -> np.ndarray:
    _places([index])
    # Along the other axes PyTorch reads as many places as the index has, where NumPy repeats an index of one.
    read = tuple(slice(None) if axis == dim % a.ndim else slice(size) for axis, size in enumerate(index.shape))
    return np.take_along_axis(a[read], index, axis=dim)


def squeeze(a: np.ndarray, dim: Any = None) -> np.ndarray:
    return np.squeeze(a, tuple(axis for axis in axes(a, dim) if a.shape[axis] == 1))


def expand(a: np.ndarray, sizes: Sequence[int], **_: Any) -> np.ndarray:
    shape = (1,) * (len(sizes) - a.ndim) + a.shape
    return np.broadcast_to(a, [have if want == -1 else want for have, want in zip(shape, sizes, strict=True)])


def pieces(a: np.ndarray, sizes: Sequence[int], dim: int = 0) -> list[np.ndarray]:
    return np.split(a, np.cumsum(sizes)[:-1].tolist(), axis=dim)


def split(a: np.ndarray, size: int | Sequence[int], dim: int = 0) -> list[np.ndarray]:
    if isinstance(size, int):
        return np.split(a, range(size, a.shape[dim], size), axis=dim)
    return pieces(a, size, dim)


def unbind(a: np.ndarray, dim: int = 0) -> list[np.ndarray]:
    return [boxed(row) for row in np.moveaxis(a, dim, 0)]
