"""Normal draws that are a function of their key, not of their place in a batch.

A draw is keyed by (seed, element id, outer iteration) and numbered by a counter within. The bits come from the
SplitMix64 finaliser (Steele, Lea and Flood, OOPSLA 2014) of the counter, computed as int64 tensors, so that an element
sees the same noise alone, in any batch and in any shard.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64
_MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_2 = -7723592293110705685  # 0x94D049BB133111EB


@dataclass(frozen=True)
class DrawKey:
    """Whose noise it is: one seed for the solve, one id per element, and the outer iteration it is in."""

    seed: int
    ids: Tensor  # (B,) int64
    outer: Tensor  # (B,) int64
    began: Tensor | None = None  # (B,) int64: where the present attempt began; None: with the solve

    @property
    def age(self) -> Tensor:
        """Outer iterations of the present attempt, (B,)."""
        return self.outer if self.began is None else self.outer - self.began

    def take(self, index: Tensor) -> DrawKey:
        """The keys of the elements in `index`."""
        began = None if self.began is None else self.began[index]
        return DrawKey(self.seed, self.ids[index], self.outer[index], began)


def standard_normal(key: DrawKey, shape: tuple[int, ...], dtype: torch.dtype, stream: int = 0) -> Tensor:
    """Independent N(0, 1) draws (B, *shape), the same for an element whatever batch it is in.

    `stream` separates draws of one key that serve different purposes.
    """
    count = math.prod(shape)
    half = (count + 1) // 2
    base = _mix(_mix(_mix(torch.full_like(key.ids, key.seed)) + key.ids) + key.outer * 1_000_003 + stream)
    counter = torch.arange(half, dtype=torch.int64, device=key.ids.device)
    bits = _mix(base.unsqueeze(-1) + counter * _GOLDEN)
    # One 64-bit word gives two 32-bit uniforms in (0, 1), and those two normals by Box and Muller.
    scale = 2.0**-32
    first = (((bits >> 32) & 0xFFFFFFFF).to(torch.float64) + 0.5) * scale
    second = ((bits & 0xFFFFFFFF).to(torch.float64) + 0.5) * scale
    radius, angle = torch.sqrt(-2.0 * torch.log(first)), (2.0 * math.pi) * second
    normal = torch.cat((radius * torch.cos(angle), radius * torch.sin(angle)), dim=-1)
    return normal[:, :count].to(dtype).reshape(-1, *shape)


def _mix(z: Tensor) -> Tensor:
    """SplitMix64's finaliser; int64 products wrap, and shifts are made logical by a mask."""
    z = z + _GOLDEN
    z = (z ^ ((z >> 30) & ((1 << 34) - 1))) * _MIX_1
    z = (z ^ ((z >> 27) & ((1 << 37) - 1))) * _MIX_2
    return z ^ ((z >> 31) & ((1 << 33) - 1))
