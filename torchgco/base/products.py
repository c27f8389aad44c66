"""Products of small matrices whose bits depend on neither the batch nor addresses, as those of matrix libraries may."""

from __future__ import annotations

import torch
from torch import Tensor

TAYLOR = 14  # terms of an exponential: of a matrix of norm 0.5 the next one is 2e-17
HALVINGS = 64  # of a matrix before its series: what is larger has no finite exponential, or a nilpotent one
REPEATS = 1e-12  # share of a row that is left of it beside the others where it depends on these


def product(a: Tensor, b: Tensor) -> Tensor:
    """a @ b of (..., p, q), (..., q, r)."""
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)


def exponential(a: Tensor) -> Tensor:
    """The exponentials of matrices (B, n, n), by their Taylor series at a share of them, squared again."""
    norm = a.abs().amax((1, 2)) * a.shape[-1]
    halvings = torch.ceil(torch.log2(2.0 * norm)).nan_to_num(0.0, 0.0, 0.0).clamp(0, HALVINGS)
    small, eye = a * torch.exp2(-halvings).view(-1, 1, 1), torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    power = eye + small / TAYLOR
    for k in range(TAYLOR - 1, 0, -1):
        power = eye + product(small, power) / k
    for done in range(int(halvings.amax()) if len(a) else 0):
        power = torch.where((done < halvings).view(-1, 1, 1), product(power, power), power)
    return power


def least_squares(rows: Tensor, values: Tensor) -> Tensor:
    """The smallest u (B, q) with rows u = values, of (B, p, q), (B, p); rows that depend on those before are left out.

    By Gram and Schmidt, twice for each row.
    """
    known, solved = rows.new_zeros(rows.shape[0], 0, rows.shape[2]), rows.new_zeros(rows.shape[0], 0)
    for row, value in zip(rows.unbind(1), values.unbind(1), strict=True):
        size = row.square().sum(-1, keepdim=True).sqrt()
        for _ in range(2):
            shares = (known * row.unsqueeze(1)).sum(-1)
            row, value = row - (shares.unsqueeze(-1) * known).sum(1), value - (shares * solved).sum(-1)
        left = row.square().sum(-1, keepdim=True).sqrt()
        kept = left > REPEATS * size
        row = torch.where(kept, row / left, 0.0)
        known = torch.cat((known, row.unsqueeze(1)), dim=1)
        solved = torch.cat((solved, torch.where(kept, value.unsqueeze(-1) / left, 0.0)), dim=1)
    return (solved.unsqueeze(-1) * known).sum(1)
