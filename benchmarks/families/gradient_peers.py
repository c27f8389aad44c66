"""Other differentiable solvers on the bounded linear-quadratic problems, where they are installed: see `gradients`.

mpc.pytorch knows bounds on controls alone, and cvxpylayers convex problems alone. Both have the options with which they
came closest here.
"""

from __future__ import annotations

import contextlib
import io
import time
import warnings
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from benchmarks.lib.page import markdown

D = torch.float64
CONES = {"solve_method": "Clarabel", "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}
RIGHT = 1e-6  # largest error of a gradient, as a share of it

Numbers = Mapping[str, Tensor]
Found = tuple[tuple[Tensor, ...], float, float]  # gradients by x0 and b, seconds forward and backward


def mpc_pytorch(th: Numbers, aim: Tensor) -> Found:
    """The linear-quadratic solver of Amos et al. (2018), with projected Newton steps for the bounds."""
    from mpc import mpc  # type: ignore[import]

    x0, b = (th[name].clone().requires_grad_() for name in ("x0", "b"))
    (B, n), N, m = x0.shape, *aim.shape[1:]
    C = torch.zeros(N + 1, B, n + m, n + m, dtype=D)
    C[..., :n, :n], C[..., n:, n:] = torch.diag_embed(th["Q"]), torch.diag_embed(th["R"])
    F = torch.cat((th["A"], th["B"]), -1).expand(N, B, n, n + m).contiguous()
    solver = mpc.MPC(
        n, m, N + 1, u_lower=-1.0, u_upper=1.0, lqr_iter=100, eps=1e-10, verbose=-1, exit_unconverged=False,
        detach_unconverged=False, n_batch=B,
    )  # fmt: skip
    model, cost = mpc.LinDx(F, b.expand(N, B, n)), mpc.QuadCost(C, torch.zeros(N + 1, B, n + m, dtype=D))
    began = time.process_time()
    _, u, _ = solver(x0, cost, model)
    return _differentiated(u[:N].transpose(0, 1), aim, (x0, b), began)


def cvxpylayers(th: Numbers, aim: Tensor) -> Found:
    """Convex problems by a cone solver (Agrawal et al. 2019); made once, and not counted."""
    import cvxpy as cp  # type: ignore[import]
    from cvxpylayers.torch import CvxpyLayer  # type: ignore[import]

    x0, b = (th[name].clone().requires_grad_() for name in ("x0", "b"))
    (_, n), N, m = x0.shape, *aim.shape[1:]
    X, U, start, offset = cp.Variable((N + 1, n)), cp.Variable((N, m)), cp.Parameter(n), cp.Parameter(n)
    A, M = th["A"][0].numpy(), th["B"][0].numpy()
    rows = [X[0] == start, U <= 1, U >= -1, *(X[k + 1] == A @ X[k] + M @ U[k] + offset for k in range(N))]
    cost = 0.5 * cp.sum_squares(X) + 0.05 * cp.sum_squares(U)
    layer = CvxpyLayer(cp.Problem(cp.Minimize(cost), rows), parameters=[start, offset], variables=[U])
    began = time.process_time()
    (u,) = layer(x0, b, solver_args=CONES)
    return _differentiated(u, aim, (x0, b), began)


def _differentiated(u: Tensor, aim: Tensor, leaves: tuple[Tensor, ...], began: float) -> Found:
    forward, middle = time.process_time() - began, time.process_time()
    slopes = torch.autograd.grad((aim * u).sum(), leaves)
    return slopes, forward, time.process_time() - middle


PEERS: dict[str, Callable[[Numbers, Tensor], Found]] = {"mpc.pytorch": mpc_pytorch, "cvxpylayers": cvxpylayers}


def table(ours: Callable[[Numbers, Tensor], Found], numbers: Numbers, N: int, m: int) -> str:
    """Gradients by starts and offsets beside ours, which agree with dense linear systems to 1e-11."""
    aim = torch.randn(len(numbers["x0"]), N, m, dtype=D)
    ours(numbers, aim)  # compiles
    want, forward, backward = ours(numbers, aim)
    rows = [["torchgco", "-", "-", f"{1e3 * forward:.0f}", f"{1e3 * backward:.0f}"]]
    for name, peer in PEERS.items():
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                found, forward, backward = peer(numbers, aim)
        except ImportError:
            rows.append([name, "not installed", "-", "-", "-"])
            continue
        error = torch.stack([(a - b).norm(dim=1) / b.norm(dim=1) for a, b in zip(found, want, strict=True)]).amax(0)
        right = f"{int((error < RIGHT).sum())} of {len(error)}"
        rows.append([name, right, f"{error.median():.0e}", f"{1e3 * forward:.0f}", f"{1e3 * backward:.0f}"])
    heads = ["solver", f"gradients within {RIGHT:.0e} of ours", "median error", "solve, ms", "backward, ms"]
    return markdown(heads, rows)
