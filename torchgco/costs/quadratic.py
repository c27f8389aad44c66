"""The quadratic cost of the paper, with linear and cross terms (section 2 of the method), in a free time, too.

All stages last the same multiple tau of dt, so knot k is at k dt tau, where a reference that is given at the nominal
times j dt is between two of its rows. A natural cubic spline through all of them is what solvers need: its second
derivative is continuous, so that the cost has no kinks in tau.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.gradients import asks
from torchgco.base.numbers import Floats, Number, Wrong, at_least_zero, finite, numbers
from torchgco.base.shapes import Dimensions, check_finite, check_shape, lead, tensor
from torchgco.base.tree import passed_on
from torchgco.costs.base import Cost, WrappedCost, add_blocks


@dataclass(frozen=True)
class QuadraticInFreeTime(WrappedCost):
    """A quadratic cost whose references of states follow a time that is free.

    Before its first and after its last row a reference goes on evenly. One that rests at all stages is where the
    trajectory is drawn to on its way; its last row then counts at the end, whenever that is.
    """

    cost: Any  # a BoundQuadratic, with the references at the nominal times
    along: Tensor  # (B|1, N+1, n): coefficients of the B-splines around the rows
    rests: Tensor  # (B|1,) bool: the reference is the same at all stages

    batched: ClassVar[tuple[str, ...]] = ("cost",)
    per_element: ClassVar[tuple[str, ...]] = ("along", "rests")

    stage, terminal = passed_on("cost", "stage", "terminal")

    @classmethod
    def of(cls, cost: Any) -> QuadraticInFreeTime | None:
        """That of a BoundQuadratic; None where no reference of states differs from stage to stage."""
        along, rests = _read(cost)
        return None if bool(rests.all()) else cls(cost, along, rests)

    def write(self) -> None:
        """Read the references of `cost` as they are, in this memory."""
        for old, new in zip((self.along, self.rests), _read(self.cost), strict=True):
            old.copy_(new)

    def numbers(self, where: str) -> list[Number]:
        return self.cost.numbers(where, self.write)

    @property
    def of_errors(self) -> Cost:
        """The cost of what states differ by from references."""
        zero = torch.zeros_like(self.cost.xf_ref[:1])
        return replace(self.cost, x_ref=zero.unsqueeze(1), xf_ref=zero)

    def stage_at(self, x: Tensor, u: Tensor, k: int | Tensor, tau: Tensor) -> Tensor:
        """`stage` where stages last tau (...) times as long."""
        return self.of_errors.stage(x - self.reference(k * tau), u, k)

    def terminal_at(self, x: Tensor, tau: Tensor) -> Tensor:
        """`terminal` where stages last tau (...) times as long."""
        count = self.along.shape[1] - 1
        rests, there = (_spread(row, x) for row in (self.rests, self.cost.xf_ref))
        return self.of_errors.terminal(x - torch.where(rests, there, self.reference(count * tau)))

    def reference(self, s: Tensor) -> Tensor:
        """References (B, ..., n) at times s (B, ...), in stages of dt."""
        c, last = self.along, self.along.shape[1] - 1
        within = torch.where(s < 0.0, 0.0, torch.where(s < last, s, float(last)))
        ends = (_spread(slope, s, 1) for slope in (c[:, 1] - c[:, 0], c[:, -1] - c[:, -2]))
        ahead = torch.where((s < 0.0).unsqueeze(-1), *ends)
        c = torch.cat((2.0 * c[:, :1] - c[:, 1:2], c, 2.0 * c[:, -1:] - c[:, -2:-1]), dim=1)
        places = torch.arange(-1, last + 2, dtype=s.dtype, device=s.device)
        weights = bump(within.unsqueeze(-1) - places).unsqueeze(-1)
        return (weights * _spread(c, s, 2)).sum(-2) + (s - within).unsqueeze(-1) * ahead


def _read(cost: Any) -> tuple[Tensor, Tensor]:
    """The fields `along` and `rests` of a BoundQuadratic."""
    rests = (cost.x_ref == cost.x_ref[:, :1]).flatten(1).all(-1)
    rows = torch.cat((cost.x_ref, cost.xf_ref.unsqueeze(1)), dim=1)
    still = cost.x_ref[:, :1].expand_as(rows)
    return torch.where(rests.view(-1, 1, 1), still, coefficients(rows)), rests


def bump(t: Tensor) -> Tensor:
    """The cubic B-spline around 0, which is 0 beyond 2 on either side."""
    a = t.abs()
    b = 2.0 - a
    return torch.where(a < 1.0, 2.0 / 3.0 - t * t * (1.0 - 0.5 * a), torch.where(a < 2.0, b * b * b / 6.0, 0.0))


def coefficients(rows: Tensor) -> Tensor:
    """Of the natural cubic spline through rows (B, N+1, n), one apart: coefficients of the B-splines around them.

    They obey c_{k-1} + 4 c_k + c_{k+1} = 6 r_k, with c = r at both ends, where the second derivative is 0. Solved row
    by row: a problem's bits don't depend on the batch.
    """
    r = rows.unbind(1)
    shares, forward = [0.0], [r[0]]  # c_k = forward_k - shares_k c_{k+1}
    for row in r[1:-1]:
        pivot = 4.0 - shares[-1]
        forward.append((6.0 * row - forward[-1]) / pivot)
        shares.append(1.0 / pivot)
    c = [r[-1]]
    for value, share in zip(forward[:0:-1], shares[:0:-1], strict=True):
        c.append(value - share * c[-1])
    return torch.stack([r[0], *c[::-1]] if len(r) > 1 else c, dim=1)


def _spread(values: Tensor, like: Tensor, more: int = 0) -> Tensor:
    """Values (B|1, ...) with axes of length 1 after the first, so that they have `more` axes than `like`."""
    missing = like.dim() + more - values.dim()
    return values.view(len(values), *([1] * missing), *values.shape[1:])


WEIGHTS = "Q", "R", "Qf"


@dataclass(frozen=True)
class QuadraticCost(Cost):
    """Quadratic cost in e_x = x - x_ref, e_u = u - u_ref.

        stage     q' e_x + 1/2 e_x' Q e_x + r' e_u + 1/2 e_u' R e_u + e_u' H e_x        (Equation 49)
        terminal  qf' e_x + 1/2 e_x' Qf e_x                                             (Equation 48)

    A weight is given as a diagonal (n,), a matrix (n, n), one per stage (N, n, n), or one per problem and stage
    (B or 1, N or 1, n, n); Qf has no stage axis: (n,), (n, n), (B, n, n). A reference or linear term is a vector
    (n,), one per knot (N+1, n) or stage (N, m), or per problem (B or 1, N+1 or 1, n); qf is (n,) or (B, n).

    Raises:
        InputError: on `Problem(...)`: wrong shapes, weights that aren't finite, symmetric and positive semidefinite.
    """

    Q: Any
    R: Any
    Qf: Any
    x_ref: Any = 0.0
    u_ref: Any = 0.0
    q: Any = 0.0
    r: Any = 0.0
    qf: Any = 0.0
    H: Any = None

    def bind(self, dims: Dimensions) -> Cost:
        B, N, n, m = dims.B, dims.N, dims.n, dims.m
        Q, R = _weight(self.Q, "Q", n, B, N, dims.like), _weight(self.R, "R", m, B, N, dims.like)
        Qf = _weight(self.Qf, "Qf", n, B, None, dims.like)
        H = None if self.H is None else _shaped(tensor(self.H, "cost.H", dims.like), "H", (m, n), B, N)
        check_semidefinite(Q.detach(), R.detach(), Qf.detach(), None if H is None else H.detach())
        x_ref = _vector(self.x_ref, "x_ref", n, B, N + 1, dims.like)
        weights = (self.Q, Q), (self.R, R), (self.Qf, Qf)
        diagonal = H is None and all(_is_diagonal(value, W) for value, W in weights)
        if diagonal:
            Q, R, Qf = (W.diagonal(dim1=-2, dim2=-1).contiguous() for W in (Q, R, Qf))
        cost = BoundQuadratic(
            Q=Q,
            R=R,
            Qf=Qf,
            x_ref=x_ref if x_ref.shape[1] == 1 else x_ref[:, :-1].contiguous(),
            xf_ref=x_ref[:, -1].contiguous(),
            u_ref=_vector(self.u_ref, "u_ref", m, B, N, dims.like),
            q=_optional(self.q, "q", n, B, N, dims.like),
            r=_optional(self.r, "r", m, B, N, dims.like),
            qf=_optional(self.qf, "qf", n, B, None, dims.like),
            H=H,
            diagonal=diagonal,
        )
        return (QuadraticInFreeTime.of(cost) or cost) if dims.free_time else cost


@dataclass(frozen=True)
class BoundQuadratic(Cost):
    """A QuadraticCost shaped for its problem: batch and stage axes have their full length, or 1 where shared.

    Diagonal weights are kept as diagonals: most are, and products then replace matrix products.
    """

    Q: Tensor  # (B|1, N|1, n) or (B|1, N|1, n, n)
    R: Tensor
    Qf: Tensor  # (B|1, n) or (B|1, n, n)
    x_ref: Tensor  # (B|1, N|1, n)
    xf_ref: Tensor  # (B|1, n)
    u_ref: Tensor
    q: Tensor | None
    r: Tensor | None
    qf: Tensor | None
    H: Tensor | None
    diagonal: bool

    per_element: ClassVar[tuple[str, ...]] = (
        "Q", "R", "Qf", "x_ref", "xf_ref", "u_ref", "q", "r", "qf", "H",
    )  # fmt: skip

    def bind(self, dims: Dimensions) -> BoundQuadratic:
        return self

    def precision(self, dtype: torch.dtype) -> AbstractContextManager[None]:
        # No number is made of a knot's; a user's subclass may.
        return nullcontext() if type(self) is BoundQuadratic else super().precision(dtype)

    def numbers(self, where: str, after: Callable[[], object] | None = None) -> list[Number]:
        if type(self) is not BoundQuadratic:  # of which kernels read what its code computes
            return super().numbers(where)
        entries = [Number(f"{where}.x_ref", (self.x_ref.numpy(), self.xf_ref.numpy()), where, False, finite, after)]
        for name in ("u_ref", *WEIGHTS, "q", "r", "qf", "H"):
            tensor = getattr(self, name)
            if tensor is not None:
                check = finite if name not in WEIGHTS else at_least_zero if self.diagonal else _matrices
                joint = partial(self._check_new, where) if name in ("Q", "R", "H") and self.H is not None else None
                entries += numbers(where, {name: (tensor, check)}, where, False, joint=joint)
        return entries

    def _check_new(self, where: str, new: Mapping[str, Floats]) -> None:
        """Check Q, R and H together: each alone may be fine, and the stage cost still fall without end."""
        matrices = {name: new.get(f"{where}.{name}", getattr(self, name).numpy()) for name in (*WEIGHTS, "H")}
        check_semidefinite(**{name: torch.tensor(weights) for name, weights in matrices.items()})

    def by_knot(self, N: int) -> BoundQuadratic:
        """The same with references of its own memory for each stage."""
        refs = {name: getattr(self, name) for name in ("x_ref", "u_ref")}
        return replace(self, **{name: ref.expand(-1, N, -1).clone() for name, ref in refs.items()})

    @property
    def kernel(self) -> str:
        return "quadratic" if type(self) is BoundQuadratic else "function"

    def names_by_stage(self) -> set[str]:
        names = "x_ref", "u_ref", "Q", "R", "q", "r", "H"
        return {name for name in names if (value := getattr(self, name)) is not None and value.shape[1] > 1}

    def with_more(self, n: int, r: int) -> Cost:
        if type(self) is not BoundQuadratic:
            return super().with_more(n, r)
        parts = {}
        for name in ("Q", "Qf", "x_ref", "xf_ref", "q", "qf", "H"):
            value, more = getattr(self, name), r if name in ("Q", "Qf") and not self.diagonal else 0
            parts[name] = None if value is None else torch.nn.functional.pad(value, (0, r, 0, more))
        return replace(self, **parts)

    def ending(self, stages: Tensor, running: Tensor, resting: Tensor) -> BoundQuadratic:
        """The same with the weights of the controls alone, a diagonal above 0, after each problem's last stage.

        Args:
            stages: numbers of stages (B,), whose knots' references are the terminal ones.
            running: stages of each problem, (B, N) bool.
            resting: references (B, N, m) of the controls after these.
        """
        runs = running.unsqueeze(-1) if self.diagonal else running[..., None, None]
        parts: dict[str, Tensor | None] = {"u_ref": torch.where(running.unsqueeze(-1), self.u_ref, resting)}
        for name in ("Q", "H", "q", "r"):
            value = getattr(self, name)
            mask = running.unsqueeze(-1) if name in ("q", "r") else runs
            parts[name] = None if value is None else torch.where(mask, value, 0.0)
        weights = torch.where(self.control_curvatures > 0, self.control_curvatures, 1.0)
        parts["R"] = torch.where(runs, self.R, weights if self.diagonal else torch.diag_embed(weights))
        if self.x_ref.shape[1] > 1:
            B = len(stages)
            every = torch.cat((self.x_ref.expand(B, -1, -1), self.xf_ref.expand(B, -1).unsqueeze(1)), dim=1)
            parts["xf_ref"] = every[torch.arange(B, device=stages.device), stages]
        return replace(self, **parts)

    @property
    def control_curvatures(self) -> Tensor:
        """The second derivatives by each control alone, (B|1, N|1, m)."""
        return self.R if self.diagonal else self.R.diagonal(dim1=-2, dim2=-1)

    def toward(self, x_ref: Tensor) -> BoundQuadratic:
        """The same cost with other references of the states, (B, N+1, n), unchecked: for receding horizons."""
        return replace(self, x_ref=x_ref[:, :-1].contiguous(), xf_ref=x_ref[:, -1].contiguous())

    def scaled(self, factor: Tensor) -> BoundQuadratic:
        weights = {name: getattr(self, name) for name in ("Q", "R", "Qf", "q", "r", "qf", "H")}
        return replace(self, **{name: lead(factor, W) * W for name, W in weights.items() if W is not None})

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        parts: Sequence[Any] = self.x_ref, self.u_ref, self.Q, self.R, self.q, self.r, self.H
        if isinstance(k, int):  # samples follow the batch axis
            parts = [None if part is None else part[:, min(k, part.shape[1] - 1)] for part in parts]
            parts = [None if part is None else part.unsqueeze(1) for part in parts] if x.dim() == 3 else parts
        x_ref, u_ref, Q, R, q, r, H = parts
        ex, eu = x - x_ref, u - u_ref
        if self.diagonal:
            value = 0.5 * ((ex * (Q * ex)).sum(-1) + (eu * (R * eu)).sum(-1))
        else:
            value = 0.5 * ((ex * self._times(Q, ex)).sum(-1) + (eu * self._times(R, eu)).sum(-1))
        if q is not None:
            value = value + (q * ex).sum(-1)
        if r is not None:
            value = value + (r * eu).sum(-1)
        if H is not None:
            value = value + (eu * (H * ex.unsqueeze(-2)).sum(-1)).sum(-1)
        return value

    def rest_controls(self, like: Tensor) -> Tensor:
        return self.u_ref.expand_as(like).contiguous()

    def goal(self, x0: Tensor) -> Tensor:
        return self.xf_ref.expand_as(x0)

    def terminal(self, x: Tensor) -> Tensor:
        xf_ref, Qf, qf = self.xf_ref, self.Qf, self.qf
        if x.dim() == 3:
            xf_ref, Qf = xf_ref.unsqueeze(1), Qf.unsqueeze(1)
            qf = None if qf is None else qf.unsqueeze(1)
        e = x - xf_ref
        value = 0.5 * (e * (Qf * e if self.diagonal else self._times(Qf, e))).sum(-1)
        return value if qf is None else value + (qf * e).sum(-1)

    def expand(self, X: Tensor, U: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        ex, eu, ef = X[:, :-1] - self.x_ref, U - self.u_ref, X[:, -1] - self.xf_ref
        lx, lu, lf = self._times(self.Q, ex), self._times(self.R, eu), self._times(self.Qf, ef)
        lx = lx if self.q is None else lx + self.q
        lu = lu if self.r is None else lu + self.r
        lf = lf if self.qf is None else lf + self.qf
        if self.H is not None:
            lx = lx + (self.H * eu.unsqueeze(-1)).sum(-2)
            lu = lu + (self.H * ex.unsqueeze(-2)).sum(-1)
        stage, terminal = self._hessians(H)
        H[:, :-1], H[:, -1] = stage, terminal
        H[:, :-1, :n, n] = H[:, :-1, n, :n] = lx
        H[:, :-1, n + 1 :, n] = H[:, :-1, n, n + 1 :] = lu
        H[:, -1, :n, n] = H[:, -1, n, :n] = lf

    def _hessians(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The second derivatives in homogeneous blocks: of the stages (B|1, N|1, s, s), of the last knot (B|1, s, s).

        Axes that all weights share keep length 1, so that most problems fill H with copies of a single block.
        """
        n, s = self.Q.shape[-1], like.shape[-1]
        parts = [weight for weight in (self.Q, self.R, self.H) if weight is not None]
        lead = [max(weight.shape[axis] for weight in parts) for axis in (0, 1)]
        stage, terminal = like.new_zeros(*lead, s, s), like.new_zeros(self.Qf.shape[0], s, s)
        Q, R, Qf = (torch.diag_embed(W) if self.diagonal else W for W in (self.Q, self.R, self.Qf))
        add_blocks(stage, n, None, None, Q, R, self.H)
        add_blocks(terminal, n, None, None, Qf, None)
        return stage, terminal

    def _times(self, W: Tensor, e: Tensor) -> Tensor:
        # With products and sums, a problem's bits don't depend on the batch; with one GEMM by a shared matrix they do.
        if W.requires_grad and e.dim() == 3 and W.dim() == 4 and W.shape[1] == 1:
            return torch.bmm(e, W[:, 0].mT.expand(len(e), *W.shape[2:]))  # products of all knots would be kept
        return W * e if self.diagonal else (W * e.unsqueeze(-2)).sum(-1)


