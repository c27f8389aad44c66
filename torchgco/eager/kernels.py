"""The interior point's kernels in PyTorch, behind the same interface as those in C."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.eager.kkt import kkt
from torchgco.eager.loop import solve
from torchgco.eager.model import Model
from torchgco.eager.rows import is_function, joined
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.kkt import KktSolve, RightSides
from torchgco.problem.border import ONE_KNOT
from torchgco.problem.joined import scattered
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale

STATE_OFFSET = 1e-3  # of the states at which rows are looked at, as a share of 1 + |x|
LEAST_VIOLATION = 100.0  # units of the last bit of lengths of 1 m, below which a rollout doesn't meet rows


@dataclass(frozen=True)
class EagerInterior:
    """The interior point for problems of any device, dtype and code: see `native.interior.InteriorEngine`.

    One batched evaluation of all knots of all problems serves an iteration, and one loop over the knots, for a batch of
    small matrices each, its step. Where PyTorch differentiates a part once only, its curvature counts as 0. The result
    of a problem does not depend on the rest of the batch, bit by bit, as far as this holds for its own code: a shared
    matrix times a batch, as in a net, rounds differently in batches of other sizes.

    Raises:
        InputError: rows of a constraint that join knots.
    """

    model: Model

    @classmethod
    def of(cls, problem: Problem) -> EagerInterior:
        """The kernels of a form of problems."""
        for i, part in enumerate(problem.constraints):
            if is_users(part) and not is_function(part) and joins_knots(part, problem):
                raise InputError(f"constraints[{i}].value", ONE_KNOT, "rows that change with other knots")
        return cls(Model.of(problem))

    def solve(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], barrier: Tensor,
        scale: CostScale, options: BarrierOptions,
    ) -> dict[str, Tensor]:  # fmt: skip
        """As `native.interior.InteriorEngine.solve`; options that rounding in the problem's dtype can't meet are raised
        to what it can (`fitted`).
        """
        return solve(self.model.among(problem), X, U, multipliers, barrier, scale, fitted(options, X.dtype))

    def kkt(
        self, problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor,
        right: RightSides, give: Tensor | None = None, K: Tensor | None = None,
    ) -> KktSolve:  # fmt: skip
        """As `native.interior.InteriorEngine.kkt`, in float64."""
        return kkt(self.model.among(problem), X, U, multipliers, active, right, give, K)


def fitted(options: BarrierOptions, dtype: torch.dtype) -> BarrierOptions:
    """Options for a precision: as they are in float64.

    Shares of rounding (pivots) grow with the unit of the last bit, by 2^29 in float32, and the dual regularisation,
    whose inverse is added to curvatures, with its root. The end test asks for an error that grows with the third root
    (1e-8 becomes 8e-6), and takes one that falls no further below the root (2.3e-4) for rounding. Rows are met to 100
    units of the last bit at least (1.2e-5).
    """
    coarser = torch.finfo(dtype).eps / torch.finfo(torch.float64).eps
    if coarser == 1.0:
        return options
    rounding = options.tol * coarser**0.5
    return replace(
        options,
        pivot=options.pivot * coarser,
        tau_max=1.0 - (1.0 - options.tau_max) * coarser,
        jacobian_regularization_value=options.jacobian_regularization_value * coarser**0.5,
        tol=options.tol * coarser ** (1.0 / 3.0),
        rounding=rounding,
        acceptable_tol=max(options.acceptable_tol, rounding),
        constr_viol_tol=least_violation(options.constr_viol_tol, dtype),
    )


def least_violation(tolerance: float, dtype: torch.dtype) -> float:
    """The violation up to which a trajectory counts as feasible, at least what its precision can meet."""
    return max(tolerance, LEAST_VIOLATION * torch.finfo(dtype).eps)


def joins_knots(part: Constraint, problem: Problem) -> bool:
    """Whether rows of a constraint change with another knot than their own.

    Any two knots differ in a digit of their numbers: knots with that digit change, and rows of the others are looked
    at.
    """
    one, part = problem.take(slice(0, 1)), part.take(slice(0, 1))
    X, U = one.at_rest
    z = joined(X, U)
    z = z + STATE_OFFSET * (1.0 + z.abs()) * (1.0 + 0.5 * scattered(z))
    value, n = lambda z: part.value(z[..., :n], z[:, :-1, n:]), problem.n
    place = torch.arange(problem.N + 1, device=z.device)
    for digit in range(problem.N.bit_length()):
        for moves in ((place >> digit & 1).bool(), ~(place >> digit & 1).bool()):
            tangent = moves.to(z.dtype).view(1, -1, 1) * (1.0 + 0.5 * scattered(z))
            change = torch.func.jvp(value, (z,), (tangent,))[1]
            if bool((change[:, ~moves[part.knots]] != 0).any()):
                return True
    return False
