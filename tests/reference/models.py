"""The paper's four vehicle models, the unicycle and the bicycle for one state and one control, and three integrators.

A `field(x, u)` returns dx/dt; `euler`, `midpoint` and `rk4` turn a field into `step(x, u)`. SI units,
controls of the rotor models in rpm, quaternions scalar first. Every field also accepts complex arrays, so
that `problem.py` can differentiate it by the complex step; hence no abs, no norm, no comparison in a field.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class QuadrotorParameters:
    """Table 2 of the paper, SI units. `inertia` (3, 3); the hover speed `hover_rpm` determines b."""

    mass: float = 1.608
    inertia: np.ndarray = field(
        default_factory=lambda: np.array([[0.0366, 0, 0.0065], [0, 0.0327, 0.0046], [0.0065, 0.0046, 0.0187]])
    )
    arm: float = 0.216
    k_r: float = 1.6e-2
    k_a: float = 1.0e-2
    T_r: float = 0.10
    f_min: float = 0.1046
    f_max: float = 6.0
    gravity: float = 9.81
    hover_rpm: float = 5000.0

    @property
    def b(self):
        """Thrust coefficient of f = b Omega^2, N/rpm^2: four rotors at `hover_rpm` carry the weight."""
        return self.mass * self.gravity / (4 * self.hover_rpm**2)

    @property
    def allocation(self):
        """T (3, 4): torques about the body axes in N m from the four thrusts, Eq. (5), X configuration."""
        s = self.arm / np.sqrt(2)
        return np.array([[s, -s, -s, s], [-s, -s, s, s], [self.k_r, -self.k_r, self.k_r, -self.k_r]])

    @property
    def damping(self):
        """D (3, 3), Eq. (6)."""
        return np.diag([0.0, 0.0, self.k_a])


def planar_field(x, u, k1=10.0, k2=1.0, k3=0.001, k4=0.10):
    """Appendix A. x (6) = [px, py, theta, vx, vy, thetadot], u (2) = [a_left, a_right]; returns (6)."""
    _, _, theta, vx, vy, rate = x
    left, right = u
    push = k2 * (left + right)
    return np.array(
        [
            vx,
            vy,
            rate,
            -k1 * vx + push * np.cos(theta),
            -k1 * vy + push * np.sin(theta),
            -k3 * rate + k4 * (-left + right),
        ]
    )


def unicycle_field(x, u):
    """x (4) = [px, py, heading, speed], u (2) = [acceleration, turn rate]; returns (4)."""
    _, _, heading, speed = x
    return np.array([speed * np.cos(heading), speed * np.sin(heading), u[1], u[0]])


def bicycle_field(x, u):
    """x (5) = [px, py, heading, speed, steering], u (2) = [acceleration, steering rate]; 2.6 m; returns (5)."""
    _, _, heading, speed, steering = x
    turning = speed * np.sin(steering) / np.cos(steering) / 2.6
    return np.array([speed * np.cos(heading), speed * np.sin(heading), turning, u[0], u[1]])


def thrust_acceleration(q, a, gravity):
    """v' = R(q) [0, 0, a] - [0, 0, g], Eqs. (2) and (3). q (4), a scalar; returns (3) in m/s^2."""
    q0, q1, q2, q3 = q
    return np.array(
        [
            2 * (q1 * q3 + q0 * q2) * a,
            2 * (q2 * q3 - q0 * q1) * a,
            (q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3) * a - gravity,
        ]
    )


def quaternion_rate(q, w):
    """q' = 1/2 Qx(w) q, Eq. (4). q (4), w (3) body rates in rad/s; returns (4)."""
    q0, q1, q2, q3 = q
    w1, w2, w3 = w
    return np.array(
        [
            -(q1 * w1 + q2 * w2 + q3 * w3) / 2,
            (q0 * w1 + q2 * w3 - q3 * w2) / 2,
            (q0 * w2 - q1 * w3 + q3 * w1) / 2,
            (q0 * w3 + q1 * w2 - q2 * w1) / 2,
        ]
    )


