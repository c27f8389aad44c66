"""Algorithm 3: model predictive path integral control around a given U, for given noise."""

from dataclasses import dataclass

import numpy as np

from tests.reference.problem import cost, rollout


@dataclass(frozen=True)
class MppiSettings:
    """sigma (m): diagonal of the covariance Sigma; lower, upper (m): where samples saturate, infinite for no bounds."""

    sigma: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    temperature: float = 1.0
    rho_mp: float = 1e8


@dataclass
class MppiResult:
    """Averaged U (N, m) and its rollout X (N+1, n); weights (K) sum to 1; scores S (K)."""

    X: np.ndarray
    U: np.ndarray
    weights: np.ndarray
    S: np.ndarray


def collisions(problem, X):
    """Number of pairs (knot 1..N, sphere) with r_obs + r_veh - |p_obs - p| >= 0, Eqs. (55) and (56)."""
    count = 0
    for k in range(1, problem.N + 1):
        for i in range(problem.M):
            distance = np.sqrt(np.sum((problem.center(i, k) - X[k][problem.position]) ** 2))
            if problem.contact[i] - distance >= 0:
                count += 1
    return count


def sample(problem, U, eps, settings):
    """Lines 3-11 for one sample. eps (N, m); returns the saturated controls V (N, m) and the score S."""
    V = np.zeros_like(U)
    S = 0.0
    for k in range(problem.N):
        V[k] = np.minimum(np.maximum(U[k] + eps[k], settings.lower), settings.upper)
        S += settings.temperature * np.sum(U[k] * eps[k] / settings.sigma)
    # A diverging sample scores nan or inf; it gets weight zero.
    with np.errstate(over="ignore", invalid="ignore"):
        X = rollout(problem, V)
        S += cost(problem, X, V) + settings.rho_mp * collisions(problem, X)
    return V, S if np.isfinite(S) else np.inf


def mppi(problem, U, z, settings):
    """Algorithm 3. U (N, m) mean; z (K, N, m) standard normal draws, eps = sqrt(sigma) z."""
    K = len(z)
    V = np.zeros((K, problem.N, problem.m))
    S = np.zeros(K)
    for n in range(K):
        V[n], S[n] = sample(problem, U, np.sqrt(settings.sigma) * z[n], settings)
    if not np.isfinite(S).any():
        raise FloatingPointError("every sample diverged")
    likelihood = np.exp(-(S - S.min()) / settings.temperature)
    weights = likelihood / np.sum(likelihood)
    averaged = np.zeros_like(U, dtype=float)
    for n in range(K):
        averaged += weights[n] * V[n]
    return MppiResult(rollout(problem, averaged), averaged, weights, S)
