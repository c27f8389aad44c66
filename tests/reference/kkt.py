"""The KKT system of one problem as one dense matrix in NumPy, and its solutions; derivatives are PyTorch's."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tests.reference.interior import Program
from torchgco import Problem


def dense_kkt(
    problem: Problem, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The matrix of [z, y, v] for w = [x_1 .. x_N, u_0 .. u_{N-1}], and the costates (N, n) at which it is taken.

    Args:
        problem: one, with a given start.
        active: rows (R,) bool, constraint by constraint, that hold as equalities; the multipliers of others count as 0.
    """
    program = Program(problem)
    w = torch.cat((X[0, 1:].flatten(), U[0].flatten()))
    lam = torch.cat([w.new_zeros(0), *(part.flatten() for part in multipliers)])[torch.from_numpy(active)]

    def held(w: Tensor) -> Tensor:
        rows = [part.value(*program.states_and_controls(w)).flatten() for part in problem.constraints]
        return torch.cat([w.new_zeros(0), *rows])[torch.from_numpy(active)]

    jacobian, hessian = torch.autograd.functional.jacobian, torch.autograd.functional.hessian
    F, A = (jacobian(of, w).numpy() for of in (program.gaps, held))
    slope = jacobian(lambda w: program.cost(w) + lam @ held(w), w).numpy()
    split = problem.N * problem.n
    y = np.linalg.solve(F[:, :split].T, -slope[:split])
    weights = torch.from_numpy(y)
    H = hessian(lambda w: program.cost(w) + weights @ program.gaps(w) + lam @ held(w), w).numpy()
    low = np.zeros((len(F) + len(A),) * 2)
    both = np.vstack((F, A))
    return np.block([[H, both.T], [both, low]]), y.reshape(problem.N, problem.n)
