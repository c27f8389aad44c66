"""The solution as a function of the residual of its KKT conditions: dz = -K^-1 dr, for a batch at once.

With K symmetric, a vector-Jacobian product is one solve with the upstream gradients as right hand sides, whose solution
autodiff takes through the residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from torch import Tensor, _add_batch_dim, _remove_batch_dim  # type: ignore[import]
from torch._C._functorch import is_legacy_batchedtensor  # type: ignore[import]
from torch.autograd.function import once_differentiable

from torchgco.base.gradients import not_recording
from torchgco.kernels import interior_of
from torchgco.lagrangian.kkt import RightSides
from torchgco.problem.problem import Problem

NO_SECOND = (
    "solutions have no second derivatives: take differences of gradients, or, for a sum of squares, J'J of the Jacobian"
)


@dataclass(frozen=True)
class System:
    """The linear systems of B solutions; see `lagrangian.kkt`."""

    problem: Problem
    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    multipliers: tuple[Tensor, ...]
    active: Tensor  # (B, R) bool
    give: Tensor | None = None  # (B, R)
    K: Tensor | None = None  # (B, N, m, n)

    def once(self, x: Tensor, u: Tensor, gaps: Tensor | None, rows: Tensor) -> tuple[Tensor, ...]:
        """`solve` of one right hand side, or of all those that `is_grads_batched` and `vectorize` hide in one."""
        parts = [x, u, torch.zeros_like(x[:, 1:]) if gaps is None else gaps, rows]
        if not any(map(is_legacy_batchedtensor, parts)):
            return tuple(z[0] for z in self.solve(*(z.unsqueeze(0) for z in parts)))
        level = torch._C._vmapmode_increment_nesting() - 1
        torch._C._vmapmode_decrement_nesting()
        hidden = next(z for z in parts if is_legacy_batchedtensor(z))
        count = _remove_batch_dim(hidden, level, 1, 0).shape[0]
        plain = [_remove_batch_dim(z, level, count, 0) for z in parts]
        if any(map(is_legacy_batchedtensor, plain)):
            raise RuntimeError("solutions: one `vectorize` or `is_grads_batched` within another isn't served")
        return tuple(_add_batch_dim(z, 0, level) for z in self.solve(*plain))

    def solve(self, x: Tensor, u: Tensor, gaps: Tensor | None, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """-K^-1 of right hand sides x (C, B, N+1, n), u (C, B, N, m), gaps (C, B, N, n), rows (C, B, R); as these."""
        gaps = torch.zeros_like(x[:, :, 1:]) if gaps is None else gaps
        if self.problem.B == 0:
            return x, u, gaps, rows
        with not_recording():
            n = self.problem.n
            a = torch.cat((x, torch.nn.functional.pad(u, (0, 0, 0, 1))), dim=-1)
            right = RightSides(a, gaps, rows)
            point = self.X, self.U, self.multipliers, self.active
            step = interior_of(self.problem).kkt(self.problem, *point, right, self.give, self.K)
        return step.z[..., :n], step.z[:, :, :-1, n:], step.y, step.v


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
        ctx.save_for_backward(*inputs[2:])
        ctx.save_for_forward(*inputs[2:])

    @staticmethod
    def backward(ctx: Any, X: Tensor, U: Tensor, lam: Tensor, cost: Tensor) -> tuple[Any, ...]:
        return None, None, *Adjoint.apply(ctx.system, X, U, lam, cost, *Fixed.apply(*ctx.saved_tensors))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> tuple[Tensor, ...]:
        return Forward.apply(ctx.system, *tangents[2:], *ctx.saved_tensors)  # type: ignore[return-value]


class Last(torch.autograd.Function):
    """A function whose derivatives would be second ones."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> NoReturn:
        raise RuntimeError(NO_SECOND)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:
        raise RuntimeError(NO_SECOND)


class Forward(Last):
    """Tangents of X, U, multipliers and costs from those of the residual's parts; of the parts, too, as `Adjoint`."""

    @staticmethod
    def forward(
        system: System, x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, lagrangian: Tensor, *parts: Tensor
    ) -> tuple[Tensor, ...]:
        X, U, _, lam = system.once(x, u, gaps, rows)
        return X, U, lam, lagrangian.clone()


class Adjoint(Last):
    """Gradients by the residual's parts, from upstream ones of X, U, multipliers and costs, of which it is linear.

    It is a function of its own, of the parts too, for two reasons: a rule for many right hand sides at once, and that a
    second derivative by the parts is refused. Autodiff would take it at a fixed solution, without an error.
    """

    @staticmethod
    def forward(system: System, X: Tensor, U: Tensor, lam: Tensor, cost: Tensor, *parts: Tensor) -> tuple[Tensor, ...]:
        return *system.once(X, U, None, lam), cost.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.system, ctx.parts = inputs[0], [torch.empty_like(z, device="meta") for z in inputs[5:]]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, x: Tensor, u: Tensor, gaps: Tensor, rows: Tensor, cost: Tensor) -> tuple[Any, ...]:
        X, U, _, lam = ctx.system.once(x, u, gaps, rows)
        return None, X, U, lam, cost.clone(), *(torch.zeros_like(z, device=x.device) for z in ctx.parts)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], system: System, *arguments: Tensor) -> tuple[Any, Any]:
        X, U, lam, cost = (
            z.expand(info.batch_size, *z.shape) if dim is None else z.movedim(dim, 0)
            for z, dim in zip(arguments[:4], in_dims[1:5], strict=True)
        )
        return (*system.solve(X, U, None, lam), cost.clone()), (0,) * 5


class Fixed(Last):
    """The residual's parts, for gradients at which they are held: a derivative that leads here is a second one."""

    generate_vmap_rule = True

    @staticmethod
    def forward(*parts: Tensor) -> tuple[Tensor, ...]:
        return tuple(z.view_as(z) for z in parts)