def _weight(value: Any, field: str, size: int, B: int, N: int | None, like: Tensor) -> Tensor:
    """A weight as (B|1, N|1, size, size), without the stage axis where N is None."""
    W = tensor(value, f"cost.{field}", like)
    return _shaped(torch.diag(W) if W.dim() == 1 else W, field, (size, size), B, N)


def _vector(value: Any, field: str, size: int, B: int, N: int | None, like: Tensor) -> Tensor:
    """A reference or linear term as (B|1, N|1, size), without the stage axis where N is None."""
    v = tensor(value, f"cost.{field}", like)
    v = _shaped(v.expand(size) if v.dim() == 0 else v, field, (size,), B, N)
    check_finite(v, f"cost.{field}")
    return v


def _shaped(value: Tensor, field: str, own: tuple[int, ...], B: int, N: int | None) -> Tensor:
    """Values (B|1, N|1, *own) with axes of length 1 where there are none, without the stage axis where N is None."""
    lengths = (B,) if N is None else (B, N)
    value = value[(None,) * (len(lengths) + len(own) - value.dim())]
    shared = (1 if value.dim() > i and value.shape[i] == 1 else length for i, length in enumerate(lengths))
    check_shape(value, (*shared, *own), f"cost.{field}")
    return value


def _optional(value: Any, field: str, size: int, B: int, N: int | None, like: Tensor) -> Tensor | None:
    """A linear term, None where it is zero throughout, and no gradient is asked for, which needn't be."""
    v = _vector(value, field, size, B, N, like)
    return v if asks(v) or bool((v != 0).any()) else None


