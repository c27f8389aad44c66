"""The augmented Lagrangian, its expansion, and how good a trajectory is.

`lagrangian.Lagrangian` is a problem with multipliers and penalties, `expansion` its quadratic model, `quality` the
violation and optimality that solvers end by. It imports `problem`.
"""
