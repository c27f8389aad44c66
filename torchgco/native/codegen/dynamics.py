"""C of a model's step and its Jacobian, made from the model's own PyTorch code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.tree import apart
from torchgco.dynamics import Dynamics
from torchgco.native import store
from torchgco.native.codegen import calls, emit, layers, roots
from torchgco.tracing import Traced, arrays, dtypes, nets, operations, own_tensors
from torchgco.tracing import roots as traced_roots
from torchgco.tracing.arrays import elements
from torchgco.tracing.nets import Call

RATIONAL = "INPUT", "OUTPUT", "CONST", "PARAMETER", "ASSIGN", "ADD", "SUB", "MUL", "DIV", "INV", "NEG", "TWICE", "SQ"
STEP_FUNCTION, JACOBIAN = "tgco_step", "tgco_jacobian"


@dataclass(frozen=True)
class DynamicsSource:
    """A model in C, with x (n), u (m), and a problem's own numbers p (count) in vectors V,
    and the numbers w that all problems share:

        static inline void tgco_step(IN ALONE x, IN ALONE u, IN ALONE p,
                                     const double *restrict w, OUT ALONE x_next)         n
        static inline void tgco_jacobian(the same four, OUT ALONE entries)      computed

    No output may overlap an input. [fx, fu] (n, n+m) is zero except at `rows`, `columns`, listed column by column.
    Nonzero i is `values[i]` where `places[i]` is -1, else `entries[places[i]]`.
    """

    n: int
    m: int
    count: int
    code: str
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    places: tuple[int, ...]
    values: tuple[float, ...]  # 0.0 where the entry is computed
    affine: bool  # in x and u
    key: str  # says what `code` computes, the same in every process
    traced: Traced = field(repr=False, compare=False)

    @property
    def computed(self) -> int:
        """Number of the Jacobian's entries that `tgco_jacobian` writes."""
        return sum(index >= 0 for index in self.places)

    def numbers(self, B: int, of: Dynamics, shared: Tensor) -> Tensor:
        """The own numbers (B|1, K|1, count) of B problems with the model `of`, with an axis of stages; `shared` are
        the numbers that all problems share, of which some may be a stage's own.
        """
        return self.parameters(torch.arange(B), of).unsqueeze(1)

    def parameters(self, index: Tensor, of: Dynamics | None = None) -> Tensor:
        """The own numbers (B, count) float64 of the problems in `index` (B,) int64, on its device.

        They belong to the traced model, or to `of`, a model with the same step such as `take` returns.
        """
        if of is None or self.count == 0:
            return self.traced.parameters_of(index)
        traced = self.traced.rebound(own_tensors(of), len(index))
        return (traced or trace_dynamics(of, self.n, self.m, device=index.device).traced).parameters_of(index)


