"""Random linear-quadratic problems, as torchgco problems and as one dense quadratic program each, in NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchgco import Constraint, FunctionDynamics, Problem, QuadraticCost


class LinearQuadratic:
    """B problems with x_{k+1} = A x_k + G u_k + c and the costs of `QuadraticCost`, drawn from a seed.

    Weights, their cross terms, linear terms and references differ per problem and stage.
    """

    def __init__(self, n: int, m: int, N: int, B: int = 3, seed: int = 0) -> None:
        self.n, self.m, self.N, self.B = n, m, N, B
        rng = np.random.default_rng((seed, n, m, N))
        turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
        self.A, self.G, self.c = turn * rng.uniform(0.7, 1.05, n), rng.normal(size=(n, m)), 0.1 * rng.normal(size=n)
        W = np.stack([_semidefinite(rng, n + m, 0.1) for _ in range(B * N)]).reshape(B, N, n + m, n + m)
        self.Q, self.R, self.H = W[..., :n, :n], W[..., n:, n:], W[..., n:, :n]
        self.Qf = np.stack([_semidefinite(rng, n, 0.0) for _ in range(B)])
        self.x_ref, self.u_ref = rng.normal(size=(B, N + 1, n)), rng.normal(size=(B, N, m))
        self.q, self.r, self.qf = rng.normal(size=(B, N, n)), rng.normal(size=(B, N, m)), rng.normal(size=(B, n))
        self.x0 = rng.normal(size=(B, n))

    def problem(self, constraints: Sequence[Constraint] = ()) -> Problem:
        A, G, c = (torch.from_numpy(part) for part in (self.A, self.G, self.c))

        def step(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return (A * x.unsqueeze(-2)).sum(-1) + (G * u.unsqueeze(-2)).sum(-1) + c

        names = ("Q", "R", "Qf", "x_ref", "u_ref", "q", "r", "qf", "H")
        cost = QuadraticCost(**{name: torch.from_numpy(getattr(self, name)) for name in names})
        model = FunctionDynamics(step, self.n, self.m, dt=1.0, integrator="none")
        return Problem(model, cost, list(constraints), torch.from_numpy(self.x0), self.N)

    def quadratic(self, b: int) -> tuple[np.ndarray, np.ndarray, float]:
        """H, g and a constant with cost 1/2 z'Hz + g'z + constant, for z = [x_0, u_0, x_1, ..., x_N]."""
        n, s = self.n, self.n + self.m
        H, g, constant = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        for k in range(self.N + 1):
            if k < self.N:
                W = np.block([[self.Q[b, k], self.H[b, k].T], [self.H[b, k], self.R[b, k]]])
                ref, linear = np.r_[self.x_ref[b, k], self.u_ref[b, k]], np.r_[self.q[b, k], self.r[b, k]]
            else:
                W, ref, linear = self.Qf[b], self.x_ref[b, k], self.qf[b]
            at = slice(k * s, k * s + len(ref))
            H[at, at], g[at] = W, linear - W @ ref
            constant += 0.5 * ref @ W @ ref - linear @ ref
        assert H.shape[0] == self.N * s + n
        return H, g, constant

    def dynamics(self, b: int) -> tuple[np.ndarray, np.ndarray]:
        """E and e with E z = e: the start, then the steps."""
        n, s = self.n, self.n + self.m
        E, e = np.zeros(((self.N + 1) * n, self.size)), np.zeros((self.N + 1) * n)
        E[:n, :n], e[:n] = np.eye(n), self.x0[b]
        for k in range(self.N):
            rows = slice((k + 1) * n, (k + 2) * n)
            E[rows, k * s : (k + 1) * s] = -np.c_[self.A, self.G]
            E[rows, (k + 1) * s : (k + 1) * s + n] = np.eye(n)
            e[rows] = self.c
        return E, e

    @property
    def size(self) -> int:
        return self.N * (self.n + self.m) + self.n

    def controls(self, z: np.ndarray) -> np.ndarray:
        """U (N, m) of z."""
        return z[: -self.n].reshape(self.N, -1)[:, self.n :]


def saddle(H: np.ndarray, g: np.ndarray, E: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z and the multipliers of min 1/2 z'Hz + g'z with E z = e, and dz/de, from the dense KKT system."""
    K = np.block([[H, E.T], [E, np.zeros((len(e), len(e)))]])
    found = np.linalg.solve(K, np.r_[-g, e])
    slopes = np.linalg.solve(K, np.eye(len(K))[:, len(g) :])[: len(g)]
    return found[: len(g)], found[len(g) :], slopes


def _semidefinite(rng: np.random.Generator, size: int, least: float) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T / size + least * np.eye(size)
