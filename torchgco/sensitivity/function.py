"""The solution as a function of the residual of its KKT conditions: dz = -K^-1 dr, for a batch at once.

With K symmetric, a vector-Jacobian product is one solve with the upstream gradients as right hand sides, whose solution
autodiff takes through the residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchgco.kernels import interior_of
from torchgco.lagrangian.kkt import RightSides
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class System:
    """The linear systems of B solutions; see `lagrangian.kkt`."""

    problem: Problem
    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    multipliers: tuple[Tensor, ...]
    active: Tensor  # (B, R) bool

    def solve(self, x: Tensor, u: Tensor, gaps: Tensor | None, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """-K^-1 of right hand sides x (C, B, N+1, n), u (C, B, N, m), gaps (C, B, N, n), rows (C, B, R); as these."""
        with torch.no_grad():
            n, gaps = self.problem.n, torch.zeros_like(x[:, :, 1:]) if gaps is None else gaps
            a = torch.cat((x, torch.nn.functional.pad(u, (0, 0, 0, 1))), dim=-1)
            right = RightSides(a, gaps, rows)
            found = interior_of(self.problem).kkt(self.problem, self.X, self.U, self.multipliers, self.active, right)
        return found.z[..., :n], found.z[:, :, :-1, n:], found.y, found.v


class Solved(torch.autograd.Function):
    """X, U, multipliers (B, R) and costs as functions of a `residual.Residual`'s parts."""

    @staticmethod
    def forward(
        system: System, values: tuple[Tensor, ...], x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, lagrangian: Tensor
    ) -> tuple[Tensor, ...]:
        return tuple(value.clone() for value in values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.system = inputs[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, X: Tensor, U: Tensor, lam: Tensor, cost: Tensor) -> tuple[Any, ...]:
        x, u, gaps, rows = Adjoint.apply(ctx.system, X, U, lam)
        return None, None, x, u, gaps, rows, cost

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, *tangents: Tensor) -> tuple[Tensor, ...]:
        *sides, lagrangian = tangents
        x, u, _, rows = ctx.system.solve(*(side.unsqueeze(0) for side in sides))
        return x[0], u[0], rows[0], lagrangian


class Adjoint(torch.autograd.Function):
    """-K^-1 of upstream gradients of X, U and multipliers; a function of its own for the sake of its vmap rule."""

    @staticmethod
    def forward(system: System, X: Tensor, U: Tensor, lam: Tensor) -> tuple[Tensor, ...]:
        return tuple(part[0] for part in system.solve(X[None], U[None], None, lam[None]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], system: System, *upstream: Tensor) -> tuple[Any, Any]:
        many = (
            part.expand(info.batch_size, *part.shape) if dim is None else part.movedim(dim, 0)
            for part, dim in zip(upstream, in_dims[1:], strict=True)
        )
        X, U, lam = many
        return system.solve(X, U, None, lam), (0, 0, 0, 0)
