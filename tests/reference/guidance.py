"""Detection of caught knots (F_k, J), and Algorithm 5 (CPUF), which makes the guide region."""

import numpy as np

from tests.reference.lagrangian import Guide
from tests.reference.mppi import mppi
from tests.reference.problem import sphere_rows

R_FAR = 1e6  # metres; larger than any scene, so that a guide of this radius never acts


def active_spheres(problem, X):
    """F_k of Eq. (51) for k = 0..N: a list of N+1 sets of obstacle numbers; F_0 is empty, x_0 being given."""
    return [{row.j for row in sphere_rows(problem, k, X[k]) if row.c > 0} for k in range(problem.N + 1)]


def stuck_knots(problem, X):
    """J of Eq. (53): the knots 1..N-1 with at least two active spheres, ascending."""
    F = active_spheres(problem, X)
    return [k for k in range(1, problem.N) if len(F[k]) >= 2]


def cpuf(problem, X, U, z, settings, r_vehicle, r_far=R_FAR):
    """Algorithm 5. Returns the Guide, or None for use_GCO = false. z (K, N, m) is MPPI's noise."""
    p = X[:, problem.position].copy()
    r = np.full(problem.N + 1, r_far)
    J = stuck_knots(problem, X)
    if not J:
        return None
    safe = mppi(problem, U, z, settings)
    for k in J:
        p[k] = safe.X[k][problem.position]
        r[k] = r_vehicle
    return Guide(p, r)


def cpuf_hook(problem, noise, settings, r_vehicle, r_far=R_FAR):
    """The `guidance` of `augmented_lagrangian.solve`; noise(outer) -> z (K, N, m), called only if J is not empty."""

    def guidance(outer, X, U):
        z = noise(outer) if stuck_knots(problem, X) else None
        return cpuf(problem, X, U, z, settings, r_vehicle, r_far)

    return guidance