def quadrotor_planning_field(x, u, T_w=1.5, T_a=1.5, gravity=9.81):
    """Eq. (8). x (14) = [p, v, q, w, a], u (4) = [w_c, a_c]; returns (14). No renormalisation of q."""
    v, q, w, a = x[3:6], x[6:10], x[10:13], x[13]
    dw = (u[0:3] - w) / T_w
    da = (u[3] - a) / T_a
    return np.concatenate([v, thrust_acceleration(q, a, gravity), quaternion_rate(q, w), dw, [da]])


def angular_acceleration(w, F, parameters):
    """w' = J^-1 (T F - w x (J w) - D w), Eq. (2). w (3), F (4); returns (3) in rad/s^2."""
    Jw = parameters.inertia @ w
    torque = parameters.allocation @ F - np.cross(w, Jw) - parameters.damping @ w
    return np.linalg.solve(parameters.inertia, torque)


def thrust_rate(F, u, parameters):
    """F' = (2/T_r) sqrt(F) (sqrt(b) u - sqrt(F)), Eq. (2). F (4) in N, u (4) in rpm; nan where F < 0."""
    root = np.sqrt(F)
    return (2 / parameters.T_r) * root * (np.sqrt(parameters.b) * u - root)


def rotor_field(x, u, parameters=None):
    """Tracking model. x (7) = [w, F], u (4) = commanded rotor speeds in rpm; returns (7)."""
    parameters = parameters or QuadrotorParameters()
    w, F = x[0:3], x[3:7]
    return np.concatenate([angular_acceleration(w, F, parameters), thrust_rate(F, u, parameters)])


def plant_field(x, u, parameters=None):
    """Eq. (2). x (17) = [p, v, q, w, F], u (4) = commanded rotor speeds in rpm; returns (17)."""
    parameters = parameters or QuadrotorParameters()
    v, q, w, F = x[3:6], x[6:10], x[10:13], x[13:17]
    acceleration = thrust_acceleration(q, (F[0] + F[1] + F[2] + F[3]) / parameters.mass, parameters.gravity)
    return np.concatenate([v, acceleration, quaternion_rate(q, w), rotor_field(x[10:17], u, parameters)])


def plant_step(dt, parameters=None, integrator=None):
    """The plant over one step: `integrator` (RK4), then |q| set to 1, thrusts clamped to [f_min, f_max]."""
    parameters = parameters or QuadrotorParameters()
    advance = (integrator or rk4)(lambda x, u: plant_field(x, u, parameters), dt)

    def step(x, u):
        """x (17), u (4) -> (17)."""
        y = advance(x, u)
        q = y[6:10]
        y[6:10] = q / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        for i in range(13, 17):
            y[i] = min(max(y[i], parameters.f_min), parameters.f_max)
        return y

    return step


def first_step_consistency(w0, F0, T_s, parameters=None):
    """The equality imposed at knot 1 of the plan: returns g(x1) -> (3), zero where the rotors can produce x1's rates.

    0 = w(t1) - w(t0) - J^-1 (T F(t0) - w x (J w) - D w) T_s, all but w(t1) known. w0 (3), F0 (4), x1 (14).
    """
    target = w0 + angular_acceleration(w0, F0, parameters or QuadrotorParameters()) * T_s
    return lambda x1: x1[10:13] - target


def euler(field, dt):
    """x + dt f(x, u), order 1."""
    return lambda x, u: x + dt * field(x, u)


def midpoint(field, dt):
    """The explicit midpoint rule, order 2; u is held over the step."""
    return lambda x, u: x + dt * field(x + dt / 2 * field(x, u), u)


def rk4(field, dt):
    """The classical Runge-Kutta method, order 4; u is held over the step."""

    def step(x, u):
        s1 = field(x, u)
        s2 = field(x + dt / 2 * s1, u)
        s3 = field(x + dt / 2 * s2, u)
        s4 = field(x + dt * s3, u)
        return x + dt / 6 * (s1 + 2 * s2 + 2 * s3 + s4)

    return step
