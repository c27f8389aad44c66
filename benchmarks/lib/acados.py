"""acados as a peer: the problem's own model, cost and constraints, solved in a separate environment.

The expressions are those that FATROP gets (`torchgco.baselines.nlp`), written to a file as instructions: two versions
of CasADi can't read each other's own files.
"""

from __future__ import annotations

import json
import signal
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.baselines.nlp import Program, transcribe
from torchgco.constraints.base import Constraint
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics.rollout import open_loop
from torchgco.obstacles.spheres import BoundSpheres, product_matrices
from torchgco.problem.problem import Problem

ENVIRONMENT = Path(__file__).resolve().parents[2] / ".venv-acados"  # made by `make`
WORKER = Path(__file__).with_name("acados_worker.py")


@dataclass(frozen=True)
class Answer:
    """Results of acados for B problems. Times exclude set-up and setting a problem's numbers."""

    U: Tensor  # (B, N, m)
    status: np.ndarray  # (B,): 0 converged, 2 out of iterations, 4 no solution of a quadratic program
    iterations: np.ndarray  # (B,), of SQP
    wall: np.ndarray  # (B,), s
    processor: np.ndarray  # (B,), s
    setup: float  # s: to generate and compile code


def version() -> str:
    """The version of the installed wheel, or "not installed"."""
    found = ENVIRONMENT.glob("lib/python*/site-packages/comma_deps_acados-*.dist-info")
    return next((path.name.removesuffix(".dist-info").split("-")[1] for path in found), "not installed")


def installed() -> bool:
    """Whether acados has an environment here."""
    return version() != "not installed"


def fly(
    problem: Problem,
    U: Tensor,
    folder: Path,
    program: Program | None = None,
    limit: int | None = None,
) -> Answer:
    """Solve all problems, one after the other, from guesses U (B, N, m) and their rollout.

    Args:
        problem, U: the problems and their guesses.
        folder: where files are written and code is compiled; a form that was compiled there isn't compiled again.
        program: as for `write`.
        limit: s of processor time per problem. None: no limit.

    Raises:
        InputError: a problem that can't be written down for acados.
        TimeoutError: a problem took longer than `limit`.
        RuntimeError: acados failed; the message holds the end of its output.
    """
    X = open_loop(problem.dynamics, problem.x0, U)
    write(problem, torch.where(torch.isfinite(X), X, problem.x0.unsqueeze(1)), U, folder, program)
    # Isolated, as `import acados` would find this file beside the worker.
    command = [str(ENVIRONMENT / "bin" / "python"), "-I", str(WORKER), str(folder)]
    done = subprocess.run(command + ([] if limit is None else [str(limit)]), capture_output=True, text=True)
    if done.returncode == -signal.SIGXCPU:
        raise TimeoutError(f"acados took longer than {limit} s")
    if done.returncode != 0 or not (folder / "answer.npz").is_file():
        raise RuntimeError(f"acados ended with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return read(folder)


def read(folder: Path) -> Answer:
    """The worker's answer."""
    with np.load(folder / "answer.npz") as file:
        found = dict(file)
    return Answer(torch.from_numpy(found.pop("U")), setup=float(found.pop("setup")), **found)


def program_of(problem: Problem) -> Program:
    """The program of a batch, with moving spheres as resting ones: they differ from knot to knot in their numbers."""
    return transcribe(_at_knots(problem, 0) if _moving(problem) else problem)


def write(problem: Problem, X: Tensor, U: Tensor, folder: Path, program: Program | None = None) -> None:
    """Write the problems in the format of the worker (see its docstring).

    Args:
        problem, X, U, folder: as for `fly`.
        program: `program_of` problems of the same form, which saves the time to build it.

    Raises:
        InputError: a cost that isn't diagonal and quadratic, bounds on states, unbounded controls, rows that differ
            from knot to knot, other than by the motion of spheres; a program of another form.
    """
    program = program_of(problem) if program is None else program
    B, N, n, m = problem.B, problem.N, problem.n, problem.m
    p = _parameters(problem, program)
    bounds = np.stack([np.stack(program.limits.bounds(p[b, 0], N * (n + m) + n)) for b in range(B)])
    stages = bounds[:, :, : N * (n + m)].reshape(B, 2, N, n + m)
    if np.isfinite(stages[..., :n]).any() or np.isfinite(bounds[:, :, -n:]).any():
        raise InputError("constraints", "no bounds on states, for acados", "some")
    if not np.isfinite(stages[..., n:]).all():
        raise InputError("constraints", "bounds on all controls, for acados", "some without")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "answer.npz").unlink(missing_ok=True)
    (folder / "form.json").write_text(json.dumps(_form(problem, program)))
    lower, upper = stages[:, 0, :, n:], stages[:, 1, :, n:]
    np.savez(
        folder / "problems.npz", p=p, x0=problem.x0.numpy(), lower=lower, upper=upper, X=X.numpy(), U=U.numpy(),
        **_cost(problem),
    )  # fmt: skip


