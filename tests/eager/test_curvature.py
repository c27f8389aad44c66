"""First and second derivatives of functions of one knot, each way that PyTorch has."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchgco.eager.functions import by_forward, by_reverse, expansion_of, flat

D = torch.float64


def test_second_derivatives_agree_and_fall_back() -> None:
    w = torch.rand(2, 5, 3, dtype=D)
    weights = torch.rand(2, 5, 2, dtype=D)
    smooth = lambda w: torch.stack((w[..., 0].sin() * w[..., 1], w.square().sum(-1).exp()), dim=-1)
    for mine, theirs in zip(by_reverse(smooth, w, weights), by_forward(smooth, w, weights), strict=True):
        torch.testing.assert_close(mine, theirs)
    assert expansion_of(smooth, w) is by_reverse
    with torch.inference_mode():
        assert expansion_of(smooth, w) is by_forward

    def once(w: Tensor) -> Tensor:
        if w.requires_grad:  # as operations do that have no derivatives in reverse
            raise RuntimeError
        return w[..., :2].square()

    assert expansion_of(once, w) is flat
    J, H = flat(once, w, weights)
    assert not bool(H.any())
    torch.testing.assert_close(J[..., 0, :], torch.cat((2.0 * w[..., :1], 0.0 * w[..., 1:]), dim=-1))


# Branches that aren't taken -------------------------------------------------------------------------------------------

BRANCHES = {  # with places where the other branch has no slopes, or infinite ones
    "sqrt": lambda z: torch.where(z > 0, 0.1 * z.sqrt() + z, 0.2 * z),
    "log": lambda z: torch.where(z > 0.1, z.log(), z),
    "quotient": lambda z: torch.where(z != 0, z.sin() / z, 1.0),
    "asin": lambda z: torch.where(z.abs() < 0.5, z.asin(), z),
    "net": lambda z: torch.where(z > 0, torch.tanh(torch.stack((z.sqrt(), 1.0 - z), dim=-1)).sum(-1), 0.2 * z),
}


@pytest.mark.parametrize("way", [by_reverse, by_forward])
@pytest.mark.parametrize("name", BRANCHES)
def test_derivatives_of_a_branch_not_taken_do_not_count(name: str, way) -> None:
    z = torch.tensor([-1.0, 0.0, 0.05, 0.3, 0.8], dtype=D)
    branch = BRANCHES[name]
    flat_at = lambda z: branch(z) if name != "quotient" else torch.where(z == 0, 1.0, branch(z))
    w, weights = torch.stack((z, z.flip(0)), dim=-1).unsqueeze(0), torch.ones(1, 5, 1, dtype=D)
    J, H = way(lambda w: branch(w[..., :1]) * (1.0 + w[..., 1:]), w, weights)
    assert bool(torch.isfinite(J).all()) and bool(torch.isfinite(H).all())
    inner = (z.abs() > 1e-3) & ((z.abs() - 0.5).abs() > 1e-3)  # differences don't cross from branch to branch
    h, other = 1e-4, 1.0 + z.flip(0)
    slope, bend = (flat_at(z + h) - flat_at(z - h)) / (2 * h), (flat_at(z + h) - 2 * flat_at(z) + flat_at(z - h)) / h**2
    torch.testing.assert_close(J[0, inner, 0, 0], (slope * other)[inner], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(J[0, :, 0, 1], branch(z))
    torch.testing.assert_close(H[0, inner, 0, 0], (bend * other)[inner], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(H[0, inner, 0, 1], slope[inner], rtol=1e-4, atol=1e-6)
