"""The airframe of a plant, by least squares on flights that were recorded: states and commands at equal time steps.

Three fits follow each other. Rotors: the root s of a thrust, which is proportional to the speed, follows its command,

    s' = a s + (1 - a) clip(sqrt(b) u, s_min, s_max),  a = exp(-dt / T_r),

with u as it was some time steps before, where there is a delay. Mass and drag: m (v' + g e3) + d v = F R e3. Inertia
and the torques about z: J w' + w x J w + k_a w_z e3 - k_r (F1 - F2 + F3 - F4) e3 is what thrusts do at the arm. That is
given: rates and thrusts don't separate arm and inertia. Where it explains more, so do rotors of an inertia that speed
up. Thrusts are means over a time step, of the first fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Seconds, Seed, check_value
from torchgco.base.shapes import check_tensor
from torchgco.dynamics.quadrotor import RADIANS, ROTOR_SPINS, Airframe
from torchgco.missions.plant import Plant, flown, hovering

SLOW_FLIGHT, CALM_FLIGHT = 8.0, 10.0  # m/s and rad/s: samples beyond don't count, as air and long steps tell there
THRUST_RANGE = 3.4  # of the logarithm of the root of a thrust coefficient: thirty times more or less
MOST_DELAY = 10  # time steps of a delay that are tried
DELAY_GAIN = 0.9  # share of the error without a delay, or an inertia of rotors, below which that is believed
LEAST = 50  # samples of a fit
RESOLVED = 1.0  # time steps: Euler's steps, as the tracker's are, go beyond the end of a faster lag
ASKED_MORE = 0.01  # share of the root of a limit by which a command has to ask for more, to have met it
LEAST_SPIN = 0.02  # of the thrust in hover: rotors that stand still take long to turn again
INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of the inertia


@dataclass(frozen=True)
class Identified:
    """What flights say of a vehicle.

    Args:
        airframe: mass, inertia, yaw torque, drags, time constant, limits and speed in hover; arm, gravity and radius
            are those that were given. Its time constant contains the delay.
        delay: s between a command and its first effect.
        limits_met: whether commands went beyond the least and the greatest thrust; else that limit is the least or the
            greatest that was commanded.
        thrust_error, force_error, torque_error: root mean squares of what the fits leave, as shares of what they fit.
        samples: time steps that the fits of mass and inertia used.
    """

    airframe: Airframe
    delay: float
    limits_met: tuple[bool, bool]
    thrust_error: float
    force_error: float
    torque_error: float
    samples: int


def record(plant: Plant, airframe: Airframe, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Twelve short flights of a plant without a planner, in the open: states (12, K+1, 17), commands (12, K, 4), rpm.

    They begin at drawn velocities, attitudes and rates. In eight of them each rotor's command changes by some per cent
    around that of the hover, in four all rotors step to speeds up to three times what the airframe takes for the
    greatest, to find the limits.
    """
    seed = check_value(seed, Seed, "seed")
    rng = np.random.default_rng(seed)
    x, low, high = hovering(airframe, torch.zeros(12, 3, dtype=torch.float64)), *airframe.rotor_speeds
    x[:, 2] = 100.0  # m, away from a floor that a simulator may have
    draw = lambda size, *shape: torch.from_numpy(size * rng.standard_normal(shape))
    x[:, 3:6] += draw(2.0, 12, 3)
    x[:, 7:9] += draw(0.1, 12, 2)
    x[:, 6:10] /= x[:, 6:10].norm(dim=1, keepdim=True)
    x[:, 10:13] += draw(0.5, 12, 3)
    K, steps_held = max(1, round(1.2 / plant.dt)), max(1, round(0.05 / plant.dt))
    changes = draw(0.05, 8, -(-K // steps_held), 4) + draw(0.1, 8, -(-K // steps_held), 1)
    turning = airframe.hover_speed * (1.0 + changes).repeat_interleave(steps_held, dim=1)[:, :K]
    steps = torch.tensor([[0.0, 1.5 * high], [3.0 * high, 0.5 * low], [0.8 * high, 0.0], [1.2 * high, 2.2 * high]])
    stepping = steps.double().repeat_interleave(-(-K // 2), dim=1)[:, :K, None].expand(-1, -1, 4)
    u, made = torch.cat((turning, stepping)), flown(plant, airframe)
    states, calm = [x], torch.zeros(12, 3, dtype=torch.float64)
    for k in range(K):
        states.append(made.advance(states[-1], u[:, k], calm))
    return torch.stack(states, dim=1), u


def identify(x: Tensor, u: Tensor, dt: float, airframe: Airframe) -> Identified:
    """The airframe that explains B flights of K time steps.

    Args:
        x: states (B, K+1, 17) of the plant; u: commands (B, K, 4), rpm. Flights may end with NaN.
        dt: s between two of them.
        airframe: whose arm, gravity and radius are taken, and whose values the search for the rest begins at.

    Raises:
        InputError: other shapes or precisions, too few samples within 8 m/s and 10 rad/s, or flights that no quadrotor
            with these arms explains.
    """
    check_value(dt, Seconds, "dt")
    if not isinstance(x, Tensor) or x.dim() != 3 or x.shape[2] != 17 or x.shape[1] < 2:
        raise InputError("x", "states (B, K+1, 17)", tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__)
    check_tensor(u, "u", x)
    if u.shape != (x.shape[0], x.shape[1] - 1, 4):
        raise InputError("u", f"commands {(x.shape[0], x.shape[1] - 1, 4)}", tuple(u.shape))
    states, commands = x.detach().cpu().double().numpy(), u.detach().cpu().double().numpy()
    rotors = _rotors(states[..., 13:].clip(min=0.0), commands, dt, airframe)
    thrusts = rotors.mean_thrusts(states[:, :-1, 13:].clip(min=0.0), commands, dt)
    first, second = states[:, :-1].reshape(-1, 17), states[:, 1:].reshape(-1, 17)
    F = thrusts.reshape(-1, 4)
    calm = [np.isfinite(values).all(1) for values in (first, second, F)]
    calm += [np.linalg.norm(values[:, 3:6], axis=1) < SLOW_FLIGHT for values in (first, second)]
    calm += [np.linalg.norm(values[:, 10:13], axis=1) < CALM_FLIGHT for values in (first, second)]
    use = np.logical_and.reduce(calm)
    if int(use.sum()) < LEAST:
        raise InputError(
            "x", f"at least {LEAST} time steps within {SLOW_FLIGHT:g} m/s and {CALM_FLIGHT:g} rad/s", int(use.sum())
        )
    first, second, F = first[use], second[use], F[use]
    mass, drag, force_error = _mass(first, second, F, dt, airframe)
    fits = [_inertia(first, second, F, dt, airframe, b) for b in (None, rotors.b)]
    inertia, turning, torque_error = fits[fits[1][-1] < DELAY_GAIN * fits[0][-1]]
    estimates = {
        "mass": mass, "drag": drag, "inertia": inertia, **turning, **rotors.limits(mass, dt, airframe),
        "hover_speed": math.sqrt(mass * airframe.gravity / 4.0 / rotors.b),
    }  # fmt: skip
    try:
        made = replace(airframe, **estimates)
    except InputError as error:
        raise InputError("x", "flights of a quadrotor", f"{error.field} {error.got}") from None
    return Identified(
        made, rotors.late * dt, rotors.met, rotors.error, force_error, torque_error, int(use.sum())
    )  # fmt: skip


@dataclass(frozen=True)
class _Rotors:
    """The fit of the rotors: roots of thrusts, sqrt(N).

    Args:
        b: thrust coefficient, N/rpm^2; T: time constant, s; late: time steps of delay.
        low, high: roots of the limits; met: whether commands went beyond.
        error: root mean square of what is left, as a share of the root's own.
    """

    b: float
    T: float
    low: float
    high: float
    late: int
    met: tuple[bool, bool]
    error: float

    def mean_thrusts(self, F: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Means (B, K, 4) over the time steps, for thrusts F at their starts and commands u, both (B, K, 4)."""
        end = np.clip(math.sqrt(self.b) * _later(u, self.late), self.low, self.high)
        gap, r = np.sqrt(F) - end, dt / self.T
        return end**2 + 2.0 * end * gap * -np.expm1(-r) / r + gap**2 * -np.expm1(-2.0 * r) / (2.0 * r)

    def limits(self, mass: float, dt: float, frame: Airframe) -> dict[str, float]:
        """The limits and the time constant of an airframe that the tracker can follow."""
        least = LEAST_SPIN * mass * frame.gravity / 4.0
        return {
            "thrust_min": max(self.low**2, least), "thrust_max": self.high**2,
            "rotor_time_constant": max(self.T + self.late * dt, RESOLVED * dt),
        }  # fmt: skip


def _later(u: np.ndarray, late: int) -> np.ndarray:
    """Commands (B, K, 4) as they take effect, so many time steps later; the first one before them."""
    return np.concatenate((u[:, :1].repeat(late, axis=1), u[:, : u.shape[1] - late]), axis=1)


def _rotors(F: np.ndarray, u: np.ndarray, dt: float, frame: Airframe) -> _Rotors:
    """The fit for thrusts F (B, K+1, 4) and commands u (B, K, 4), with the delay that explains most."""
    best: _Rotors | None = None
    for late in range(min(MOST_DELAY, u.shape[1] // 2) + 1):
        fit = _rotors_late(F, u, late, dt, frame)
        if best is None or fit.error < (DELAY_GAIN if best.late == 0 else 1.0) * best.error:
            best = fit
    assert best is not None
    return best


def _rotors_late(F: np.ndarray, u: np.ndarray, late: int, dt: float, frame: Airframe) -> _Rotors:
    s, speed = np.sqrt(F), _later(u, late)
    before, after = s[:, late:-1].reshape(-1), s[:, late + 1 :].reshape(-1)  # what came before a flight isn't known
    speed = speed[:, late:].reshape(-1)
    use = np.isfinite(before) & np.isfinite(after) & np.isfinite(speed)
    if int(use.sum()) < LEAST:
        raise InputError("x", f"at least {LEAST} finite thrusts with their commands", int(use.sum()))
    before, after, speed = before[use], after[use], speed[use]
    hover, root = math.sqrt(frame.hover_thrust), math.sqrt(frame.thrust_coefficient)

    def left(z: np.ndarray) -> np.ndarray:
        a = math.exp(-dt / math.exp(z[0]))
        end = np.clip(math.exp(z[1]) * speed, *np.sort(z[2:] * hover))
        return (a * before + (1.0 - a) * end - after) / hover

    lag = math.log(frame.rotor_time_constant), math.log(root)
    ends = (math.log(dt / 20.0), lag[1] - THRUST_RANGE, 0.0, 0.0), (math.log(5.0), lag[1] + THRUST_RANGE, 100.0, 100.0)
    fits = []
    for within in (after, root * speed):  # limits that were met, and none
        begin = np.clip((*lag, float(within.min()) / hover, float(within.max()) / hover), *ends)
        fits.append(least_squares(left, begin, bounds=ends, x_scale=(1.0, 0.1, 0.1, 0.1)))
    z = min(fits, key=lambda fit: fit.cost).x
    T, root, low, high = math.exp(z[0]), math.exp(z[1]), *(np.sort(z[2:]) * hover)
    asked = float(root * speed.min()), float(root * speed.max())
    met = bool(asked[0] < (1.0 - ASKED_MORE) * low), bool(asked[1] > (1.0 + ASKED_MORE) * high)
    error = float(np.sqrt(np.mean(left(z) ** 2)))
    return _Rotors(root**2, T, max(low, asked[0]), min(high, asked[1]), late, met, error)


def _mass(
    first: np.ndarray, second: np.ndarray, F: np.ndarray, dt: float, frame: Airframe
) -> tuple[float, float, float]:
    """Mass, drag and the error, from states (S, 17) a time step apart and the mean thrusts (S, 4) between them."""
    lift = F.sum(1, keepdims=True) * _axis(first[:, 6:10] + second[:, 6:10])
    rate = (second[:, 3:6] - first[:, 3:6]) / dt + (0.0, 0.0, frame.gravity)
    v = 0.5 * (first[:, 3:6] + second[:, 3:6])
    per_mass, loss = np.linalg.lstsq(np.stack((lift.ravel(), -v.ravel()), axis=1), rate.ravel(), rcond=None)[0]
    if not per_mass > 0:
        raise InputError("x", "flights that thrusts lift", f"a fit with a mass of {1 / per_mass:.3g} kg")
    left = per_mass * lift - loss * v - rate
    return 1.0 / per_mass, max(loss, 0.0) / per_mass, _share(left, rate)


def _inertia(
    first: np.ndarray, second: np.ndarray, F: np.ndarray, dt: float, frame: Airframe, b: float | None
) -> tuple[tuple[tuple[float, float, float], ...], dict[str, float], float]:
    """Inertia, `rotor_torque`, `rotational_drag`, with a thrust coefficient b `rotor_inertia`, and the error.

    What is left is measured as angular accelerations, whose differences have the noise: in torques, where they are
    multiplied by the unknowns, noise would make the inertia small. The search begins at the torques' linear fit.
    """
    rate, w = (second[:, 10:13] - first[:, 10:13]) / dt, 0.5 * (first[:, 10:13] + second[:, 10:13])
    torque = F @ frame.allocation(torch.zeros(1, dtype=torch.float64)).numpy().T
    torque[:, 2] = 0.0
    about, columns, spins = np.array((0.0, 0.0, 1.0)), list[np.ndarray](), np.array(ROTOR_SPINS)
    speeds = np.sqrt(second[:, 13:].clip(min=0.0)) - np.sqrt(first[:, 13:].clip(min=0.0))
    faster = np.zeros(len(w)) if b is None else RADIANS / math.sqrt(b) / dt * speeds @ spins
    for i, j in INERTIA_ENTRIES:
        J = np.zeros((3, 3))
        J[i, j] = J[j, i] = 1.0
        columns.append(rate @ J + np.cross(w, w @ J))
    columns += [-(F @ spins)[:, None] * about, w[:, 2:] * about, *([] if b is None else [-faster[:, None] * about])]
    A, scale = np.stack([column.ravel() for column in columns], axis=1), _scale(frame)[: len(columns)]
    begin = np.linalg.lstsq(A * scale, torque.ravel(), rcond=None)[0]

    def left(z: np.ndarray) -> np.ndarray:
        J, spin, loss, rotor = _unpacked(z * scale)
        yaw = spin * (F @ spins) - loss * w[:, 2] + rotor * faster
        moment = torque - np.cross(w, w @ J) + yaw[:, None] * about
        return (np.linalg.lstsq(J, moment.T, rcond=None)[0].T - rate).ravel()

    z = least_squares(left, begin, x_scale=np.maximum(np.abs(begin), 1e-3)).x
    J, spin, loss, rotor = _unpacked(z * scale)
    xx, xy, xz, yy, yz, zz = J[np.triu_indices(3)].tolist()
    turning = {"rotor_torque": spin, "rotational_drag": max(loss, 0.0), "rotor_inertia": max(rotor, 0.0)}
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)), turning, _share(left(z), rate.ravel())


def _unpacked(theta: np.ndarray) -> tuple[np.ndarray, float, float, float]:
    """The inertia (3, 3), the yaw torque, its drag and the rotors' inertia, from the unknowns of `_inertia`."""
    J = np.zeros((3, 3))
    for value, (i, j) in zip(theta, INERTIA_ENTRIES, strict=False):
        J[i, j] = J[j, i] = value
    return J, float(theta[6]), float(theta[7]), float(theta[8]) if len(theta) > 8 else 0.0


def _scale(frame: Airframe) -> np.ndarray:
    """Sizes of the unknowns of `_inertia`."""
    J = np.array(frame.inertia)
    size = float(np.diag(J).mean())
    return np.array([size] * 6 + [frame.rotor_torque, size, 1e-3 * size])


def _axis(q: np.ndarray) -> np.ndarray:
    """Axes of thrust (S, 3) in the world, for quaternions (S, 4) of any length."""
    q0, q1, q2, q3 = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack((2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0**2 - q1**2 - q2**2 + q3**2), axis=1)


def _share(left: np.ndarray, of: np.ndarray) -> float:
    return float(np.sqrt(np.square(left).mean() / np.square(of).mean()))
