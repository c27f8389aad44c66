"""OpenSCvx's published examples, solved in its own environment: PYTHON openscvx_peer.py CHECKOUT OUTPUT.npz.

Run by `openscvx.py`, with the Python that has OpenSCvx. Each example is solved as published, and with its weight of the
time 10 times as large; nodes of the last iterate go into the file, with processor time of a solve after an earlier one,
without its prints, and that of making the problem and compiling it.
"""

from __future__ import annotations

import importlib
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np

WEIGHTS = (1.0, 10.0)  # of the time, times the published one
REPEATS = 2
CAR, DRONE = ([0, 1, 2], [0, 1]), (list(range(13)), [2, 3, 4, 5])  # columns of states and controls that we have, too
EXAMPLES = {
    "car, disc aside": ("examples.car.dubins_car", CAR, {}, {}),
    "car, disc in the way": (
        "examples.car.dubins_car",
        CAR,
        {"obs_center": np.array([0.5, 0.0])},
        {"lam_cost": 1e-1, "lam_vc": 1e2},
    ),
    "drone past ellipsoids": ("examples.drone.obstacle_avoidance", DRONE, {}, {}),
    "race through ten gates": ("examples.drone.drone_racing", DRONE, {}, {}),
}  # modules, columns, then parameters and settings of the second car, as its file changes them


def nodes_of(problem: Any, columns: Any) -> dict[str, np.ndarray]:
    """The nodes of a solve from the published guess, and what it took."""
    took = []
    for _ in range(REPEATS + 1):  # the first compiles
        problem.reset()
        began = time.process_time()
        result = problem.solve()
        took.append(time.process_time() - began)
    x, u = (np.asarray(series[-1], dtype=float) for series in (result.X, result.U))
    states, controls = columns
    return {
        "x": x[:, states], "u": u[:, controls], "rate": u[:, -1], "seconds": np.array(min(took[1:])),
        "converged": np.array(bool(result.converged)), "iterations": np.array(len(result.X) - 1),
    }  # fmt: skip


def main(checkout: str, output: str) -> None:
    sys.path.insert(0, str(Path(checkout)))
    for name in ("examples.plotting", "examples.plotting_viser"):  # pictures aren't asked for
        module: Any = types.ModuleType(name)
        module.__getattr__ = lambda _: None
        sys.modules[name] = module
    found, made = dict[str, Any](), dict[str, Any]()
    for name, (module, columns, parameters, settings) in EXAMPLES.items():
        if module not in made:
            began = time.process_time()
            made[module] = importlib.import_module(module).problem
            made[module].settings.dev.printing = False
            made[module].initialize()
            made[module].emitter_function = lambda _: None
            found[f"{name}/compile"] = np.array(time.process_time() - began)
        problem = made[module]
        for key, value in parameters.items():
            problem.parameters[key] = value
        for key, value in settings.items():
            setattr(problem.settings.scp, key, value)
        weight = problem.settings.scp.lam_cost
        for factor in WEIGHTS:
            problem.settings.scp.lam_cost = factor * weight
            found |= {f"{name}/{factor:g}/{key}": value for key, value in nodes_of(problem, columns).items()}
    np.savez(output, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
