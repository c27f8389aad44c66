"""Normal draws that are a function of their key, not of their place in a batch.

A draw is keyed by (seed, problem id, outer iteration, stream) and numbered by a counter within its key. The key is
mixed by the SplitMix64 finaliser (Steele, Lea and Flood, OOPSLA 2014) into two 32-bit words; the counter is hashed with
them by the finaliser of MurmurHash3 (Appleby), in int32 tensors, which processors multiply many at a time. A problem
thus sees the same noise when it is solved by itself, in any batch and in any shard.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64
_MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_2 = -7723592293110705685  # 0x94D049BB133111EB
MURMUR_1 = -2048144789  # 0x85EBCA6B as int32
MURMUR_2 = -1028477387  # 0xC2B2AE35
WEYL = -1640531527  # 0x9E3779B9: neighbouring counters start far apart


@dataclass(frozen=True)
class DrawKey:
    """The key of the noise: one seed for the solve; an id and the current outer iteration per problem."""

    seed: int
    ids: Tensor  # (B,) int64
    outer: Tensor  # (B,) int64

    def take(self, index: Tensor) -> DrawKey:
        """The keys of the problems in `index`."""
        return DrawKey(self.seed, self.ids[index], self.outer[index])


def words(key: DrawKey, stream: int = 0) -> Tensor:
    """The mixed key of each problem, (B,) int64: two words of 32 bits."""
    return _mix64(_mix64(_mix64(torch.full_like(key.ids, key.seed)) + key.ids) + key.outer * 1_000_003 + stream)


def standard_normal(
    key: DrawKey, rows: int, samples: range, dtype: torch.dtype = torch.float32, stream: int = 0
) -> Tensor:
    """Independent N(0, 1) draws (rows, B, S) for the samples in a range, made in single precision and cast to `dtype`.

    A problem's draws are the same in any batch, a sample's in any range that contains it. `stream` separates
    draws of one key that serve different purposes. Row i and row i + ceil(rows / 2) are a Box-Muller pair.
    """
    half, width = (rows + 1) // 2, len(samples)
    mixed = words(key, stream)
    high, low = ((mixed >> 32).to(torch.int32).view(1, -1, 1), mixed.to(torch.int32).view(1, -1, 1))
    # Counted by sample first, so that a sample keeps its numbers in a range of any length.
    index = torch.arange(half, dtype=torch.int32, device=key.ids.device).view(half, 1, 1)
    number = torch.arange(samples.start, samples.stop, dtype=torch.int32, device=key.ids.device)
    counter = (number * half).view(1, 1, width) + index
    word = _mix32_((counter * WEYL) ^ low)
    radius = _uniform(word).log_().mul_(-2.0).sqrt_()
    angle = _uniform(_mix32_(word ^ high)).mul_(2.0 * math.pi)
    normal = radius.new_empty(2 * half, key.ids.numel(), width)
    torch.mul(radius, torch.cos(angle), out=normal[:half])
    torch.mul(radius, torch.sin(angle), out=normal[half:])
    return normal[:rows].to(dtype)


def smooth_normal(key: DrawKey, knots: int, like: Tensor) -> Tensor:
    """Draws shaped as controls (B, N, m): N(0, 1) at `knots` points evenly spaced in time, linear between them."""
    N, m = like.shape[1:]
    z = standard_normal(key, knots * m, range(1), like.dtype).view(knots, m, -1).permute(2, 0, 1)
    position = torch.linspace(0, knots - 1, N, dtype=like.dtype, device=like.device)
    left = position.floor().clamp(max=knots - 2).long()
    return torch.lerp(z[:, left], z[:, left + 1], (position - left).view(-1, 1))


def _uniform(word: Tensor) -> Tensor:
    """24 bits of each word as a float32 in (0, 1]."""
    return ((word >> 8) & 0xFFFFFF).to(torch.float32).add_(0.5).mul_(2.0**-24)


def _mix32_(z: Tensor) -> Tensor:
    """MurmurHash3's 32-bit finaliser, in place; products wrap, and shifts are made logical by a mask."""
    z ^= (z >> 16) & 0xFFFF
    z *= MURMUR_1
    z ^= (z >> 13) & 0x7FFFF
    z *= MURMUR_2
    z ^= (z >> 16) & 0xFFFF
    return z


def _mix64(z: Tensor) -> Tensor:
    """SplitMix64's finaliser; int64 products wrap, and shifts are made logical by a mask."""
    z = z + _GOLDEN
    z = (z ^ ((z >> 30) & ((1 << 34) - 1))) * _MIX_1
    z = (z ^ ((z >> 27) & ((1 << 37) - 1))) * _MIX_2
    return z ^ ((z >> 31) & ((1 << 33) - 1))


def scattered(like: Tensor) -> Tensor:
    """Numbers between -1 and 1 in the shape of `like`, without an order, the same in every process."""
    index = torch.arange(1, like.numel() + 1, dtype=like.dtype, device=like.device)
    return (index * 1.618).cos().reshape(like.shape)


def uniform(seed: int, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Numbers between 0 and 1 in this shape, with the type and on the device of `like`: the same on every device, and
    within `torch.autograd.functional.jacobian(..., vectorize=True)`.
    """
    draws = torch.Generator("cpu").manual_seed(seed)
    with _outside_vmap():
        return torch.rand(shape, dtype=like.dtype, generator=draws, device="cpu").to(like.device)


@contextmanager
def _outside_vmap() -> Iterator[None]:
    """Leave the vmap of `torch.autograd.functional`, in which nothing random is allowed, not even with a seed."""
    depth = torch._C._vmapmode_increment_nesting() - 1
    for _ in range(depth + 1):
        torch._C._vmapmode_decrement_nesting()
    try:
        yield
    finally:
        for _ in range(depth):
            torch._C._vmapmode_increment_nesting()