def trace_dynamics(
    dynamics: Dynamics,
    n: int | None = None,
    m: int | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> DynamicsSource:
    """The C of `dynamics.step`, taken from the cache folder if it was made before.

    Tensors in `per_element` and `batched` are numbers of each problem. All others, including those that a function
    closes over, are numbers that all problems share, or constants in the code: see `Traced`.

    Args:
        dynamics: of the whole batch.
        n, m: numbers of states and controls, by default the model's own.
        dtype, device: of the problem's tensors.

    Raises:
        InputError: the step can't be traced, or holds an operation without a counterpart.
    """
    n, m = n or dynamics.n, m or dynamics.m
    x, u = (torch.zeros(1, size, dtype=dtype, device=device) for size in (n, m))
    dynamics = apart(dynamics)
    step = lambda i, x, u: dynamics.take(i).step(x, u)
    traced = Traced("dynamics.step", step, x, u, own=own_tensors(dynamics))
    key = "model", traced.fingerprint(), *makers()
    parts = store.made(key, lambda: step_parts([stepped(traced, n, m)]), f"model {traced.kin}")
    lists = {name: tuple(parts.content[name]) for name in ("rows", "columns", "places", "values")}
    code, affine = emit.checked(traced.field, parts.content["code"]), parts.content["affine"]
    return DynamicsSource(n, m, traced.count, code, **lists, affine=affine, key=parts.key, traced=traced)


Step = tuple[
    list[Any], Any, Sequence[Call]
]  # CasADi's columns x (n), u (m), p and w, the next x (n), calls of networks


def stepped(traced: Traced, n: int, m: int) -> Step:
    """The step that a trace makes."""
    import casadi as ca

    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    p, w = ca.SX.sym("p", traced.count), ca.SX.sym("w", len(traced.pattern))
    shared = np.where(np.isnan(traced.pattern), elements(w), traced.pattern)
    net_calls: list[Call] = []
    ahead = traced(elements(p), elements(x)[None], elements(u)[None], shared=shared, calls=net_calls).reshape(-1)
    return [x, u, p, w], ca.densify(ca.vertcat(*ahead)), net_calls


def step_parts(steps: Sequence[Step]) -> dict[str, Any]:
    """The code of steps, one for each form of stages, and the lists of a DynamicsSource."""
    import casadi as ca

    names, code, affine = names_of(steps, STEP_FUNCTION, JACOBIAN), list[str](), True
    tangents = [calls.Ahead(found, ca.vertcat(*inputs[:2])) for inputs, _, found in steps]
    jacobians = [along.jacobian(ahead) for along, (_, ahead, _) in zip(tangents, steps, strict=True)]
    lists = nonzeros(jacobians)
    for (inputs, ahead, found), along, jacobian, of in zip(steps, tangents, jacobians, names, strict=True):
        step, jacobian = ca.cse([ahead, jacobian])
        changing = computed_entries(jacobian, lists)
        stages = calls.values(found), along.stages
        code += map(calls.emit_staged, of, [inputs] * 2, ([ca.densify(step)], [changing]), stages)
        affine = affine and not found and _is_affine(inputs, step, changing)
    if len(steps) > 1:
        code += [emit.by_form(name, len(steps), 4, 1) for name in (STEP_FUNCTION, JACOBIAN)]
    return {"code": "\n".join(code), **lists, "affine": affine}


def names_of(forms: Sequence[Any], *names: str) -> list[list[str]]:
    """Of each form the names of its functions, which `emit.by_form` calls; of one alone those that others call."""
    return [[f"{name}_{i}" if len(forms) > 1 else name for name in names] for i in range(len(forms))]


def nonzeros(jacobians: Sequence[Any]) -> dict[str, list[Any]]:
    """`rows`, `columns`, `places` and `values` of a DynamicsSource: of entries that aren't 0 in some form."""
    import casadi as ca

    some = ca.DM(jacobians[0].sparsity(), 1.0)
    for jacobian in jacobians[1:]:
        some += ca.DM(jacobian.sparsity(), 1.0)
    rows, columns = some.sparsity().get_triplet()
    each = [[jacobian[i, j] for jacobian in jacobians] for i, j in zip(rows, columns, strict=True)]
    fixed = [all(e.is_constant() for e in entries) and len({float(e) for e in entries}) == 1 for entries in each]
    places = np.where(fixed, -1, np.cumsum(np.logical_not(fixed)) - 1).tolist()
    values = [float(entries[0]) if same else 0.0 for entries, same in zip(each, fixed, strict=True)]
    return {"rows": list(rows), "columns": list(columns), "places": places, "values": values}


def _is_affine(inputs: Sequence[Any], step: Any, changing: Any) -> bool:
    """Whether a step is affine in x and u: it has no jumps, and none of its slopes `changing` depends on them."""
    import casadi as ca

    function = ca.Function("step", list(inputs), [step])
    rational = {emit.codes()[name] for name in RATIONAL}
    smooth = all(function.instruction_id(i) in rational for i in range(function.n_instructions()))
    return smooth and not ca.depends_on(changing, ca.vertcat(*inputs[:2]))


def computed_entries(jacobian: Any, lists: Mapping[str, Sequence[Any]]) -> Any:
    """The column of a Jacobian's entries that `tgco_jacobian` writes: those that aren't constants by `nonzeros`."""
    import casadi as ca

    where = zip(lists["rows"], lists["columns"], lists["places"], strict=True)
    return ca.densify(ca.vertcat(ca.SX(0, 1), *(jacobian[i, j] for i, j, place in where if place >= 0)))


@cache
def makers(*more: str) -> Sequence[str]:
    """Versions of CasADi and PyTorch and the texts of the files that generate code, which cached code depends on."""
    modules = (operations, arrays, dtypes, nets, traced_roots, emit, layers, calls, roots)
    files = (*(module.__file__ for module in modules), __file__, *more)
    try:
        casadi = version("casadi")
    except PackageNotFoundError:
        casadi = ""
    try:
        return (casadi, torch.__version__, *(Path(str(name)).read_text() for name in files))
    except OSError:  # in an archive, say; then the package's version stands for them
        return (casadi, torch.__version__, version("torchgco"))
