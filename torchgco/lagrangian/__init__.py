"""The augmented Lagrangian, its expansion, and how good a trajectory is.

`lagrangian.Lagrangian` is a problem with multipliers and penalties, which `update_and_raise_penalty` raises beside
it, and has its quadratic model; `quality` is the violation and optimality that solvers end by. It imports `problem`.
Begin with `lagrangian.py`.
"""
