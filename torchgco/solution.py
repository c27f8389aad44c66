"""What a solver returns for every problem of the batch, and on request the record of how it was found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.files import read_arrays, write_whole
from torchgco.base.gradients import without_gradients
from torchgco.base.options import Positive, check_value
from torchgco.base.shapes import MISTAKES, check_device, check_shape
from torchgco.base.status import Differentiability, Status
from torchgco.base.tree import moved, take
from torchgco.explaining.explain import Account, Explanation, explanation
from torchgco.explaining.record import Comparison as Comparison
from torchgco.explaining.record import Fate as Fate
from torchgco.explaining.record import GuessRecord as GuessRecord
from torchgco.explaining.record import SearchRecord as SearchRecord
from torchgco.explaining.record import Standing as Standing
from torchgco.judging.judge import columns as judged
from torchgco.judging.worst import worst_rows
from torchgco.lagrangian.lagrangian import Multipliers, shifted
from torchgco.problem.times import sampled, times

if TYPE_CHECKING:
    import pandas as pd

    from torchgco.base.html import HtmlPage
    from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Solution:
    """Trajectories, feedback gains, multipliers and how each problem ended.

    It has the length B, and gives batches of one for `solution[b]` and in loops. Saved as npz by `save`, loaded by
    `Solution.load`; torch.save and torch.load serve where nothing is recorded.
    """

    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    K: Tensor  # (B, N, m, n): u = U + K (x - X) + d
    d: Tensor  # (B, N, m)
    multipliers: Multipliers
    cost: Tensor  # (B,): J_var
    violation: Tensor  # (B,): largest violation, metres for lengths
    status: Tensor  # (B,) int64, see Status
    # (B,) int64: iterations of all solves made for the problem: inner solves, candidates that guidance solves, every
    # start of `multistart`.
    iterations: Tensor
    outer_iterations: Tensor  # (B,) int64: of the outermost solver, over all its starts
    guided: Tensor  # (B,) int64, outer iterations with guidance on
    trace: pd.DataFrame | None = None  # a row per problem and iteration, where the solver records
    search: SearchRecord | None = None  # paths, candidates and passes, where a solver with passes records
    horizon: Tensor | None = None  # (B,) int64: stages of each problem, after which its state is held; None: N
    times: Tensor | None = None  # (B, N+1): times of the knots, s, where the time is free; None: see `t`
    # (B,), s: where the time is free and its longest doesn't do, a duration that does, NaN where none was found
    needed: Tensor | None = None
    guess: Tensor | None = None  # (B,) int64: of several guesses the one that led here; None: there was one
    guesses: GuessRecord | None = None  # what became of each of them: `solution.guesses.to_frame()`
    reason: Tensor | None = None  # (B,) int64, see Differentiability; None: not asked for
    account: Account | None = None  # the problem and the solver, for `t` and `explain`; of a loaded one the times alone

    @classmethod
    def empty(cls, problem: Problem) -> Solution:
        """That of a batch without problems."""
        X, U = problem.x0.new_zeros(0, problem.N + 1, problem.n), problem.x0.new_zeros(0, problem.N, problem.m)
        number, count = X.new_zeros(0), torch.zeros(0, dtype=torch.int64, device=X.device)
        K = X.new_zeros(0, problem.N, problem.m, problem.n)
        return cls(X, U, K, U, Multipliers.zero(problem, 0.0), number, number, count, count, count, count)

    @property
    def t(self) -> Tensor:
        """Times of the knots, s: (N+1,), or (B, N+1) where horizons or stages differ, or the time is free.

        Raises:
            InputError: the model has no time step, or this solution doesn't know its problem: a user's own, or a file's
                without times.
        """
        return (self.account or Account()).times() if self.times is None else self.times

    @property
    def duration(self) -> Tensor:
        """How long each trajectory lasts, (B,), s.

        Raises:
            InputError: as `t`.
        """
        return self.t[..., -1].expand(len(self))

    def explain(self, b: int = 0, problem: Problem | None = None) -> Explanation:
        """What happened to problem b, in words: the result, where it was caught, the passes, why it ended, what to try.

        With a record (`torchgco.solve(..., record=True)`) it says what each pass of the search did, and what became of
        the candidates.

        Args:
            b: place in the batch.
            problem: the problems that were solved, for a solution that no longer knows them, such as a loaded one.

        Raises:
            InputError: no such place, or a problem of another form.
        """
        return explanation(self.detach(), b, problem)

    @property
    def differentiable(self) -> Tensor:
        """Whether X, U, cost and multipliers of each problem have derivatives, (B,) bool; elsewhere gradients are 0."""
        if self.reason is None:
            return torch.zeros_like(self.status, dtype=torch.bool)
        return self.reason == Differentiability.DIFFERENTIABLE

    @property
    def why_not(self) -> list[str]:
        """A sentence for each problem: why its solution has no derivatives, or that it has."""
        reasons = torch.full_like(self.status, int(Differentiability.NOT_ASKED)) if self.reason is None else self.reason
        return [Differentiability(reason).sentence for reason in reasons.tolist()]

    @property
    def statuses(self) -> list[Status]:
        """The statuses by name; `.sentence` explains one."""
        return [Status(s) for s in self.status.tolist()]

    def take(self, index: Any) -> Solution:
        """The problems at some places, a tensor, list or slice; or at those that a mask (B,) marks. No records.

        Raises:
            InputError: places that aren't there, or no whole numbers.
        """
        rows = index if isinstance(index, slice) else _places(index, len(self), self.cost.device)
        return take(replace(self, trace=None, search=None), rows)

    def detach(self) -> Solution:
        """The same numbers without gradients; itself where it has none."""
        live = {"X": self.X, "U": self.U, "cost": self.cost, "multipliers": self.multipliers,
                "times": self.times}  # fmt: skip
        parts = {name: without_gradients(part) for name, part in live.items()}
        return self if all(parts[name] is part for name, part in live.items()) else replace(self, **parts)

    def shifted(self, steps: float = 1) -> Solution:
        """The guess for the same problems `steps` stages later, as `solve(problem, warm=solution.shifted())` takes it.

        For a receding horizon: the new problem starts where this plan is after these stages, or near there, and counts
        its knots from there. Every knot takes the state, control, feedback and multipliers of the one `steps` later,
        those at the end the last ones; part of a stage takes the straight line between. Rows at chosen knots, such as
        waypoints, keep theirs. Nothing is solved yet: the status is RUNNING, cost and violation are NaN.

        Raises:
            InputError: `steps` isn't a number of stages above 0.
        """
        check_value(steps, Positive, "steps")
        if self.times is not None:
            raise InputError("solution", "one of fixed times: later knots of a free time lie elsewhere", "a free time")
        last, problem = self.horizon, None if self.account is None else self.account.problem
        stage = None if last is None else last - 1
        U, K, d = (shifted(tensor, steps, last=stage) for tensor in (self.U, self.K, self.d))
        X, multipliers = shifted(self.X, steps, last=last), self.multipliers.shifted(steps, problem)
        lost, none = torch.full_like(self.cost, torch.nan), torch.zeros_like(self.status)
        return replace(
            self, X=X, U=U, K=K, d=d, multipliers=multipliers, cost=lost, violation=lost, status=none, iterations=none,
            outer_iterations=none, guided=none, trace=None, search=None, guess=None, guesses=None,
        )  # fmt: skip

    def __getitem__(self, index: Any) -> Solution:
        """As `take`; a single place gives a batch of one."""
        return self.take([index] if isinstance(index, int) and not isinstance(index, bool) else index)

    def __len__(self) -> int:
        return self.U.shape[0]

    def __bool__(self) -> bool:
        return True

    def __iter__(self) -> Iterator[Solution]:
        return (self.take(slice(b, b + 1)) for b in range(len(self)))

    def to(self, device: str | torch.device) -> Solution:
        """The same on another device, without the problem, which stays where it is, and without records.

        Raises:
            InputError: a device that isn't there.
        """
        where = check_device(device)
        if where == self.U.device:
            return self
        account = self.account
        if account is not None:
            with suppress(InputError):  # dynamics without a time step
                account = Account(name=account.name, t=account.times().to(where))
        bare = replace(self, trace=None, search=None, account=None)
        return replace(moved(bare, where), account=account)

    def to_dict(self) -> dict[str, Any]:
        """X, U and the numbers of each problem as NumPy arrays, by name; `status` as names, t where it is known."""
        arrays: dict[str, Any] = {name: getattr(self, name).detach().cpu().numpy() for name in _TENSORS}
        arrays["status"] = [status.name for status in self.statuses]
        if self.horizon is not None:
            arrays["horizon"] = self.horizon.cpu().numpy()
        with suppress(InputError):  # dynamics without a time step
            arrays["t"] = self.t.detach().cpu().numpy()
        return arrays

    def of_first_states(self, n: int, horizon: Tensor | None = None) -> Solution:
        """The same with the first n states alone, of which K is then the feedback, and with these horizons."""
        search = None if self.search is None else self.search.of_first_states(n)
        X, K = self.X[..., :n].contiguous(), self.K[..., :n].contiguous()
        return replace(self, X=X, K=K, search=search, horizon=horizon)

    def __repr__(self) -> str:
        B, N, m = self.U.shape
        counts = Counter(status.name for status in self.statuses).most_common()
        ended = ", ".join(f"{count} {name}" for name, count in counts)
        finite = self.cost[torch.isfinite(self.cost)].tolist()
        costs = f"cost {min(finite):.6g} to {max(finite):.6g}" if finite else "no finite cost"
        return f"Solution(B={B}, N={N}, n={self.X.shape[-1]}, m={m}: {ended}; {costs})"

    def to_frame(self, problem: Problem | None = None) -> pd.DataFrame:
        """One row per problem: status, cost, violation and the iteration counts; horizon and guess where they differ.

        Where it is known, `kernels` says what solved: "native", "cuda" (C on a GPU, too), "pytorch", or another one.

        Args:
            problem: the problem that was solved. With it come the columns of `judge.columns`, from a re-simulation:
                `clearance` where it has obstacles (m, the smallest distance to where bodies touch, also between
                knots), and `reached` where it has a goal.

        Raises:
            InputError: a problem of another form, or with obstacles that can't be judged.
        """
        import pandas as pd

        columns: dict[str, Any] = {"status": [s.name for s in self.statuses]}
        for name in ("cost", "violation", "iterations", "outer_iterations", "guided"):
            columns[name] = getattr(self, name).detach().cpu().numpy()
        if self.horizon is not None:
            columns["horizon"] = self.horizon.cpu().numpy()
        if self.guess is not None:
            columns["guess"] = self.guess.cpu().numpy()
        if self.times is not None:
            columns["duration"] = self.duration.detach().cpu().numpy()
        if self.account is not None and self.account.kernels is not None:
            columns["kernels"] = self.account.kernels
        if problem is not None:
            start = None if problem.free_start is None else self.X[:, 0].detach()
            times = self.detach().times if problem.time is not None else None
            columns |= judged(problem, self.U.detach(), start, times)
        return pd.DataFrame(columns).rename_axis("element")

    def trajectories(self, rate: float | None = None, problem: Problem | None = None) -> pd.DataFrame:
        """A row per problem and time: `problem`, times, states and controls under their names with units.

        Beside them are velocity and acceleration of the position, where the model integrates a derivative, and what
        the model derives itself, such as a quadrotor's thrust. Controls hold until the next knot. Names are those of
        `Dynamics.state_names` and `control_names`.

        Args:
            rate: samples per second from the first knot on, and the last knot, by the model's own integrator; None: the
                knots.
            problem: that was solved, for a solution that no longer knows it: else its states have no names, and
                straight lines between the knots.

        Raises:
            InputError: a rate that isn't above 0, a problem of another form, one that was changed in place since, or
                dynamics without a time step.
        """
        import pandas as pd

        check_value(rate, Positive | None, "rate")
        own = problem if problem is not None else None if self.account is None else self.account.as_solved()
        if own is not None:
            check_shape(self.X, (own.B, own.N + 1, own.n), "problem: solution.X")
        t, frames = self.detach().t if problem is None or self.times is not None else times(problem), []
        for b in range(len(self)):
            last = self.U.shape[1] if self.horizon is None else int(self.horizon[b])
            X, U = self.X[b, : last + 1].detach(), self.U[b, :last].detach()
            dynamics = None if own is None else own.take(slice(b, b + 1)).dynamics
            columns = sampled(dynamics, X, U, (t if t.dim() == 1 else t[b])[: last + 1], rate)
            frames.append(pd.DataFrame({"problem": b} | columns))
        return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame({"problem": []})

    def to_csv(self, path: str | Path, rate: float | None = None, problem: Problem | None = None) -> None:
        """Write `trajectories` as CSV: all of it or, if interrupted, nothing.

        Raises:
            InputError: as `trajectories`, or a place where no file can be written.
        """
        text = self.trajectories(rate, problem).to_csv(index=False)
        write_whole(path, lambda file: file.write(text.encode()))

    def worst_rows(self, problem: Problem) -> pd.DataFrame:
        """One row per problem: which constraint is violated most, and where states were lost.

        `constraint`, its place in `problem.constraints`, with its `name` or kind; `knot` and `row` of the largest
        `violation`, m for lengths; all are -1, "" and 0 where nothing is violated. `lost_at` is the first knot whose
        state isn't finite, -1 where all are: there a model or its integrator fails, for which a smaller time step or
        other controls at the stage before may help.

        Raises:
            InputError: a problem of another form.
        """
        import pandas as pd

        check_shape(self.X, (problem.B, problem.N + 1, problem.n), "problem: solution.X")
        check_shape(self.U, (problem.B, problem.N, problem.m), "problem: solution.U")
        rows = worst_rows(problem, self.X.detach(), self.U.detach(), self.detach().times)
        return pd.DataFrame(rows).rename_axis("element")

    if TYPE_CHECKING:  # pages and derivatives know solutions: `torchgco` adds these methods

        def predict(self, changed: Problem, problem: Problem | None = None) -> Solution: ...

        def show(self, problem: Problem) -> HtmlPage: ...

    def save(self, path: str | Path) -> None:
        """Write an npz: all of it or, if interrupted, nothing."""
        arrays = self.to_dict()
        arrays["status"], arrays["mu"] = self.status.cpu().numpy(), self.multipliers.mu.cpu().numpy()
        if self.times is not None:
            arrays["times"] = self.times.detach().cpu().numpy()
        if self.guess is not None:
            arrays["guess"] = self.guess.cpu().numpy()
        if self.account is not None and self.account.kernels is not None:
            arrays["kernels"] = np.array(self.account.kernels)
        for i, lam in enumerate(self.multipliers.lam):
            arrays[f"lam{i}"] = lam.detach().cpu().numpy()
        write_whole(path, lambda file: np.savez_compressed(file, **arrays))

    @classmethod
    def load(cls, path: str | Path, device: str | torch.device = "cpu") -> Solution:
        """Read what `save` wrote.

        Raises:
            InputError: no such file, one that isn't a solution, or a device that isn't there.
        """
        where = check_device(device)
        arrays = read_arrays(path, "path", "a solution file", {*_TENSORS, "mu"})
        count = next(i for i in range(len(arrays)) if f"lam{i}" not in arrays)
        more = [name for name in ("horizon", "t", "times", "guess") if name in arrays]
        names = (*_TENSORS, "mu", *(f"lam{i}" for i in range(count)), *more)
        strange = [name for name in names if arrays[name].dtype.kind not in "iuf"]
        if strange:
            raise InputError("path", "a solution file", f"{path}, where {strange[0]} holds no numbers")
        ranks = {"X": 3, "U": 3, "K": 4, "d": 3, "times": 2, "t": arrays["t"].ndim if "t" in arrays else 1}
        if any(arrays[name].ndim != ranks.get(name, 3 if name.startswith("lam") else 1) for name in names):
            raise InputError("path", "a solution file", f"{path}, whose arrays have other shapes")
        tensors: dict[str, Any] = {name: torch.from_numpy(arrays[name]).to(where) for name in names}
        lam = tuple(tensors[f"lam{i}"] for i in range(count))
        tensors_kept: dict[str, Any] = {name: tensors[name] for name in _TENSORS}
        kernels = str(arrays["kernels"]) if "kernels" in arrays else None
        account = Account(t=tensors.get("t"), kernels=kernels) if "t" in tensors or kernels is not None else None
        tensors_kept |= {name: tensors.get(name) for name in ("horizon", "times", "guess")}
        return cls(multipliers=Multipliers(lam, tensors["mu"]), account=account, **tensors_kept)


def _places(index: Any, B: int, device: torch.device) -> Tensor:
    """Places as int64 (b,)."""
    try:
        rows = torch.as_tensor(index, device=device)
    except MISTAKES:
        raise InputError("index", f"places of problems, 0 to {B - 1}", shown(index)) from None
    if rows.dtype == torch.bool and rows.shape == (B,):
        return rows.nonzero().flatten()
    rows = rows.long() if rows.numel() == 0 else rows
    whole = not (rows.is_floating_point() or rows.is_complex()) and rows.dtype != torch.bool and rows.dim() == 1
    if not whole or not bool(((rows >= -B) & (rows < B)).all()):
        raise InputError("index", f"places of problems, 0 to {B - 1}", shown(index))
    return torch.where(rows < 0, rows + B, rows).long()


_OTHERS = "multipliers", "trace", "search", "horizon", "times", "needed", "guess", "guesses", "reason", "account"
_TENSORS = tuple(f.name for f in fields(Solution) if f.name not in _OTHERS)
# What torch.load may make of a file of torch.save; they hold tensors, and run nothing.
torch.serialization.add_safe_globals([Solution, Multipliers, Account, GuessRecord, SearchRecord, Comparison, Standing])
