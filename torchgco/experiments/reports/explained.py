"""The layouts of a study that its solver failed on, explained in words."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import torch

from torchgco.experiments.config.build import Setup
from torchgco.explaining.explain import explanation
from torchgco.scenarios import Layouts

EXPLAINED = 8  # layouts at most


def explained(setup: Setup, layouts: Layouts, trials: pd.DataFrame) -> str:
    """What happened to the first layouts that the solver under study failed on.

    Failed are those without success, where that is known, else those whose goal wasn't reached. They are solved again
    with a record, by which no bit of a result changes.
    """
    own = trials[trials["solver"] == setup.solver_name]
    failed = own.loc[~own["success"].fillna(own["reached"]).astype(bool), "layout"].tolist()
    if not failed:
        return f"\n{setup.solver_name} failed on no layout: there is nothing to explain."
    shown = failed[:EXPLAINED]
    part = layouts.take(shown)
    task = setup.vehicle.task(part, setup.device, setup.dtype)
    ids = torch.as_tensor(part.ids, device=setup.device)
    solution = setup.solver.recording().solve(task.problem, task.U0, seed=setup.seed, ids=ids)
    solution = replace(solution, account=solution.account.of_preset(setup.solver_name))
    told = [explanation(solution, i, what=f"Layout {number}") for i, number in enumerate(shown)]
    more = f", the first {len(shown)} of them here" if len(failed) > len(shown) else ""
    return "\n\n".join([f"\n{setup.solver_name} failed on {len(failed)} of {len(own)} layouts{more}.", *told])
