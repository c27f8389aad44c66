"""The NumPy reference against finite differences, SciPy, dense linear algebra and hand-made cases."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import lsq_linear, minimize
from scipy.spatial.transform import Rotation

from tests.reference import models
from tests.reference.augmented_lagrangian import Schedule, solve
from tests.reference.guidance import active_spheres, cpuf, cpuf_hook, stuck_knots
from tests.reference.ilqr import backward, forward, ilqr
from tests.reference.lagrangian import (
    Guide,
    Multipliers,
    expansion,
    lagrangian,
    penalty_weight,
    updated_multipliers,
)
from tests.reference.mppi import MppiSettings, collisions, mppi
from tests.reference.problem import (
    ReferenceProblem,
    Row,
    complex_jacobian,
    constraint_rows,
    cost,
    max_violation,
    rollout,
    step_jacobians,
)


def differences(function, z, h=1e-6):
    """Central differences (p, len(z)) of function: (len(z),) -> (p,) or scalar."""
    columns = []
    for j in range(len(z)):
        e = h * np.eye(len(z))[j]
        columns.append((np.atleast_1d(function(z + e)) - np.atleast_1d(function(z - e))) / (2 * h))
    return np.stack(columns, axis=1)


def point_mass(N=12, dt=0.2, start=(-1.0, 0.1), goal=(1.0, 0.0), R=0.02, **options):
    """A double integrator in the plane, x = [p, v], u = acceleration."""
    A = np.block([[np.eye(2), dt * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    B = np.vstack([dt**2 / 2 * np.eye(2), dt * np.eye(2)])
    return ReferenceProblem(
        step=lambda x, u: A @ x + B @ u,
        x0=np.array([*start, 0, 0]),
        N=N,
        Q=np.diag([0.1, 0.1, 0.01, 0.01]),
        R=R * np.eye(2),
        S=np.diag([10.0, 10, 1, 1]),
        x_ref=np.array([*goal, 0, 0]),
        u_ref=np.zeros(2),
        **options,
    )


def planar(N=10, dt=0.1, **options):
    """The planar vehicle with every term of the cost, two spheres (one moving) and bounds."""
    rng = np.random.default_rng(3)
    return ReferenceProblem(
        step=models.euler(models.planar_field, dt),
        x0=np.array([-0.6, 0.1, 0.3, 0.4, -0.2, 0.5]),
        N=N,
        Q=np.diag([5, 5, 0.3, 1, 1, 0.2]),
        R=np.diag([0.1, 0.2]),
        S=np.diag([5, 5, 0.4, 1, 1, 0.1]),
        x_ref=rng.normal(0, 0.2, (N + 1, 6)),
        u_ref=rng.normal(2, 0.2, (N, 2)),
        q=rng.normal(0, 0.1, 6),
        r=rng.normal(0, 0.1, 2),
        q_N=rng.normal(0, 0.1, 6),
        H=rng.normal(0, 0.05, (2, 6)),
        centers=np.array([[-0.5, 0.2], [0.3, -0.1]]),
        velocities=np.array([[0.1, 0.2], [0, 0]]),
        dt=dt,
        contact=np.array([0.5, 0.4]),
        u_lower=np.zeros(2),
        u_upper=np.array([2.2, 10]),
        equalities=[(3, lambda x: np.array([x[2] * x[3] - 0.1, x[5]]))],
        inequalities=[(N, lambda x: np.array([0.05 - x[0] ** 2]))],
        **options,
    )


def random_multipliers(problem, seed=0):
    rng = np.random.default_rng(seed)
    lam = Multipliers.zeros(problem)
    lam.spheres[:] = rng.uniform(0, 2, lam.spheres.shape) * (rng.random(lam.spheres.shape) < 0.5)
    lam.bounds[:] = rng.uniform(0, 2, lam.bounds.shape) * (rng.random(lam.bounds.shape) < 0.3)
    lam.equalities = [rng.normal(size=a.shape) for a in lam.equalities]
    lam.inequalities = [rng.uniform(0, 1, a.shape) for a in lam.inequalities]
    return lam


def some_guide(problem):
    """A guide with small radii at knots 0, 4 and N; 0 and N are exempt."""
    guide = Guide(np.zeros((problem.N + 1, 2)), np.full(problem.N + 1, 1e6))
    guide.p[:] = 0.4
    guide.r[[0, 4, problem.N]] = 0.05
    return guide


# --- models -----------------------------------------------------------------------------------------------

STEPS = {
    "planar": (models.euler(models.planar_field, 0.01), 6, 2, False),
    "planning": (models.euler(models.quadrotor_planning_field, 0.05), 14, 4, False),
    "planning-rk4": (models.rk4(models.quadrotor_planning_field, 0.05), 14, 4, False),
    "rotors": (models.midpoint(models.rotor_field, 0.05), 7, 4, True),
    "plant": (models.rk4(models.plant_field, 0.01), 17, 4, True),
}


@pytest.mark.parametrize("name", STEPS)
def test_complex_step_agrees_with_central_differences(name):
    step, n, m, rotors = STEPS[name]
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=n), rng.normal(size=m)
    if rotors:
        x[-4:], u = rng.uniform(1, 5, 4), rng.uniform(4000, 6000, 4)
    f_x = complex_jacobian(lambda z: step(z, u), x)
    f_u = complex_jacobian(lambda z: step(x, z), u)
    np.testing.assert_allclose(f_x, differences(lambda z: step(z, u), x), atol=1e-8)
    np.testing.assert_allclose(f_u, differences(lambda z: step(x, z), u, h=1e-6 * max(1, u[0])), atol=1e-8)


def test_complex_step_is_exact_to_rounding():
    z = np.array([0.7, -1.3])
    J = complex_jacobian(lambda z: np.array([np.sin(z[0]) * z[1], np.exp(z[1])]), z)
    exact = [[np.cos(0.7) * -1.3, np.sin(0.7)], [0, np.exp(-1.3)]]
    np.testing.assert_allclose(J, exact, rtol=1e-15)


def test_planar_field_by_hand():
    x = np.array([0.0, 0.0, np.pi / 6, 1.0, 2.0, 3.0])
    got = models.planar_field(x, np.array([4.0, 6.0]))
    np.testing.assert_allclose(got, [1, 2, 3, -10 + 5 * np.sqrt(3), -20 + 5, -0.003 + 0.2], rtol=1e-14)


def test_hover_is_an_equilibrium_of_all_quadrotor_models():
    parameters = models.QuadrotorParameters()
    F = np.full(4, parameters.mass * parameters.gravity / 4)
    u = np.full(4, 5000.0)
    x = np.concatenate([[1, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], F])
    np.testing.assert_allclose(models.plant_field(x, u), 0, atol=1e-12)
    np.testing.assert_allclose(models.rotor_field(x[10:], u), 0, atol=1e-12)
    np.testing.assert_allclose(models.plant_step(0.01)(x, u), x, atol=1e-12)
    plan = np.concatenate([x[:13], [9.81]])
    np.testing.assert_allclose(models.quadrotor_planning_field(plan, np.array([0, 0, 0, 9.81])), 0, atol=1e-14)


def test_thrust_direction_and_quaternion_rate_match_scipy_rotations():
    rng = np.random.default_rng(0)
    q, w = rng.normal(size=4), rng.normal(size=3)
    q /= np.linalg.norm(q)
    turn = Rotation.from_quat(q, scalar_first=True)
    expected = turn.apply([0, 0, 7.0]) - [0, 0, 9.81]
    np.testing.assert_allclose(models.thrust_acceleration(q, 7.0, 9.81), expected, rtol=1e-13)

    def after(t):
        p = (turn * Rotation.from_rotvec(w * t)).as_quat(scalar_first=True)
        return p * np.sign(p @ q)

    rate = (after(1e-5) - after(-1e-5)) / 2e-5
    np.testing.assert_allclose(models.quaternion_rate(q, w), rate, atol=1e-9)


def test_rotor_speed_follows_its_first_order_lag():
    parameters = models.QuadrotorParameters()
    omega0, command, t = 4000.0, np.array([5200.0] * 4), 0.07
    x0 = np.concatenate([[0, 0, 0], np.full(4, parameters.b * omega0**2)])
    end = solve_ivp(lambda _, x: models.rotor_field(x, command), (0, t), x0, rtol=1e-11, atol=1e-12).y[:, -1]
    omega = command[0] + (omega0 - command[0]) * np.exp(-t / parameters.T_r)
    np.testing.assert_allclose(np.sqrt(end[3:] / parameters.b), omega, rtol=1e-9)


def test_free_rotation_keeps_its_angular_momentum_and_damping_takes_yaw_energy():
    free = models.QuadrotorParameters(k_a=0.0)

    def spin(x, _):
        return np.concatenate(
            [models.quaternion_rate(x[:4], x[4:]), models.angular_acceleration(x[4:], np.zeros(4), free)]
        )

    def momentum(x):
        return Rotation.from_quat(x[:4], scalar_first=True).apply(free.inertia @ x[4:])

    x0 = np.array([1.0, 0, 0, 0, 1.0, -2.0, 0.7])
    x = x0
    for _ in range(50):
        x = models.rk4(spin, 0.01)(x, None)
    assert np.abs(x - x0).max() > 0.4
    np.testing.assert_allclose(momentum(x), momentum(x0), atol=1e-8)
    damped = models.QuadrotorParameters()
    power = x0[4:] @ damped.inertia @ models.angular_acceleration(x0[4:], np.zeros(4), damped)
    assert power == pytest.approx(-damped.k_a * 0.7**2)


def test_torques_have_the_signs_of_their_rows():
    parameters = models.QuadrotorParameters()
    for rotor, signs in enumerate([(1, -1, 1), (-1, -1, -1), (-1, 1, 1), (1, 1, -1)]):
        dw = models.angular_acceleration(np.zeros(3), np.eye(4)[rotor], parameters)
        lever = np.array([0.216 / np.sqrt(2), 0.216 / np.sqrt(2), 0.016])
        np.testing.assert_allclose(parameters.inertia @ dw, lever * signs, rtol=1e-12)


def test_plant_step_clamps_thrusts_and_renormalises():
    step = models.plant_step(0.01)
    x = np.concatenate([np.zeros(6), [0.8, 0.1, 0.5, -0.2], [3, -2, 5], [5.99, 5.99, 0.11, 0.11]])
    y = step(x, np.array([20000.0, 20000.0, 0.0, 0.0]))
    np.testing.assert_array_equal(y[13:], [6.0, 6.0, 0.1046, 0.1046])
    assert abs(y[6:10] @ y[6:10] - 1) < 1e-14
    raw = models.rk4(models.plant_field, 0.01)(x, np.array([20000.0, 20000.0, 0.0, 0.0]))
    assert raw[13] > 6 and raw[15] < 0.1046
    np.testing.assert_array_equal(raw[:6], y[:6])


@pytest.mark.parametrize(("integrator", "order"), [(models.euler, 1), (models.midpoint, 2), (models.rk4, 4)])
def test_integrators_have_their_order(integrator, order):
    x0, u = np.array([-1, 0, 0.3, 1, 0, 1.0]), np.array([1.0, 2.0])
    exact = solve_ivp(lambda _, x: models.planar_field(x, u), (0, 0.4), x0, rtol=1e-13, atol=1e-13).y[:, -1]
    errors = []
    for steps in (20, 40):
        x = x0
        for _ in range(steps):
            x = integrator(models.planar_field, 0.4 / steps)(x, u)
        errors.append(np.abs(x - exact).max())
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.35


def test_first_step_consistency_vanishes_where_the_rotors_can():
    w0, F0 = np.array([0.1, -0.2, 0.3]), np.array([3.0, 4.0, 3.5, 4.2])
    g = models.first_step_consistency(w0, F0, 0.05)
    x1 = np.zeros(14)
    x1[10:13] = w0 + 0.05 * models.rotor_field(np.concatenate([w0, F0]), np.zeros(4))[:3]
    np.testing.assert_allclose(g(x1), 0, atol=1e-15)
    x1[11] += 0.5
    np.testing.assert_allclose(g(x1), [0, 0.5, 0], atol=1e-15)


# --- problem and augmented Lagrangian ---------------------------------------------------------------------


def test_cost_by_hand():
    problem = ReferenceProblem(
        step=lambda x, u: x + u,
        x0=np.array([1.0]),
        N=2,
        Q=[[2.0]],
        R=[[4.0]],
        S=[[6.0]],
        x_ref=np.array([[0.0], [1.0], [2.0]]),
        u_ref=np.array([[0.0], [1.0]]),
        q=[1.0],
        r=[0.5],
        q_N=[3.0],
        H=[[10.0]],
        position=(0,),
    )
    U = np.array([[1.0], [3.0]])
    X = rollout(problem, U)
    np.testing.assert_array_equal(X[:, 0], [1, 2, 5])
    # e = 1, 1, 3 and e_u = 1, 2
    expected = (1 + 1 + 0.5 + 2 + 10) + (1 + 1 + 1 + 8 + 20) + (9 + 27)
    assert cost(problem, X, U) == expected


def test_rows_by_hand():
    problem = planar(N=4)
    x, u = np.array([0.1, 0.2, 0, 0, 0, 0]), np.array([3.0, -1.0])
    rows = constraint_rows(problem, 3, x, u)
    assert [(r.block, r.i, r.j) for r in rows[:2]] == [("spheres", 2, 0), ("spheres", 2, 1)]
    np.testing.assert_allclose(rows[0].c, 0.25 - (0.1 + 0.5 - 0.03) ** 2 - 0.06**2)
    assert [r.c for r in rows[2:6]] == pytest.approx([0.8, -11, -3, 1])
    assert [(r.block, r.j) for r in rows[2:6]] == [("bounds", j) for j in range(4)]
    assert [r.equality for r in rows[6:]] == [True, True]
    assert [r.block for r in constraint_rows(problem, 0, x, u)] == ["bounds"] * 4
    assert [r.block for r in constraint_rows(problem, 4, x, None)] == ["spheres"] * 2 + ["inequalities"]


def test_row_gradients_agree_with_differences():
    problem = planar()
    rng = np.random.default_rng(5)
    x, u = rng.normal(size=6), rng.normal(size=2)
    for k in (0, 3, 10):
        control = None if k == 10 else u
        c_x = differences(lambda z: np.array([r.c for r in constraint_rows(problem, k, z, control)]), x)  # noqa: B023
        np.testing.assert_allclose([r.c_x for r in constraint_rows(problem, k, x, control)], c_x, atol=1e-8)
    c_u = differences(lambda z: np.array([r.c for r in constraint_rows(problem, 3, x, z)]), u)
    np.testing.assert_allclose([r.c_u for r in constraint_rows(problem, 3, x, u)], c_u, atol=1e-8)


@pytest.mark.parametrize(
    ("equality", "c", "lam", "weight"),
    [(False, -1, 0, 0), (False, -1, 0.1, 7), (False, 0, 0, 7), (False, 1, 0, 7), (True, -1, 0, 7)],
)
def test_penalty_rule(equality, c, lam, weight):
    assert penalty_weight(Row("spheres", 0, 0, equality, c, None, None), lam, 7) == weight


def test_lagrangian_by_hand():
    problem = point_mass(N=2, dt=1.0, start=(0, 0), centers=[[1.0, 0.0]], contact=[2.0])
    U = np.zeros((2, 2))
    X = rollout(problem, U)
    lam = Multipliers.zeros(problem)
    lam.spheres[1, 0] = 5.0
    guide = Guide(np.tile([0.0, 3.0], (3, 1)), np.array([1.0, 2.0, 1.0]))
    # c = 4 - 1 = 3 at knots 1 and 2; f = 9 - 4 = 5 at knot 1 alone
    expected = cost(problem, X, U) + 2 * (20 / 2 * 9) + 5 * 3 + 30 / 2 * 25
    assert lagrangian(problem, X, U, lam, 20.0, guide, 30.0) == pytest.approx(expected, rel=1e-14)


def test_expansion_gradients_and_gauss_newton_hessian():
    problem = planar()
    X = rollout(problem, np.full((10, 2), 2.5))
    lam, guide, mu, mu_gco = random_multipliers(problem), some_guide(problem), 30.0, 50.0

    def value(k, x, u):
        X_k, U_k = X.copy(), np.full((10, 2), 2.5)
        X_k[k] = x
        if u is not None:
            U_k[k] = u
        return lagrangian(problem, X_k, U_k, lam, mu, guide, mu_gco)

    def gradient_u(k, z, x):
        return expansion(problem, k, x, z, lam, mu, guide, mu_gco).u

    for k in (0, 3, 4, 7, 10):
        u = None if k == 10 else np.array([2.5, 2.5])
        L = expansion(problem, k, X[k], u, lam, mu, guide, mu_gco)
        np.testing.assert_allclose(L.x, differences(lambda z: value(k, z, u), X[k])[0], atol=2e-6)  # noqa: B023
        if u is not None:
            np.testing.assert_allclose(L.u, differences(lambda z: value(k, X[k], z), u)[0], atol=2e-6)  # noqa: B023
            np.testing.assert_allclose(L.uu, differences(lambda z: gradient_u(k, z, X[k]), u), atol=1e-5)  # noqa: B023
            ux = differences(lambda z: gradient_u(k, u, z), X[k])  # noqa: B023
            np.testing.assert_allclose(L.ux, ux, atol=1e-5)

    # Knot 4: both spheres' and the guide's Gauss-Newton terms, added up by hand.
    rows = [r for r in constraint_rows(problem, 4, X[4], np.array([2.5, 2.5])) if r.block == "spheres"]
    H = problem.Q.copy()
    for row in rows:
        if row.c >= 0 or lam.spheres[3, row.j] > 0:
            H += mu * np.outer(row.c_x, row.c_x)
    offset = np.zeros(6)
    offset[:2] = 2 * (X[4, :2] - 0.4)
    H += mu_gco * np.outer(offset, offset)
    np.testing.assert_allclose(expansion(problem, 4, X[4], np.array([2.5, 2.5]), lam, mu, guide, mu_gco).xx, H)


def test_guide_does_not_touch_the_first_and_the_last_knot():
    problem, none = planar(), Multipliers.zeros(planar())
    for k, acts in ((0, False), (4, True), (5, False), (10, False)):
        u = None if k == 10 else np.full(2, 2.5)
        x = problem.x0 + 0.1
        with_guide = expansion(problem, k, x, u, none, 1.0, some_guide(problem), 9.0)
        without = expansion(problem, k, x, u, none, 1.0)
        assert np.array_equal(with_guide.x, without.x) != acts


def test_multiplier_update_by_hand():
    problem = point_mass(
        N=1,
        dt=1.0,
        start=(0, 0),
        centers=[[1.0, 0.0]],
        contact=[2.0],
        u_lower=[-1, -np.inf],
        u_upper=[1, np.inf],
        equalities=[(1, lambda x: x[:2] - np.array([0.5, -0.25]))],
    )
    U = np.array([[3.0, 0.0]])
    X = np.array([[0, 0, 0, 0.0], [0, 0, 0, 0]])
    lam = Multipliers.zeros(problem)
    lam.bounds[0, 2] = 100.0
    lam.equalities[0][:] = [1.0, 2.0]
    new = updated_multipliers(problem, X, U, lam, 10.0)
    np.testing.assert_allclose(new.spheres, [[30.0]])  # c = 4 - 1
    np.testing.assert_allclose(new.bounds, [[20.0, 0, 100 - 40, 0]])
    np.testing.assert_allclose(new.equalities[0], [1 - 5, 2 + 2.5])
    assert lam.bounds[0, 0] == 0  # the old object is untouched
    assert np.isfinite(lagrangian(problem, X, U, lam, 10.0))
    assert max_violation(problem, X, U) == 3.0


# --- iLQR -------------------------------------------------------------------------------------------------


def dense_model(problem, X, U, lam, mu, guide, mu_gco):
    """Gradient g and Hessian W of the Gauss-Newton model in the controls, the states eliminated."""
    N, n, m = problem.N, problem.n, problem.m
    g, W = np.zeros(N * (n + m)), np.zeros((N * (n + m), N * (n + m)))
    for k in range(N + 1):
        L = expansion(problem, k, X[k], U[k] if k < N else None, lam, mu, guide, mu_gco)
        xs, us = slice((k - 1) * n, k * n), slice(N * n + k * m, N * n + (k + 1) * m)
        if k > 0:
            g[xs], W[xs, xs] = L.x, L.xx
        if k < N:
            g[us], W[us, us] = L.u, L.uu
        if 0 < k < N:
            W[us, xs], W[xs, us] = L.ux, L.ux.T
    G = np.zeros((N * n, N * m))
    for k in range(N):
        f_x, f_u = step_jacobians(problem, X[k], U[k])
        if k > 0:
            G[k * n : (k + 1) * n] = f_x @ G[(k - 1) * n : k * n]
        G[k * n : (k + 1) * n, k * m : (k + 1) * m] += f_u
    T = np.vstack([G, np.eye(N * m)])
    return T.T @ g, T.T @ W @ T


def linear_policy(problem, X, U, gains):
    """du (N m) of du = d + K dx rolled out on the linearised dynamics."""
    dx, du = np.zeros(problem.n), []
    for k in range(problem.N):
        f_x, f_u = step_jacobians(problem, X[k], U[k])
        du.append(gains.d[k] + gains.K[k] @ dx)
        dx = f_x @ dx + f_u @ du[-1]
    return np.concatenate(du)


def full_case():
    problem = planar()
    U = np.random.default_rng(2).uniform(0, 4, (10, 2))
    X = rollout(problem, U)
    return problem, X, U, random_multipliers(problem), 30.0, some_guide(problem), 50.0


def test_backward_pass_solves_the_dense_gauss_newton_problem():
    case = full_case()
    g, W = dense_model(*case)
    gains = backward(*case, mu_r=0.0)
    expected = np.linalg.solve(W, -g)
    np.testing.assert_allclose(linear_policy(*case[:3], gains), expected, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(gains.expected(1.0), 0.5 * g @ expected, rtol=1e-9)


def test_expected_decrease_is_the_models_even_when_regularised():
    case = full_case()
    g, W = dense_model(*case)
    gains = backward(*case, mu_r=20.0)
    du = linear_policy(*case[:3], gains)
    assert np.abs(du - np.linalg.solve(W, -g)).max() > 1e-3
    np.testing.assert_allclose(g @ du + 0.5 * du @ W @ du, gains.expected(1.0), rtol=1e-9)


def test_small_alpha_follows_the_expected_decrease():
    case = full_case()
    problem, X, U, *terms = case
    gains = backward(*case, mu_r=0.0)
    changes = []
    for alpha in (1e-5, -1e-5):
        X_new, U_new = forward(problem, X, U, gains, alpha)
        changes.append(lagrangian(problem, X_new, U_new, *terms))
    np.testing.assert_allclose((changes[0] - changes[1]) / 2e-5, gains.Qu_d, rtol=1e-5)


def test_linear_quadratic_problem_takes_one_full_step():
    problem = point_mass()
    lam = Multipliers.zeros(problem)
    U = np.ones((12, 2))
    X = rollout(problem, U)
    result = ilqr(problem, X, U, lam, 20.0)
    first = result.records[0]
    assert (first.alpha, first.mu_r) == (1.0, 0.0)
    assert first.eps == pytest.approx(1.0, abs=1e-10)
    g, W = dense_model(problem, X, U, lam, 20.0, None, 0.0)
    expected = U + np.linalg.solve(W, -g).reshape(12, 2)
    np.testing.assert_allclose(first.U, expected, atol=1e-10)
    assert result.status == "converged"
    again = ilqr(problem, result.X, result.U, lam, 20.0)
    assert (again.status, again.records[-1].alpha) == ("converged", 0.0)
    np.testing.assert_allclose(again.U, expected, atol=1e-10)


def test_ilqr_reaches_a_minimum_of_the_lagrangian():
    problem, X, U, lam, mu, guide, mu_gco = full_case()
    result = ilqr(problem, X, U, lam, mu, guide, mu_gco, tolerance=1e-13, max_iterations=200)

    def value(flat):
        controls = flat.reshape(10, 2)
        return lagrangian(problem, rollout(problem, controls), controls, lam, mu, guide, mu_gco)

    start = lagrangian(problem, X, U, lam, mu, guide, mu_gco)
    gradient = differences(value, result.U.ravel())[0]
    assert np.abs(gradient).max() < 1e-4 * np.abs(differences(value, U.ravel())[0]).max()
    polished = minimize(value, result.U.ravel(), method="BFGS").fun
    assert result.cost - polished < 1e-6 * (start - polished)
    np.testing.assert_array_equal(result.X, rollout(problem, result.U))


def test_line_search_halves_until_the_ratio_fits():
    problem, X, U, lam, _, guide, _ = full_case()
    mu, mu_gco = 1000.0, 2000.0  # stiff enough for full steps to overshoot
    result = ilqr(problem, X, U, lam, mu, guide, mu_gco, max_iterations=12)
    shortened = 0
    before_X, before_U, J_prev = X, U, lagrangian(problem, X, U, lam, mu, guide, mu_gco)
    for record in result.records:
        if record.alpha == 0:
            break
        assert 1e-4 <= record.eps <= 10 and np.log2(record.alpha) == int(np.log2(record.alpha))
        assert record.eps == pytest.approx((record.cost - J_prev) / record.expected)
        if record.alpha < 1:
            shortened += 1
            gains = backward(problem, before_X, before_U, lam, mu, guide, mu_gco, record.mu_r)
            trial = forward(problem, before_X, before_U, gains, 2 * record.alpha)
            refused = lagrangian(problem, *trial, lam, mu, guide, mu_gco) - J_prev
            assert not 1e-4 <= refused / gains.expected(2 * record.alpha) <= 10
        before_X, before_U, J_prev = record.X, record.U, record.cost
    assert shortened >= 1


def scalar_problem(step, R, S=1.0, N=1, x0=1.0):
    one = [[1.0]]
    return ReferenceProblem(step, [x0], N, one, [[R]], [[S]], np.zeros(1), np.zeros(1), position=(0,))


def test_step_is_taken_below_the_smallest_alpha_even_uphill():
    # The complex step sees conj as -1: the derivative has the wrong sign, so every step goes uphill.
    problem = scalar_problem(lambda x, u: x + np.conj(u), R=0.1)
    U = np.zeros((1, 1))
    X = rollout(problem, U)
    result = ilqr(problem, X, U, Multipliers.zeros(problem), 1.0, max_iterations=1)
    record = result.records[0]
    assert record.alpha == 2.0**-14 and record.eps < 0
    assert record.cost > lagrangian(problem, X, U, Multipliers.zeros(problem), 1.0)
    assert result.U[0, 0] != 0 and result.status == "max_iterations"


def test_a_decrease_ten_times_the_predicted_one_is_refused():
    # The complex step sees 1 where the real derivative is 7. At alpha = 1 the ratio is 13, at 1/2 it is 9.
    problem = scalar_problem(lambda x, u: x + (7 * u if np.isrealobj(u) else u), R=1000.0)
    U = np.zeros((1, 1))
    result = ilqr(problem, rollout(problem, U), U, Multipliers.zeros(problem), 1.0, max_iterations=1)
    assert result.records[0].alpha == 0.5 and 8.5 < result.records[0].eps < 9.5


def test_ilqr_stops_at_the_tolerance():
    problem, X, U, *terms = full_case()
    result = ilqr(problem, X, U, *terms, tolerance=1e9)
    assert result.status == "converged" and len(result.records) == 1 and result.records[0].alpha > 0


@pytest.mark.parametrize(
    ("R", "mu_r"), [(-0.99, 0.0), (-1.0000005, 1e-6), (-1.00005, 1e-4), (-3.0, 10.0), (-2e9, 1e10)]
)
def test_regularisation_grows_by_ten_from_1e_6(R, mu_r):
    # Quu = R + 1 at the last stage
    problem = scalar_problem(lambda x, u: x + u, R=R)
    U = np.ones((1, 1))
    result = ilqr(problem, rollout(problem, U), U, Multipliers.zeros(problem), 1.0, max_iterations=1)
    assert result.records[0].mu_r == pytest.approx(mu_r)


def test_a_failed_stage_restarts_the_pass_with_a_larger_mu_r_for_all_stages():
    # Q = S = 1, R = -1.5: Quu = -0.5 at stage 1, where mu_r = 1 would do, but leaves Vxx = -4 to stage 0.
    problem = scalar_problem(lambda x, u: x + u, R=-1.5, N=2)
    U, lam = np.ones((2, 1)), Multipliers.zeros(problem)
    X = rollout(problem, U)
    record = ilqr(problem, X, U, lam, 1.0, max_iterations=1).records[0]
    assert record.mu_r == pytest.approx(10.0)
    gains = backward(problem, X, U, lam, 1.0, None, 0.0, 10.0)
    np.testing.assert_allclose(gains.d[1], [-1.5 / 9.5])  # Q_u = R u + S x_2
    np.testing.assert_allclose(record.U, forward(problem, X, U, gains, record.alpha)[1])


def test_hopeless_and_non_finite_problems_end_with_a_status():
    hopeless = scalar_problem(lambda x, u: x + u, R=-1e11)
    U = np.ones((1, 1))
    result = ilqr(hopeless, rollout(hopeless, U), U, Multipliers.zeros(hopeless), 1.0)
    assert result.status == "not_positive_definite" and not result.records
    explosive = scalar_problem(lambda x, u: x / (x - x) if np.real(u[0]) != 1 else x - u, R=0.1)
    with np.errstate(all="ignore"):
        result = ilqr(explosive, rollout(explosive, U), U, Multipliers.zeros(explosive), 1.0)
    assert result.status == "non_finite"
    np.testing.assert_array_equal(result.U, U)


# --- Algorithm 1 ------------------------------------------------------------------------------------------


def test_control_bounds_agree_with_bounded_least_squares():
    problem = point_mass(N=8, u_lower=[-1.0, -1.0], u_upper=[1.0, 1.0])
    result = solve(problem, np.zeros((8, 2)), Schedule(outer_iterations=12, tolerance=1e-14))
    zero = np.zeros((8, 2))
    g, W = dense_model(problem, rollout(problem, zero), zero, Multipliers.zeros(problem), 0.0, None, 0.0)
    C = np.linalg.cholesky(W).T
    exact = lsq_linear(C, np.linalg.solve(C.T, -g), (-1, 1), tol=1e-14).x.reshape(8, 2)
    assert np.abs(exact[0, 0]) > 0.999
    np.testing.assert_allclose(result.U, exact, atol=1e-5)
    # KKT: the gradient of J_var is balanced by the bounds' multipliers.
    lam = updated_multipliers(problem, result.X, result.U, result.lam, result.records[-1].mu)
    balance = (g + W @ result.U.ravel()).reshape(8, 2) + lam.bounds[:, :2] - lam.bounds[:, 2:]
    np.testing.assert_allclose(balance, 0, atol=1e-5)
    assert lam.bounds[0, 0] > 0.01


def test_equality_agrees_with_the_dense_kkt_system():
    problem = point_mass(N=6, equalities=[(6, lambda x: x[:2] - np.array([0.3, 0.8]))])
    zero = np.zeros((6, 2))
    result = solve(problem, zero, Schedule(outer_iterations=15, tolerance=1e-14))
    X = rollout(problem, zero)
    g, W = dense_model(problem, X, zero, Multipliers.zeros(problem), 0.0, None, 0.0)
    A = differences(lambda u: rollout(problem, u.reshape(6, 2))[6, :2], np.zeros(12), h=1.0)
    kkt = np.block([[W, A.T], [A, np.zeros((2, 2))]])
    exact = np.linalg.solve(kkt, np.concatenate([-g, [0.3, 0.8] - X[6, :2]]))
    np.testing.assert_allclose(result.U.ravel(), exact[:12], atol=1e-6)
    lam = updated_multipliers(problem, result.X, result.U, result.lam, result.records[-1].mu)
    np.testing.assert_allclose(lam.equalities[0], exact[12:], rtol=1e-3)


def test_sphere_agrees_with_slsqp():
    problem = point_mass(centers=[[0.0, -0.05]], contact=[0.3])
    result = solve(problem, np.zeros((12, 2)), Schedule(outer_iterations=14, tolerance=1e-12))
    assert max_violation(problem, result.X, result.U) < 1e-6
    assert min(len(r.inner) for r in result.records) >= 1 and not result.records[-1].J

    def clearance(flat):
        X = rollout(problem, flat.reshape(12, 2))
        return np.array([-row.c for k in range(1, 13) for row in constraint_rows(problem, k, X[k], None)])

    exact = minimize(
        lambda flat: cost(problem, rollout(problem, flat.reshape(12, 2)), flat.reshape(12, 2)),
        result.U.ravel() + 0.01,
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": clearance}],
        options={"ftol": 1e-12, "maxiter": 300},
    )
    assert cost(problem, result.X, result.U) == pytest.approx(exact.fun, rel=1e-6)
    free = solve(point_mass(), np.zeros((12, 2)), Schedule(outer_iterations=1))
    assert exact.fun > 1.02 * free.records[0].cost


def test_schedule_and_records():
    problem = point_mass(centers=[[0.0, -0.05]], contact=[0.3])
    schedule = Schedule(outer_iterations=3, mu0=4.0, eta=2.0, mu_gco0=5.0, nu=3.0, tolerance=1e-10)
    records = solve(problem, np.zeros((12, 2)), schedule).records
    assert [r.mu for r in records] == [4, 8, 16] and [r.mu_gco for r in records] == [5, 15, 45]
    assert Multipliers.zeros(problem).spheres.sum() == records[0].lam.spheres.sum() == 0
    for before, after in pairwise(records):
        lam = updated_multipliers(problem, before.X, before.U, before.lam, before.mu)
        np.testing.assert_array_equal(lam.spheres, after.lam.spheres)
        inner = ilqr(problem, before.X, before.U, lam, after.mu, tolerance=1e-10)
        np.testing.assert_array_equal(inner.U, after.U)
    assert records[1].lam.spheres.max() > 0
    default = solve(problem, np.zeros((12, 2)), Schedule(outer_iterations=2, max_iterations=1)).records
    assert default[1].mu_gco == pytest.approx(20 * 2.2**2)
    assert default[0].status == "max_iterations" and len(default[0].inner) == 1


# --- MPPI, detection, CPUF, Algorithm 4 -------------------------------------------------------------------


def integrator(**options):
    """p+ = p + u in the plane with N = 2 and a cost of u alone, so that MPPI can be computed by hand."""
    zero = np.zeros((2, 2))
    return ReferenceProblem(
        lambda x, u: x + u, np.zeros(2), 2, zero, np.eye(2), zero, np.zeros(2), np.zeros(2), **options
    )


def test_mppi_by_hand():
    problem = integrator(centers=[[3.0, 0.0]], contact=[0.5])
    settings = MppiSettings(np.array([4.0, 9.0]), np.array([-1.5, -9]), np.array([2.5, 9]), 2.0, 100.0)
    U = np.array([[1.0, 0.0], [0.5, 0.0]])
    z = np.array([[[1.0, 0], [0, 0]], [[-0.25, 0], [0, 1.0]]])
    # Sample 0: eps = 2 at stage 0, v = 3 clipped to 2.5; x = 2.5, 3.0: touches at knot 1, collides at 2.
    # Its score uses the drawn eps = 2: 2 * 1 * 2 / 4. Sample 1: v = (0.5, 0), (0.5, 3).
    S = np.array([1.0 + (6.25 + 0.25) / 2 + 200, -0.25 + 0.25 / 2 + 9.25 / 2])
    result = mppi(problem, U, z, settings)
    np.testing.assert_allclose(result.S, S, rtol=1e-14)
    weights = np.exp(-S / 2) / np.exp(-S / 2).sum()
    np.testing.assert_allclose(result.weights, weights, rtol=1e-12)
    V = np.array([[[2.5, 0], [0.5, 0]], [[0.5, 0], [0.5, 3]]])
    np.testing.assert_allclose(result.U, weights[0] * V[0] + weights[1] * V[1], rtol=1e-13)
    np.testing.assert_array_equal(result.X, rollout(problem, result.U))


def test_mppi_without_noise_returns_the_mean_and_when_cold_the_best_sample():
    problem = point_mass(N=5)
    U = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    z = np.random.default_rng(1).normal(size=(30, 5, 2))
    wide = MppiSettings(np.array([1.0, 1.0]), np.full(2, -9.0), np.full(2, 9.0))
    np.testing.assert_allclose(mppi(problem, U, 0 * z, wide).U, U, rtol=1e-13)
    cold = mppi(problem, U, z, MppiSettings(wide.sigma, wide.lower, wide.upper, temperature=1e-9))
    best = min(range(30), key=lambda n: cost(problem, rollout(problem, U + z[n]), U + z[n]))
    np.testing.assert_allclose(cold.U, U + z[best], rtol=1e-12)
    warm = mppi(problem, U, z, wide)
    assert warm.weights.sum() == pytest.approx(1) and warm.weights.max() < 0.9


def test_collisions_follow_moving_spheres_and_skip_knot_0():
    problem = integrator(centers=[[0.0, 0.0]], velocities=[[1.0, 0.0]], dt=2.0, contact=[0.5])
    assert collisions(problem, np.array([[0.0, 0], [2.4, 0], [3.4, 0]])) == 1
    assert collisions(problem, np.array([[0.0, 0], [2.4, 0], [3.6, 0]])) == 2


def test_detection_by_hand():
    problem = point_mass(N=4, centers=[[0.0, 0.3], [0.0, -0.3], [2.0, 0.0]], contact=[0.5, 0.5, 1.0])
    X = np.zeros((5, 4))
    X[:, 0] = [0.0, 0.0, 0.45, 1.5, 0.0]
    # |p - o|^2 = 0.09 at knots 0, 1, 4 and 0.2925 at knot 2
    assert active_spheres(problem, X) == [set(), {0, 1}, set(), {2}, {0, 1}]
    assert stuck_knots(problem, X) == [1]
    X[1, 0] = 0.4  # on the surface: c = 0 is not active
    assert active_spheres(problem, X)[1] == set()


def trap():
    """Two overlapping discs across the path, whose gradients cancel; the vehicle is too slow to jump across."""
    discs = dict(centers=[[0.0, 0.25], [0.0, -0.25]], contact=[0.4, 0.4])
    return point_mass(20, 0.1, (-1.0, 0.0), R=0.001, u_lower=[-6.0, -6], u_upper=[6.0, 6], **discs)


def test_cpuf():
    problem = trap()
    settings = MppiSettings(np.full(2, 25.0), np.full(2, -20.0), np.full(2, 20.0))
    z = np.random.default_rng(0).normal(size=(40, 20, 2))
    free = np.zeros((20, 2))
    assert cpuf(problem, rollout(problem, free), free, z, settings, 0.1) is None
    U = np.tile([1.0, 0.0], (20, 1))
    X = rollout(problem, U)
    J = stuck_knots(problem, X)
    assert 2 <= len(J) < 10
    guide = cpuf(problem, X, U, z, settings, 0.1)
    safe = mppi(problem, U, z, settings)
    for k in range(21):
        np.testing.assert_array_equal(guide.p[k], (safe.X if k in J else X)[k, :2])
        assert guide.r[k] == (0.1 if k in J else 1e6)


def test_guidance_leaves_the_trap():
    problem = trap()
    schedule = Schedule(outer_iterations=9, tolerance=1e-3, max_iterations=15)
    stuck = solve(problem, np.zeros((20, 2)), schedule)
    assert max_violation(problem, stuck.X, stuck.U) > 0.05 and stuck.records[-1].J
    settings = MppiSettings(np.full(2, 100.0), np.full(2, -30.0), np.full(2, 30.0))
    calls = []

    def noise(outer):
        calls.append(outer)
        return np.random.default_rng([7, outer]).normal(size=(60, 20, 2))

    free = solve(problem, np.zeros((20, 2)), schedule, cpuf_hook(problem, noise, settings, 0.1))
    assert max_violation(problem, free.X, free.U) < 1e-3 and not free.records[-1].J
    # MPPI is called for, and only for, an iterate with stuck knots, and serves the next outer iteration.
    assert calls == [o for o, record in enumerate(free.records[:-1]) if record.J]
    assert [r.guide is not None for r in free.records] == [False] + [bool(r.J) for r in free.records[:-1]]
    np.testing.assert_array_equal(free.records[0].U, stuck.records[0].U)
