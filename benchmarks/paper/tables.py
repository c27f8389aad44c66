"""Tables 1 to 5 and A1 to A3 of the paper, line by line: what is printed, and what our code and configurations have.

`printed` is the text of the copy at hand, which has lost its minus signs, fractions and raised digits. Our side is read
from the objects that the figures are made with. Where both differ, or the text had to be read, the line says why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from torch import Tensor

from benchmarks.paper import settings
from benchmarks.paper.runs import FOREST_LAYOUT
from benchmarks.paper.settings import Ours
from torchgco import AugmentedLagrangian
from torchgco.dynamics import Planar, QuadrotorPlanning
from torchgco.experiments.config.build import Setup
from torchgco.guidance import GCO
from torchgco.guidance.mppi import COLLISION_PENALTY
from torchgco.missions import plant
from torchgco.missions.planning_problem import airframe_of
from torchgco.missions.plant import RotorPlant, hovering
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem

SIGN = "reading: a minus sign is lost in our copy"
ROUNDED = "rounded in print"
NAMES = {"euler": "Euler method", "rk4": "Runge–Kutta method"}


@dataclass(frozen=True)
class Line:
    """One line of a table."""

    name: str
    printed: str  # as our copy has it
    meant: Any  # the printed values as we read them: a number, several, or text
    ours: Any  # the values of our code
    why: str = ""  # empty where the text needs no reading and both agree

    @property
    def agrees(self) -> bool:
        """Whether our values are those printed, as we read them."""
        if isinstance(self.meant, str) or isinstance(self.ours, str):
            return self.meant == self.ours
        meant, ours = _numbers(self.meant), _numbers(self.ours)
        return len(meant) == len(ours) and all(
            math.isclose(a, b, rel_tol=1e-9) for a, b in zip(meant, ours, strict=True)
        )


def tables() -> dict[str, list[Line]]:
    """All tables by name."""
    ours = Ours()
    model = ours.plane_problem.dynamics
    assert isinstance(model, Planar)
    return {
        "Table 1: the quadrotor's problem": _table_1(ours),
        "Table 2: the quadrotor": _table_2(ours),
        "Table 3: the simulation": _table_3(ours),
        "Table 4: MPPI and AL-iLQR in planning": _solver_lines(ours.flight, ours.space_problem, "0.10", 0.1, 50, 10),
        "Table 5: tracking": _table_5(ours),
        "Table A1: the planar problem": _table_a1(ours),
        "Table A2: the planar vehicle": [
            Line("k1 (1/s)", "10.0", 10.0, model.drag),
            Line("k2", "1.00", 1.0, model.thrust_gain),
            Line("k3 (1/s)", "0.001", 0.001, model.turn_drag),
            Line("k4 (1/m)", "0.10", 0.1, model.turn_gain),
            Line("u_max (m/s²)", "10, 10", (10, 10), settings.bounds(ours.plane_problem).upper),
            Line("u_min (m/s²)", "0, 0", (0, 0), settings.bounds(ours.plane_problem).lower),
        ],
        "Table A3: MPPI and AL-iLQR in the plane": [
            *_solver_lines(ours.plane, ours.plane_problem, "1.0 × 10 18", 1e-18, 100, 20),
            Line("saturated range in sampling", "u_max, u_max", (-10, -10, 10, 10), settings.saturation(ours), SIGN),
        ],
    }


def _table_1(ours: Ours) -> list[Line]:
    problem, cost = ours.space_problem, settings.cost(ours.space_problem)
    model, goal = problem.dynamics, [20, 1, 0.2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 9.81]
    assert isinstance(model, QuadrotorPlanning)
    planner = "in the first control step; later the former plan, one stage later"
    return [
        Line("prediction method", "Euler method", "Euler method", NAMES[str(model.integrator)]),
        Line("gravity g (m/s²)", "9.81", 9.81, model.airframe.gravity),
        Line("number of predictions N", "100", 100, problem.N),
        Line("S", "diag 1, 1, 10, 1, ...", [1, 1, 10, *[1] * 11], cost.Qf),
        Line("Q", "diag 1, 1, 100, 1, ..., 10, 10, 10, 10", [1, 1, 100, *[1] * 7, *[10] * 4], cost.Q),
        Line("R", "diag 10, 10, 10, 1", [10, 10, 10, 1], cost.R),
        Line("target state x_G", "20, 1, 0.2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, g", goal, cost.xf_ref),
        Line("target input u_G", "0, 0, 0, g", [0, 0, 0, 9.81], cost.u_ref),
        Line("initial guess u_k", "0, 0, 0, g", [0, 0, 0, 9.81], settings.guess(ours.flight, FOREST_LAYOUT), planner),
    ]


def _table_2(ours: Ours) -> list[Line]:
    mission, bounds, model = ours.flight.mission, settings.bounds(ours.space_problem), ours.space_problem.dynamics
    assert mission is not None and isinstance(model, QuadrotorPlanning)
    body = model.airframe
    inertia = [0.0366, 0, 0.0065, 0, 0.0327, 0.0046, 0.0065, 0.0046, 0.0187]
    hover = "reading: with m g / 5000² the rotors would hover at 2500 rpm, and Table 5 starts at 5000 rpm for hovering"
    mirrored = "reading: signs of the products of inertia may be lost in our copy"
    power = "reading: the exponent's sign is lost in our copy"
    return [
        Line("mass m (kg)", "1.608", 1.608, body.mass),
        Line("inertia J (kg m²), by rows", "0.0366 0 0.0065 0 0.0327 ...", inertia, body.inertia, mirrored),
        Line("length of arms l (m)", "0.216", 0.216, body.arm),
        Line("coefficient of rotors k_r (m)", "1.6 × 10 2", 1.6e-2, body.rotor_torque, power),
        Line("air resistance k_a (N m s/rad)", "1.0 × 10 2", 1e-2, body.rotational_drag, power),
        Line("time constant T_r (s)", "0.10", 0.1, body.rotor_time_constant),
        Line("coefficient b (N/rpm²)", "m g 5000 2", 1.608 * 9.81 / (4 * 5000**2), body.thrust_coefficient, hover),
        Line("f_max (N)", "6", 6, body.thrust_max),
        Line("f_min (N)", "0.1046", 0.1046, body.thrust_min),
        Line("w_max (rad/s)", "5, 5, 5", [5, 5, 5], bounds.upper[..., :3]),
        Line("w_min (rad/s)", "5, 5, 5", [-5, -5, -5], bounds.lower[..., :3], SIGN),
        Line("a_max (m/s²)", "4 f_max / m", 4 * 6 / 1.608, bounds.upper[..., 3]),
        Line("a_min (m/s²)", "4 f_min / m", 4 * 0.1046 / 1.608, bounds.lower[..., 3]),
        Line("time constant T_w (s)", "1.5", 1.5, model.rate_time_constant),
        Line("time constant T_a (s)", "1.5", 1.5, model.thrust_time_constant),
    ]


def _table_3(ours: Ours) -> list[Line]:
    mission, problem = ours.flight.mission, ours.space_problem
    assert mission is not None and isinstance(mission.plant, RotorPlant)
    spheres, dt = problem.geometric[0], float(problem.dynamics.dt)
    assert isinstance(spheres, BoundSpheres)
    vehicle, x = float(spheres.vehicle_radius), hovering(airframe_of(problem.dynamics), problem.x0[:, :3])
    obstacle = float(spheres.inflated_radii[0, 0]) - vehicle
    start = "reading: our copy has lost its minus signs; the quadrotor's open-loop scenarios start at (-1, 1, 0)"
    limits = "the plant also limits the thrusts and renormalises q in every step"
    return [
        Line("simulation method", "Runge–Kutta method", "Runge–Kutta method", NAMES[plant.rk4.__name__], limits),
        Line("time period of the simulation (s)", "0.01", 0.01, mission.plant.dt),
        Line("initial position (m)", "1, 1, 0", [1, 1, 0], x[:, :3], start),
        Line("initial velocity (m/s)", "0, 0, 0", [0, 0, 0], x[:, 3:6]),
        Line("initial orientation q", "1, 0, 0, 0", [1, 0, 0, 0], x[:, 6:10]),
        Line("initial body rates (rad/s)", "0, 0, 0", [0, 0, 0], x[:, 10:13]),
        Line("initial thrusts (N)", "m g 4, ...", [1.608 * 9.81 / 4] * 4, x[:, 13:]),
        Line("control frequency (Hz)", "20", 20, 1 / dt),
        Line("prediction period T_f (s)", "5", 5, problem.N * dt),
        Line("radius of the quadrotor (m)", "0.36", 0.36, vehicle),
        Line("the same for collisions, 0.95 r_veh (m)", "0.34", 0.34, CONTACT_FACTOR * vehicle, ROUNDED),
        Line("radius of an obstacle (m)", "0.60", 0.6, obstacle),
        Line("the same for collisions, 0.95 r_obs (m)", "0.57", 0.57, CONTACT_FACTOR * obstacle),
    ]


def _solver_lines(setup: Setup, problem: Problem, printed: str, tolerance: float, inner: int, outer: int) -> list[Line]:
    """Table 4, and Table A3 without its last line."""
    solver, plane = setup.solver, problem.m == 2
    assert isinstance(solver, AugmentedLagrangian) and isinstance(solver.guidance, GCO)
    guide, sampler = solver.guidance, solver.guidance.sampler
    samples, sigma = (500, [100, 100]) if plane else (100, [1, 1, 1, 1])
    best = "the paper's solver returns the last of its outer iterates, ours the best"
    return [
        Line("tolerance of J_curr - J_pre in iLQR", printed, tolerance, solver.inner.tolerance, SIGN if plane else ""),
        Line("iLQR, most iterations", str(inner), inner, solver.inner.max_iterations),
        Line("ALM, most iterations", str(outer), outer, solver.max_outer_iterations, best),
        Line("initial multiplier", "0", 0, settings.first_multiplier(setup, problem)),
        Line("multiplier update gain (eta)", "2.2", 2.2, solver.penalty_growth),
        Line("initial penalty", "20", 20, solver.initial_penalty),
        Line("update gain for GCO (nu)", "eta 2", 2.2**2, guide.penalty_growth, "reading: eta²"),
        Line("initial penalty for GCO", "20", 20, guide.initial_penalty),
        Line("rho_mp", "1 × 10 8, ...", 1e8, COLLISION_PENALTY, "reading: 10⁸"),
        Line("number of samples", str(samples), samples, sampler.samples),
        Line("covariance matrix", f"diag {', '.join(map(str, sigma))}", sigma, [sampler.covariance] * problem.m),
        Line("temperature", "1", 1, sampler.temperature),
    ]


def _table_5(ours: Ours) -> list[Line]:
    mission, cost = ours.flight.mission, settings.cost(ours.tracking_problem)
    assert mission is not None
    tracker, airframe = mission.tracker, airframe_of(ours.space_problem.dynamics)
    b = airframe.thrust_coefficient
    weights, plan = [1, 1, 1, *[b * b] * 4], "optimal states in path planning"
    speeds = [airframe.hover_speed] * 4
    zero = 0 if tracker.multipliers == "reset" else "the former call's"
    squared, call = "reading: b²", "in every call; the text doesn't say whether later calls start there, too"
    return [
        Line("number of predictions N", "6", 6, tracker.stages, "the text doesn't say the time step: ours is 0.01 s"),
        Line("S", "diag 1, 1, 1, b 2, b 2, b 2, b 2", weights, cost.Qf, squared),
        Line("Q", "diag 1, 1, 1, b 2, b 2, b 2, b 2", weights, cost.Q, squared),
        Line("R", "diag b 2 × 10 2, ...", [1e-2 * b * b] * 4, cost.R, "reading: 10⁻² b²"),
        Line("a_ref (m/s²)", plan, plan, settings.reference("a"), "interpolated between the plan's knots"),
        Line("w_ref (rad/s)", plan, plan, settings.reference("w"), "interpolated between the plan's knots"),
        Line("F_ref (N)", "m g 4, ...", [1.608 * 9.81 / 4] * 4, cost.xf_ref[..., 3:]),
        Line("initial guess u_k (rpm), for hovering", "5000, 5000, 5000, 5000", [5000] * 4, speeds, call),
        Line("tolerance of L_M", "0.10", 0.1, tracker.inner.tolerance),
        Line("iLQR, most iterations", "50", 50, tracker.inner.max_iterations),
        Line("ALM, most iterations", "10", 10, tracker.outer_iterations),
        Line("initial multiplier", "0", 0, zero),
        Line("multiplier update gain (eta)", "2.0", 2, tracker.penalty_growth),
        Line("initial penalty", "20", 20, tracker.penalty),
    ]


def _table_a1(ours: Ours) -> list[Line]:
    problem, cost = ours.plane_problem, settings.cost(ours.plane_problem)
    weights, tiny = [5, 5, 1e-8, 1, 1, 1e-8], "reading: 10⁻⁸"
    return [
        Line("prediction method", "Euler method", "Euler method", NAMES[str(problem.dynamics.integrator)]),
        Line("prediction period (s)", "0.01", 0.01, float(problem.dynamics.dt)),
        Line("number of predictions N", "1000", 1000, problem.N),
        Line("Q", "diag 5, 5, 1 × 10 8, 1, 1, 1 × 10 8", weights, cost.Q, tiny),
        Line("R", "diag 0.1, 0.1", [0.1, 0.1], cost.R),
        Line("S", "Q", weights, cost.Qf, tiny),
        Line("target state x_G", "1, 0.4, 0, 0, 0, 0", [1, 0.4, 0, 0, 0, 0], cost.xf_ref),
        Line("target input u_G", "0, 0", [0, 0], cost.u_ref),
        Line("initial guess u_k", "0, 0", [0, 0], settings.guess(ours.plane, 0)),
    ]


def frame(found: dict[str, list[Line]]) -> pd.DataFrame:
    """All tables as one, a row per line."""
    lines = [(name, line) for name, part in found.items() for line in part]
    rows = [(name, line.name, line.printed, _text(line.ours), line.why) for name, line in lines]
    return pd.DataFrame(rows, columns=["table", "line", "printed", "ours", "why"])


def _numbers(values: Any) -> list[float]:
    """The numbers in a number, a tensor, or nested rows of them."""
    if isinstance(values, Tensor):
        return values.flatten().tolist()
    if isinstance(values, Iterable):
        return [number for part in values for number in _numbers(part)]
    return [float(values)]


def _text(values: Any) -> str:
    """Values for a table's cell; runs of four or more equal numbers shortened."""
    if isinstance(values, str):
        return values
    numbers, parts = [f"{number:.4g}" for number in _numbers(values)], []
    while numbers:
        count = _run(numbers)
        parts += [f"{count} × {numbers[0]}"] if count > 4 else numbers[:count]
        numbers = numbers[count:]
    return ", ".join(parts)


def _run(words: Sequence[str]) -> int:
    """How many equal words a list begins with."""
    return next((i for i, word in enumerate(words) if word != words[0]), len(words))
