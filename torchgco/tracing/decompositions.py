"""PyTorch's operations that its own tables leave whole, written out in those that have a counterpart.

Each takes the operation's arguments and gives its result, by name without the overload; NotImplemented: not so. Places
that an operation returns beside its values, such as `sort` does, can't be compiled; nobody needs them mostly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor


def _round(x: Tensor, decimals: int = 0) -> Tensor:
    if decimals:
        scale = 10.0 ** abs(decimals)
        return _round(x * scale) / scale if decimals > 0 else _round(x / scale) * scale
    low = x.floor()
    rest, even = x - low, low + low.remainder(2.0)  # a half goes to the even number
    return torch.where((rest < 0.5) | (rest != rest), low, torch.where(rest > 0.5, low + 1.0, even))


def _is_negative(x: Tensor) -> Tensor:
    """Whether the sign is, that of 0 included."""
    return (x < 0) | ((x == 0) & (1.0 / x < 0))


def _copysign(a: Tensor, b: Tensor | float) -> Tensor:
    return a.abs() * (torch.where(_is_negative(b), -1.0, 1.0) if isinstance(b, Tensor) else math.copysign(1.0, b))


def _xor(a: Tensor, b: Tensor) -> Tensor:
    return (a != 0) != (b != 0)


def _other_where_nan(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda a, b: torch.where(b != b, a, torch.where(a != a, b, function(a, b)))


def _softmax(x: Tensor, dim: int, half_to_float: bool = False) -> Tensor:
    if x.dim() == 0:
        return torch.ones_like(x)
    e = (x - x.amax(dim, keepdim=True)).exp()
    return e / e.sum(dim, keepdim=True)


def _log_softmax(x: Tensor, dim: int, half_to_float: bool = False) -> Tensor:
    if x.dim() == 0:
        return torch.zeros_like(x)
    x = x - x.amax(dim, keepdim=True)
    return x - x.exp().sum(dim, keepdim=True).log()


def _var_mean(x: Tensor, dim: Any = None, correction: Any = None, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    dims = list(range(x.dim())) if dim is None or dim == [] else [dim] if isinstance(dim, int) else list(dim)
    count = math.prod(x.shape[axis] for axis in dims) - (1.0 if correction is None else correction)
    mean = x.mean(dims, keepdim=True)
    var = (x - mean).square().sum(dims, keepdim=keepdim) / max(0.0, count)
    return var, mean if keepdim else x.mean(dims)


def _std_mean(*args: Any, **more: Any) -> tuple[Tensor, Tensor]:
    var, mean = _var_mean(*args, **more)
    return torch.where(var == 0, 0.0, var.sqrt()), mean  # at 0 the derivative is 0, as PyTorch's


def _layer_norm(x: Tensor, shape: Sequence[int], weight: Any, bias: Any, eps: float) -> tuple[Tensor, ...]:
    var, mean = _var_mean(x, list(range(-len(shape), 0)), 0, True)
    scale = (var + eps).rsqrt()
    return _scaled((x - mean) * scale, weight, bias), mean, scale


def _group_norm(
    x: Tensor, weight: Any, bias: Any, N: int, C: int, HxW: int, groups: int, eps: float
) -> tuple[Tensor, ...]:
    parts = x.reshape(N, groups, -1)
    var, mean = _var_mean(parts, -1, 0, True)
    scale = (var + eps).rsqrt()
    of_channels = [None if p is None else p.reshape(C, *[1] * (x.dim() - 2)) for p in (weight, bias)]
    return _scaled(((parts - mean) * scale).reshape(x.shape), *of_channels), mean.squeeze(-1), scale.squeeze(-1)


def _batch_norm(x: Tensor, weight: Any, bias: Any, mean: Tensor, var: Tensor, _: float, eps: float) -> Any:
    of_channels: Callable[..., Any] = lambda p: None if p is None else p.reshape(-1, *[1] * (x.dim() - 2))
    centered = (x - of_channels(mean)) * (of_channels(var) + eps).rsqrt()
    return _scaled(centered, of_channels(weight), of_channels(bias)), mean.new_zeros(0), mean.new_zeros(0)


def _scaled(x: Tensor, weight: Tensor | None, bias: Tensor | None) -> Tensor:
    x = x if weight is None else x * weight
    return x if bias is None else x + bias


def _norm(x: Tensor, ord: float = 2, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Any:
    if ord == 2 or dtype is not None:
        return NotImplemented
    dims, size = list(range(x.dim())) if dim is None else dim, x.abs()
    if math.isinf(ord):
        return size.amax(dims, keepdim) if ord > 0 else size.amin(dims, keepdim)
    if ord in (0, 1):
        return (size if ord else (size != 0).to(x.dtype)).sum(dims, keepdim=keepdim)
    powers = torch.where(size == 0, 0.0 if ord > 0 else torch.inf, size**ord)  # without a derivative at 0, as PyTorch's
    total = powers.sum(dims, keepdim=keepdim)
    return torch.where(total == 0, 0.0, total ** (1.0 / ord))  # at 0 the derivative is 0, as PyTorch's


def _sort(x: Tensor, dim: int = -1, descending: bool = False, *, stable: Any = None) -> Any:
    """By a network of exchanges (Batcher 1968)."""
    if x.dim() == 0:
        return NotImplemented
    parts = list(x.unbind(dim))
    for i, j in _exchanges(len(parts)):
        parts[i], parts[j] = torch.minimum(parts[i], parts[j]), torch.maximum(parts[i], parts[j])
    values = torch.stack(parts[::-1] if descending else parts, dim)
    return values, _places(values, x, dim)


def _exchanges(n: int) -> list[tuple[int, int]]:
    pairs, p = [], 1
    while p < n:
        k = p
        while k >= 1:
            for j in range(k % p, n - k, 2 * k):
                for i in range(min(k, n - j - k)):
                    if (i + j) // (2 * p) == (i + j + k) // (2 * p):
                        pairs.append((i + j, i + j + k))
            k //= 2
        p *= 2
    return pairs


def _places(values: Tensor, among: Tensor, dim: int) -> Tensor:
    """Where values are found among others along an axis."""
    same = values.movedim(dim, -1).unsqueeze(-1) == among.movedim(dim, -1).unsqueeze(-2)
    return same.to(torch.uint8).argmax(-1).movedim(-1, dim)


def _topk(x: Tensor, k: int, dim: int = -1, largest: bool = True, sorted: bool = True) -> Any:
    values, places = x.sort(dim, descending=largest)
    return values.narrow(dim, 0, k), places.narrow(dim, 0, k)


def _kth(x: Tensor, k: int, dim: int = -1, keepdim: bool = False) -> Any:
    kept = [values.narrow(dim, k - 1, 1) for values in x.sort(dim)]
    return tuple(kept) if keepdim else tuple(values.squeeze(dim) for values in kept)


def _median(x: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
    if dim is None:
        return _kth(x.flatten(), (x.numel() + 1) // 2)[0]
    return _kth(x, (x.shape[dim] + 1) // 2, dim, keepdim)


def _extreme(name: str) -> Callable[..., Any]:
    def found(x: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
        value = getattr(x, f"a{name}")
        if dim is None:
            return value()
        return value(dim, keepdim), getattr(x, f"arg{name}")(dim, keepdim)

    return found


def _accumulated(combine: Callable[[Tensor, Tensor], Tensor], has_places: bool = False) -> Callable[..., Any]:
    def found(x: Tensor, dim: int, *, dtype: Any = None) -> Any:
        parts = list((x if dtype is None else x.to(dtype)).unbind(dim)) if x.dim() else []
        for i in range(1, len(parts)):
            parts[i] = combine(parts[i - 1], parts[i])
        whole = torch.stack(parts, dim) if parts else x
        return (whole, _places(whole, x, dim)) if has_places else whole

    return found


def _pad(x: Tensor, pad: Sequence[int], value: float = 0) -> Tensor:
    for i in range(0, len(pad), 2):
        dim, parts = x.dim() - 1 - i // 2, []
        for size in pad[i : i + 2]:
            shape = list(x.shape)
            shape[dim] = max(0, size)
            parts.append(x.new_full(shape, value))
        first, last = (max(0, -size) for size in pad[i : i + 2])
        x = torch.cat((parts[0], x.narrow(dim, first, x.shape[dim] - first - last), parts[1]), dim)
    return x


def _convolution(
    x: Tensor, weight: Tensor, bias: Any, stride: Any, padding: Any, dilation: Any, turned: bool, _: Any, groups: int
) -> Any:
    if turned:
        return NotImplemented
    d, width, made = len(stride), weight.shape[1], weight.shape[0]
    x = _pad(x, [size for size in reversed(padding) for _ in (0, 1)])
    sizes = [(x.shape[2 + i] - dilation[i] * (weight.shape[2 + i] - 1) - 1) // stride[i] + 1 for i in range(d)]
    total: Any = 0.0
    for tap in product(*map(range, weight.shape[2:])):
        cut = x
        for i, k in enumerate(tap):
            first = k * dilation[i]
            cut = cut[(slice(None),) * (2 + i) + (slice(first, first + stride[i] * (sizes[i] - 1) + 1, stride[i]),)]
        parts, w = cut.reshape(len(x), groups, 1, width, -1), weight[(..., *tap)].reshape(1, groups, -1, width, 1)
        total = total + (parts * w).sum(3)
    total = total.reshape(len(x), made, *sizes)
    return total if bias is None else total + bias.reshape(made, *[1] * d)


def _avg_pool(
    x: Tensor, size: Any, stride: Any = (), padding: Any = 0, ceil: bool = False, pads: bool = True, by: Any = None
) -> Any:
    if ceil or by is not None or (not pads and any(padding)):
        return NotImplemented
    x = _pad(x, [n for n in reversed(padding) for _ in (0, 1)]) if padding else x
    for n, step in zip(size, stride or size, strict=True):
        x = _unfold(x, -2, n, step)  # the axis after the last one is the first again
    return x.mean((-2, -1))


def _trilinear(a: Tensor, b: Tensor, c: Tensor, *lists: Any) -> Tensor:
    """The sum of a b c over the axes of the last list, each factor with the axes of its own list added."""
    products: Any = 1.0
    for factor, added in zip((a, b, c), lists[:3], strict=True):
        for dim in added:
            factor = factor.unsqueeze(dim)
        products = products * factor
    return products.sum(lists[3])


def _scatter(accumulate: bool) -> Callable[..., Any]:
    def scattered(x: Tensor, dim: int, index: Tensor, source: Any, reduce: Any = None) -> Any:
        if reduce is not None or x.dim() == 0:
            return NotImplemented
        indices: Any = list(torch.meshgrid(*(torch.arange(n, device=x.device) for n in index.shape), indexing="ij"))
        indices[dim] = index
        if isinstance(source, Tensor):
            source = source[tuple(slice(n) for n in index.shape)]
        else:
            source = torch.full(index.shape, float(source), dtype=x.dtype, device=x.device)
        return x.index_put(indices, source, accumulate)

    return scattered


def _unfold(x: Tensor, dim: int, size: int, step: int) -> Tensor:
    starts = range(0, x.shape[dim] - size + 1, step)
    return torch.stack([x.narrow(dim, first, size).movedim(dim, -1) for first in starts], dim % x.dim())


DECOMPOSITIONS: dict[str, Callable[..., Any]] = {
    "aten.round": _round,
    "aten.trunc": lambda x: torch.where(x < 0, x.ceil(), x.floor()),
    "aten.isnan": lambda x: x != x,
    "aten.isinf": lambda x: x.abs() == torch.inf,
    "aten.signbit": _is_negative,
    "aten.copysign": _copysign,
    "aten.logical_xor": _xor,
    "aten.fmax": _other_where_nan(torch.maximum),
    "aten.fmin": _other_where_nan(torch.minimum),
    "aten.exp2": lambda x: 2.0**x,
    "aten.softshrink": lambda x, size=0.5: torch.where(x.abs() <= size, 0.0, x - size * x.sign()),  # NaN stays one
    "aten.ldexp": lambda a, b: a * 2.0**b,
    "aten._softmax": _softmax,
    "aten._log_softmax": _log_softmax,
    "aten.var": lambda *args, **more: _var_mean(*args, **more)[0],
    "aten.var_mean": _var_mean,
    "aten.std": lambda *args, **more: _std_mean(*args, **more)[0],
    "aten.std_mean": _std_mean,
    "aten.native_layer_norm": _layer_norm,
    "aten.native_group_norm": _group_norm,
    "aten._native_batch_norm_legit_no_training": _batch_norm,
    "aten.linalg_vector_norm": _norm,
    "aten._cdist_forward": lambda a, b, p, _: (a.unsqueeze(-2) - b.unsqueeze(-3)).norm(p, -1),
    "aten.max": _extreme("max"),
    "aten.min": _extreme("min"),
    "aten.sort": _sort,
    "aten.topk": _topk,
    "aten.kthvalue": _kth,
    "aten.median": _median,
    "aten.cumprod": _accumulated(torch.mul),
    "aten.cummax": _accumulated(torch.maximum, True),
    "aten.cummin": _accumulated(torch.minimum, True),
    "aten.logcumsumexp": _accumulated(torch.logaddexp),
    "aten.constant_pad_nd": _pad,
    "aten.convolution": _convolution,
    "aten.avg_pool2d": _avg_pool,
    "aten._trilinear": _trilinear,
    "aten.scatter": _scatter(False),
    "aten.scatter_add": _scatter(True),
    "aten.unfold": _unfold,
}
