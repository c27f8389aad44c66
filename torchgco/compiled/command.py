"""MPPI in a loop: a sampled plan that every period improves and moves on, as users of pytorch_mppi know it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.numbers import as_floats, measured
from torchgco.base.options import Seconds, Seed, check_value
from torchgco.base.shapes import CPU, check_shape, check_tensor, check_untransformed, computing_on
from torchgco.compiled.motion import Motion
from torchgco.compiled.numbered import numbers_of, with_numbers_as_they_are, with_own_numbers
from torchgco.compiled.numbers import Numbers
from torchgco.compiled.stages import stage_of
from torchgco.guidance.mppi import MPPI
from torchgco.kernels import current, held_on_cpu, open_loop, served_by
from torchgco.lagrangian.lagrangian import shifted
from torchgco.problem.alone import check_rows
from torchgco.problem.problem import Problem, current_problem
from torchgco.receding.plan import stages_between


class MPPIController:
    """Model predictive path integral control: `command(x)` samples around the plan before.

        controller = torchgco.MPPIController(problem, torchgco.MPPI(samples=1000, covariance=0.5, temperature=0.1))
        u = controller.command(x)

    Where pytorch_mppi has num_samples, noise_sigma (a matrix), lambda_, horizon and U_init, here are `MPPI.samples`,
    `covariance` (its diagonal), `temperature`, the problem's N, and `reset(U)`. Samples that touch an obstacle pay a
    penalty; other constraints than the bounds of controls don't count, as in `MPPI`. Obstacles that move go on by
    themselves where a command doesn't say where they are.

    Args:
        problem: B vehicles; its start isn't used. Of a GPU, samples run there with the extra `cuda`, else on the CPU.
        sampler: options of a command's rounds.
        seed: of the noise; commands of one seed repeat themselves, each vehicle's as it would be alone.
        period: s, by which the plan moves on from command to command; None: a stage.

    Attributes:
        numbers: what commands may change: names, shapes and values, also to be read and written by name.
        U: the plan (B, N, m), of which the last command returned the first controls.

    Raises:
        InputError: a problem with stages of several lengths or a free time; one of another device that can't be served
            from the CPU; a covariance that doesn't fit.
    """

    def __init__(
        self, problem: Problem, sampler: MPPI | None = None, seed: int = 0, period: float | None = None
    ) -> None:
        check_untransformed("MPPIController")
        problem = current_problem(problem)
        self._device, problem = problem.x0.device, held_on_cpu(problem)
        self.sampler = check_value(sampler or MPPI(), MPPI, "sampler")
        self.sampler.check(problem)
        self.seed, self.period = check_value(seed, Seed, "seed"), check_value(period, Seconds | None, "period")
        self._dt, self._motion, self._t = stage_of(problem), Motion(problem), 0.0
        self._stages = 1 if self.period is None else stages_between(self.period / self._dt)
        with torch.inference_mode(False), computing_on(CPU):
            self._problem, self._ids = with_own_numbers(problem), torch.arange(problem.B)
        self.numbers = Numbers(numbers_of(self._problem), lambda number: None)
        self.reset()

    def reset(self, U: Any = None) -> None:
        """Begin again: with the plan U (B, N, m) or (N, m), by default the cost's controls of rest.

        Raises:
            InputError: controls of another shape, or that aren't finite.
        """
        with torch.inference_mode(False), computing_on(CPU):
            problem = self._problem
            blank = problem.x0.new_zeros(problem.B, problem.N, problem.m)
            if U is None:
                plan = problem.cost.rest_controls(blank)
            else:
                plan = torch.from_numpy(as_floats(U, "U")).to(blank)
                check_shape(plan, (problem.B, problem.N, problem.m)[3 - plan.dim() :], "U")
                check_tensor(plan, "U")
                plan = plan.expand_as(blank)
        self.U, self._commands = plan.clone(), 0
        self._motion.forget()

    def command(self, x: Any, *, shift: bool = True, numbers: Mapping[str, Any] | None = None, **named: Any) -> Tensor:
        """The controls (B, m) for the next period from states x (B, n); (m,) for x (n,) of one vehicle.

        Args:
            shift: the plan begins a period later than at the last command (pytorch_mppi's shift_nominal_trajectory);
                without, commands refine the plan of one time.
            numbers, named: new numbers of the problem by name, such as x_ref or centers.

        Raises:
            InputError: states or numbers that don't fit. Nothing is changed then. A function that branches on values,
                and that mixes knots or vehicles along the plan.
        """
        state, B = measured(x, *self._problem.x0.shape), self._problem.B
        t = self._t + (self.period or self._dt) * bool(shift and self._commands)
        values = self.numbers.named(numbers, named, {"x0": state})
        self.numbers.write(self._motion.numbers(self._problem, t, values))
        self._motion.keep(self._problem, t)
        self._t = t
        with torch.no_grad(), torch.inference_mode(False), computing_on(CPU), served_by(self._device):
            before = shifted(self.U, self._stages) if shift and self._commands else self.U
            key = DrawKey(self.seed, self._ids, torch.full_like(self._ids, self._commands))
            now = current(with_numbers_as_they_are(self._problem))
            improved = self.sampler.improved(now, before, key)
            if not now.known.in_c:  # only PyTorch's kernels call code that looks at values
                check_rows(now, open_loop(now, improved), improved)
            self.U = improved
        self._commands += 1
        u = self.U[:, 0].clone().to(self._device)
        return u[0] if state.ndim == 1 and B == 1 else u
