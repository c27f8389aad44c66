"""Native kernels where they serve, PyTorch's everywhere else: one choice for a form of problems, explained once."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchgco import rollout
from torchgco.kernels import native
from torchgco.lagrangian import Lagrangian
from torchgco.native.compiler import NativeError
from torchgco.native.engine import Engine, Terms
from torchgco.problem import Problem
from torchgco.shapes import InputError


class EagerWarning(UserWarning):
    """Native kernels can't serve a problem; PyTorch's do, which takes longer."""


def engine_of(problem: Problem) -> Engine | None:
    """The library for problems of this form, compiled at the first call; None where PyTorch's kernels serve.

    They do on a GPU, in single precision, where the process has chosen them (`kernels.use_native`), and where a part
    can't be traced or nothing compiles, which an EagerWarning explains.
    """
    if not native() or problem.x0.dtype != torch.float64 or problem.x0.device.type != "cpu":
        return None
    if "engine" not in problem.form:
        try:
            problem.form["engine"] = Engine(problem)
        except (InputError, NativeError) as error:
            problem.form["engine"] = None
            reason = str(error).splitlines()[0]
            warnings.warn(f"solved by PyTorch's kernels, some 20 times slower: {reason}", EagerWarning, stacklevel=4)
    return problem.form["engine"]


def open_loop(problem: Problem, U: Tensor) -> Tensor:
    """X (B, N+1, n) from controls U (B, N, m)."""
    engine = engine_of(problem)
    return rollout.open_loop(problem.dynamics, problem.x0, U) if engine is None else engine.open_loop(problem, U)


def value(lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
    """J_var (B,) and L_M (B,)."""
    engine = engine_of(lagrangian.problem)
    return lagrangian.value(X, U) if engine is None else engine.value(lagrangian.problem, X, U, terms_of(lagrangian))


def terms_of(lagrangian: Lagrangian) -> Terms:
    """What the Lagrangian adds to the cost, as the library takes it."""
    return Terms(lagrangian.duals, lagrangian.guide, lagrangian.clip)
