"""acados on the problems in a folder: `python acados_worker.py FOLDER [LIMIT]`, in a separate environment.

That environment has only acados' wheel and NumPy, as the wheel contains a CasADi that would shadow torchgco's.
So nothing of torchgco is imported here; `acados.py` writes the folder and reads the answer.

    form.json      N, n, m; step, rows, last_rows: functions of (x, u, p) by instructions; equality, last_equality
    problems.npz   p (B, K, P), K = N+1 or 1 for all knots, x0 (B, n), lower, upper (B, N, m), weight,
                   reference (B, n + m), last_weight, last_reference (B, n), X (B, N+1, n), U (B, N, m)
    answer.npz     U (B, N, m), status, iterations, wall, processor (B,), setup (): seconds

LIMIT is the processor time per problem in seconds: the process is ended where a problem takes longer.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

TOLERANCE = 1e-3
ITERATIONS = 60  # of SQP
NO_BOUND = 1e9  # the open side of an inequality


def main(folder: Path, limit: int | None = None) -> None:
    template = _acados()
    text = (folder / "form.json").read_text()
    form = json.loads(text)
    with np.load(folder / "problems.npz") as file:
        problems = SimpleNamespace(**file)
    began = time.perf_counter()
    os.chdir(folder)  # where acados generates and compiles
    built = folder / "built.json"  # the form that was compiled last
    new = not built.is_file() or built.read_text() != text
    program = _program(template, form, problems)
    solver = template.AcadosOcpSolver(program, json_file="program.json", generate=new, build=new, verbose=False)
    built.write_text(text)
    setup = time.perf_counter() - began
    flights = [_fly(solver, form, problems, b, limit) for b in range(len(problems.x0))]
    names = ("U", "status", "iterations", "wall", "processor")
    answer = {name: np.stack(values) for name, values in zip(names, zip(*flights, strict=True), strict=True)}
    np.savez(folder / "answer.npz", setup=setup, **answer)


def _acados() -> Any:
    """The module acados_template of the wheel, which expects the folders of acados' source tree."""
    import acados

    root = Path(acados.__file__).parent
    install, templates = root / "install", root / "acados_template"
    link = install / "interfaces" / "acados_template" / "acados_template"
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.exists():
        link.unlink(missing_ok=True)  # a broken link, after the environment was moved
        link.symlink_to(templates)
    libraries = str(install / "lib")
    if libraries not in os.environ.get("LD_LIBRARY_PATH", "").split(":"):
        # The loader reads this only when a process starts.
        os.environ["LD_LIBRARY_PATH"] = f"{libraries}:{os.environ.get('LD_LIBRARY_PATH', '')}".rstrip(":")
        os.execv(sys.executable, [sys.executable, "-I", *sys.argv])  # isolated, as it began
    os.environ["ACADOS_SOURCE_DIR"], os.environ["TERA_PATH"] = str(install), str(install / "bin" / "t_renderer")
    sys.path.insert(0, str(root))
    import acados_template

    return acados_template


def _program(template: Any, form: dict[str, Any], problems: SimpleNamespace) -> Any:
    """SQP with Gauss-Newton and HPIPM without condensing; each problem's numbers are set later."""
    import casadi as ca

    N, n, m = form["N"], form["n"], form["m"]
    x, u, p = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("p", problems.p.shape[-1])
    ocp = template.AcadosOcp()
    model, cost, constraints, options = ocp.model, ocp.cost, ocp.constraints, ocp.solver_options
    model.name, model.x, model.u, model.p = "torchgco_form", x, u, p
    model.disc_dyn_expr = replay(form["step"], x, u, p)
    ocp.dims.N, ocp.parameter_values = N, problems.p[0, 0]

    cost.cost_type = cost.cost_type_e = "LINEAR_LS"
    cost.Vx, cost.Vu = np.eye(n + m, n), np.eye(n + m, m, -n)
    cost.W, cost.yref = np.diag(problems.weight[0]), problems.reference[0]
    cost.Vx_e, cost.W_e, cost.yref_e = np.eye(n), np.diag(problems.last_weight[0]), problems.last_reference[0]

    constraints.x0 = problems.x0[0]
    constraints.idxbu, constraints.lbu, constraints.ubu = np.arange(m), problems.lower[0, 0], problems.upper[0, 0]
    if form["equality"]:
        model.con_h_expr = replay(form["rows"], x, u, p)
        constraints.lh, constraints.uh = _sides(form["equality"])
    if form["last_equality"]:
        model.con_h_expr_e = replay(form["last_rows"], x, u, p)
        constraints.lh_e, constraints.uh_e = _sides(form["last_equality"])

    options.tf = float(N)  # acados weights the cost of a stage by its time step; this makes the step 1
    options.integrator_type, options.nlp_solver_type, options.hessian_approx = "DISCRETE", "SQP", "GAUSS_NEWTON"
    options.qp_solver, options.qp_solver_cond_N, options.hpipm_mode = "PARTIAL_CONDENSING_HPIPM", N, "SPEED"
    options.nlp_solver_max_iter, options.tol = ITERATIONS, TOLERANCE
    options.print_level = 0
    return ocp


def _sides(equality: list[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of rows: zero where `equality`, else at most zero."""
    return np.where(equality, 0.0, -NO_BOUND), np.zeros(len(equality))


def _fly(solver: Any, form: dict[str, Any], problems: SimpleNamespace, b: int, limit: int | None) -> tuple:
    """Set the numbers of problem b, untimed, then solve it, timed."""
    N, own = form["N"], problems.p[b]
    solver.reset()
    for k in range(N + 1):
        solver.set(k, "p", own[min(k, len(own) - 1)])
        solver.set(k, "x", problems.X[b, k])
        last = k == N
        weight, reference = (problems.last_weight, problems.last_reference) if last else (
            problems.weight, problems.reference)  # fmt: skip
        solver.cost_set(k, "W", np.diag(weight[b]))
        solver.cost_set(k, "yref", reference[b])
        if not last:
            solver.set(k, "u", problems.U[b, k])
            solver.set(k, "lbu", problems.lower[b, k])
            solver.set(k, "ubu", problems.upper[b, k])
    for side in ("lbx", "ubx"):
        solver.set(0, side, problems.x0[b])
    if limit is not None:
        end = int(time.process_time()) + 1 + limit
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (end, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    wall, processor = time.perf_counter(), time.process_time()
    status = solver.solve()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    U = np.stack([solver.get(k, "u") for k in range(N)])
    return U, status, int(solver.get_stats("sqp_iter").item()), wall, processor


def replay(function: dict[str, Any], *inputs: Any) -> Any:
    """The expression of a function, as a column, from its instructions (`acados.instructions`)."""
    import casadi as ca

    codes = {name: getattr(ca, name) for name in dir(ca) if name.startswith("OP_")}
    work: list[Any] = [None] * function["work"]
    out: list[Any] = [ca.SX(0)] * function["rows"]
    for name, written, read, constant in function["steps"]:
        if name == "OP_OUTPUT":
            out[written[1]] = work[read[0]]
        elif name == "OP_INPUT":
            work[written[0]] = inputs[read[0]][read[1]]
        elif name == "OP_CONST":
            work[written[0]] = ca.SX(constant)
        elif len(read) == 1:
            work[written[0]] = ca.SX.unary(codes[name], work[read[0]])
        else:
            work[written[0]] = ca.SX.binary(codes[name], work[read[0]], work[read[1]])
    return ca.vertcat(*out)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), *(int(word) for word in sys.argv[2:]))