def _is_diagonal(value: Any, W: Tensor) -> bool:
    """Whether a weight is one for good: a matrix that asks for gradients may have them off its diagonal."""
    if asks(W) and isinstance(value, Tensor) and value.dim() > 1:
        return False
    return bool((W - torch.diag_embed(W.diagonal(dim1=-2, dim2=-1)) == 0).all())


def check_semidefinite(Q: Tensor, R: Tensor, Qf: Tensor, H: Tensor | None) -> None:
    blocks = {"Q": Q, "R": R, "Qf": Qf}
    if H is not None:
        # Q and R alone may pass while the cross term makes the stage cost unbounded below.
        lead_axes = torch.broadcast_shapes(Q.shape[:2], R.shape[:2], H.shape[:2])
        Q, R, H = (W.expand(*lead_axes, *W.shape[2:]) for W in (Q, R, H))
        blocks["H"] = torch.cat((torch.cat((Q, H.mT), -1), torch.cat((H, R), -1)), -2)
    for field, W in blocks.items():
        check_finite(W, f"cost.{field}")
        if (wrong := unfit(W, "a weight [[Q, H'], [H, R]]" if field == "H" else "a weight")) is not None:
            raise InputError(f"cost.{field}", *wrong)


def unfit(W: Tensor, what: str = "a weight") -> tuple[str, str] | None:
    """What is wrong with finite matrices (..., n, n) as weights, (expected, got); None: nothing."""
    rounding = 1e-9 * max(float(W.abs().max()) if W.numel() else 0.0, 1.0)
    if float((W - W.mT).abs().max()) > rounding:
        return "a symmetric matrix", "an unsymmetric one"
    lowest = float(torch.linalg.eigvalsh(W).min())
    return (f"{what} that is positive semidefinite", f"an eigenvalue of {lowest:.3g}") if lowest < -rounding else None


def _matrices(new: Floats) -> Wrong:
    return finite(new) or unfit(torch.from_numpy(new))
