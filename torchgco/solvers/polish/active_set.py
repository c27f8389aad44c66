"""Strictly convex quadratic programs by their dual: which rows are active, and their multipliers."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

BLOCK_TRIES = 10  # exchanges of whole blocks without progress before rows are exchanged one at a time
EXCHANGES = 200  # at most
EXCHANGE_SLACK = 1e-12  # share of a row's scale: exchange tolerance, and regularisation of dependent rows


def multipliers(S: Tensor, b: Tensor, free: Tensor, start: Tensor) -> Tensor | None:
    """lam (q,) with b - S lam <= 0, lam >= 0, complementary; on `free` rows b - S lam = 0 and lam of any sign.

    None where no such lam is found: the rows contradict each other, or nearly.

    Rows enter and leave the working set in blocks: rows with a negative multiplier leave, violated rows enter. Where
    that makes no progress they change one at a time, the last first, which terminates for every positive definite S.

    Args:
        S: (q, q), positive semidefinite.
        b: (q,).
        free: (q,) bool, equality rows.
        start: (q,) bool, the first working set, to which free rows are added.
    """
    if b.numel() == 0:
        return torch.zeros_like(b)
    scale = S.diagonal().clamp(min=torch.finfo(S.dtype).tiny)
    S = S + torch.diag(EXCHANGE_SLACK * scale)
    working = start | free
    fewest, tries = b.numel() + 1, BLOCK_TRIES
    for _ in range(EXCHANGES):
        lam = _on(S, b, working)
        slack = b - S @ lam
        # Both measured as multipliers, so that one tolerance serves rows of any unit.
        wrong = torch.where(working, (lam < 0) & ~free, slack / scale > EXCHANGE_SLACK * (1.0 + lam.abs().max()))
        count = int(wrong.sum())
        if count == 0:
            return torch.where(free, lam, lam.clamp(min=0.0))
        if count < fewest:
            fewest, tries = count, BLOCK_TRIES
        elif tries > 0:
            tries -= 1
        else:
            wrong = torch.zeros_like(wrong).index_fill(0, wrong.nonzero()[-1], True)
        working = working ^ wrong
    return None


def projected(V: Tensor, b: Tensor, free: Tensor) -> Tensor | None:
    """`multipliers` for S = V'V, by the least-distance program min |y| with b + V'y <= 0 (Lawson and Hanson, 1974).

    Slower, but reliable where rows depend on each other, as those of a bound that holds at many knots in succession.
    """
    length = V.norm(dim=0).clamp(min=torch.finfo(V.dtype).tiny)
    E = (torch.cat((-V, b.unsqueeze(0))) / length).cpu().numpy()
    E = np.concatenate((E, -E[:, free.cpu().numpy()]), axis=1)  # a free row's multiplier may have either sign
    target = np.zeros(len(E))
    target[-1] = 1.0
    try:
        pushes = scipy.optimize.nnls(E, target, maxiter=10 * E.shape[1])[0]
    except RuntimeError:
        return None
    distance = 1.0 - float(E[-1] @ pushes)
    if not distance > EXCHANGE_SLACK:
        return None  # the rows contradict each other
    lam = b.new_tensor(pushes[: b.numel()]) / distance
    lam[free] -= b.new_tensor(pushes[b.numel() :]) / distance
    return lam / length


def _on(S: Tensor, b: Tensor, working: Tensor) -> Tensor:
    """lam with b - S lam = 0 on the working rows, zero elsewhere."""
    rows, lam = working.nonzero().flatten(), torch.zeros_like(b)
    if rows.numel() > 0:
        L, _ = torch.linalg.cholesky_ex(S[rows][:, rows])
        lam[rows] = torch.cholesky_solve(b[rows].unsqueeze(-1), L).squeeze(-1)
    return lam
