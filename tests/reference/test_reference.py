"""The NumPy reference against finite differences, SciPy, dense linear algebra and hand-made cases."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tests.reference import models
from tests.reference.augmented_lagrangian import Schedule, solve
from tests.reference.guidance import active_spheres, cpuf, stuck_knots
from tests.reference.ilqr import ilqr
from tests.reference.lagrangian import (
    Guide,
    Multipliers,
    expansion,
    lagrangian,
    updated_multipliers,
)
from tests.reference.mppi import MppiSettings, collisions, mppi
from tests.reference.problem import (
    ReferenceProblem,
    complex_jacobian,
    constraint_rows,
    cost,
    rollout,
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


def test_planar_field_by_hand():
    x = np.array([0.0, 0.0, np.pi / 6, 1.0, 2.0, 3.0])
    got = models.planar_field(x, np.array([4.0, 6.0]))
    np.testing.assert_allclose(got, [1, 2, 3, -10 + 5 * np.sqrt(3), -20 + 5, -0.003 + 0.2], rtol=1e-14)


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


def test_guide_does_not_touch_the_first_and_the_last_knot():
    problem, none = planar(), Multipliers.zeros(planar())
    for k, acts in ((0, False), (4, True), (5, False), (10, False)):
        u = None if k == 10 else np.full(2, 2.5)
        x = problem.x0 + 0.1
        with_guide = expansion(problem, k, x, u, none, 1.0, some_guide(problem), 9.0)
        without = expansion(problem, k, x, u, none, 1.0)
        assert np.array_equal(with_guide.x, without.x) != acts


# --- iLQR -------------------------------------------------------------------------------------------------


def scalar_problem(step, R, S=1.0, N=1, x0=1.0):
    one = [[1.0]]
    return ReferenceProblem(step, [x0], N, one, [[R]], [[S]], np.zeros(1), np.zeros(1), position=(0,))


def test_a_decrease_ten_times_the_predicted_one_is_refused():
    # The complex step sees 1 where the real derivative is 7. At alpha = 1 the ratio is 13, at 1/2 it is 9.
    problem = scalar_problem(lambda x, u: x + (7 * u if np.isrealobj(u) else u), R=1000.0)
    U = np.zeros((1, 1))
    result = ilqr(problem, rollout(problem, U), U, Multipliers.zeros(problem), 1.0, max_iterations=1)
    assert result.records[0].alpha == 0.5 and 8.5 < result.records[0].eps < 9.5


# --- Algorithm 1 ------------------------------------------------------------------------------------------


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
