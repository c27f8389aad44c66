"""Quadratic programs by trying every set of active rows: slow, simple, and exact for few rows."""

from itertools import chain, combinations

import numpy as np


def quadratic_program(H, g, A, c, equality):
    """d (v) and lam (q) of min g'd + 1/2 d'Hd with A d + c <= 0, or = 0 where `equality` (q) is true."""
    q, best = len(c), None
    free = [i for i in range(q) if not equality[i]]
    for chosen in chain.from_iterable(combinations(free, r) for r in range(len(free) + 1)):
        rows = [i for i in range(q) if equality[i] or i in chosen]
        k = len(rows)
        system = np.block([[H, A[rows].T], [A[rows], np.zeros((k, k))]])
        if np.linalg.matrix_rank(system) < len(system):
            continue
        answer = np.linalg.solve(system, -np.concatenate((g, c[rows])))
        d, lam = answer[: len(g)], np.zeros(q)
        lam[rows] = answer[len(g) :]
        if all(lam[i] >= -1e-10 for i in chosen) and (A @ d + c)[free].max(initial=-1.0) <= 1e-10:
            value = g @ d + 0.5 * d @ H @ d
            if best is None or value < best[0]:
                best = value, d, lam
    return best[1:]