def _parameters(problem: Problem, program: Program) -> np.ndarray:
    """The programs' numbers (B, K, P), for K = N + 1 knots where spheres move, else K = 1."""
    if _moving(problem):
        of_problems = []
        for b in range(problem.B):
            still = _at_knots(problem, b)
            own = program.of(still)
            of_problems.append([own.values(still, k) for k in range(problem.N + 1)])
        return np.array(of_problems)
    own = program.of(problem)
    return np.array([[own.values(problem, b)] for b in range(problem.B)])


def _moving(problem: Problem) -> bool:
    return any(isinstance(c, BoundSpheres) and c.moving for c in problem.constraints)


def _at_knots(problem: Problem, b: int) -> Problem:
    """Problem b once per knot 0..N, with its spheres at rest where they are at that knot."""
    part = problem.take(torch.full((problem.N + 1,), b))
    return replace(part, constraints=[_resting(constraint, problem.N) for constraint in part.constraints])


def _resting(constraint: Constraint, N: int) -> Constraint:
    if not isinstance(constraint, BoundSpheres) or constraint.velocities is None:
        return constraint
    t = constraint.dt * torch.arange(N + 1, dtype=constraint.centers.dtype).view(-1, 1, 1)
    centers = constraint.centers + t * constraint.velocities
    made = product_matrices(centers, constraint.inflated_radii, None, constraint.absent)
    return replace(constraint, centers=centers, velocities=None, **made)


def _cost(problem: Problem) -> dict[str, np.ndarray]:
    cost, B = problem.cost, problem.B
    if not isinstance(cost, BoundQuadratic) or not cost.diagonal:
        raise InputError("cost", "a diagonal quadratic cost for acados", type(cost).__name__)
    if not all(part.shape[1] == 1 for part in (cost.Q, cost.R, cost.x_ref, cost.u_ref)):
        raise InputError("cost", "weights and references that are the same at all stages, for acados", "others")
    if not all(part is None for part in (cost.q, cost.r, cost.qf, cost.H)):
        raise InputError("cost", "no linear and no cross terms, for acados", "some")
    of_all = lambda x, u: torch.cat((x[:, 0].expand(B, -1), u[:, 0].expand(B, -1)), dim=-1).numpy()
    return {
        "weight": of_all(cost.Q, cost.R),
        "reference": of_all(cost.x_ref, cost.u_ref),
        "last_weight": cost.Qf.expand(B, -1).numpy(),
        "last_reference": cost.xf_ref.expand(B, -1).numpy(),
    }


def _form(problem: Problem, program: Program) -> dict[str, Any]:
    """Sizes, and the functions of one stage and of the last knot."""
    N, n, m = problem.N, problem.n, problem.m
    first = program.path_rows[0] > n
    knots = [_knot(program, k, n, m, N) for k in range(N + 1)]
    middle = instructions("rows", knots[N // 2])
    same = all(instructions("rows", knots[k])["steps"] == middle["steps"] for k in (1, N - 1))
    if first or not same or len(set(program.path_rows[1:-1])) > 1:
        raise InputError("constraints", "the same ones at all knots but the first, for acados", "others")
    at = (n + m) * (N // 2)
    x, u, after = (program.variables[at + a : at + b] for a, b in ((0, n), (n, n + m), (n + m, n + m + n)))
    step = ca.substitute(-program.rows[sum(program.path_rows[: N // 2]) + n * (N // 2) :][:n], after, ca.SX.zeros(n))
    flags = np.asarray(program.equality)
    ends = np.cumsum(program.path_rows) + n * np.minimum(np.arange(1, N + 2), N)
    equality = [flags[end - count : end].tolist() for end, count in zip(ends, program.path_rows, strict=True)]
    return {
        "N": N, "n": n, "m": m,
        "step": instructions("step", ([x, u, program.parameters], step)),
        "rows": middle, "equality": equality[N // 2],
        "last_rows": instructions("last_rows", knots[N]), "last_equality": equality[N],
    }  # fmt: skip


def _knot(program: Program, k: int, n: int, m: int, N: int) -> tuple[list[ca.SX], ca.SX]:
    """Variables of knot k, and its rows except the step."""
    at, end = k * (n + m), sum(program.path_rows[: k + 1]) + n * min(k + 1, N)
    u = program.variables[at + n : at + n + m] if k < N else ca.SX.sym("none", m)
    rows = program.rows[end - program.path_rows[k] : end]
    return [program.variables[at : at + n], u, program.parameters], rows


def instructions(name: str, function: tuple[list[ca.SX], ca.SX]) -> dict[str, Any]:
    """A function of scalar expressions as a list of operations: name, places written, places read, constant."""
    inputs, result = function
    names = {getattr(ca, word): word for word in dir(ca) if word.startswith("OP_")}
    f = ca.Function(name, inputs, [ca.densify(result)])
    steps = [
        (names[f.instruction_id(k)], f.instruction_output(k), f.instruction_input(k), _constant(f, k))
        for k in range(f.n_instructions())
    ]
    return {"work": f.sz_w(), "rows": result.numel(), "steps": steps}


def _constant(function: ca.Function, k: int) -> float | None:
    return function.instruction_constant(k) if function.instruction_id(k) == ca.OP_CONST else None
