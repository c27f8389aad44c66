"""Problem: dynamics, cost, constraints and goal of a batch, joined and tried once.

`problem.Problem` is what users make and all rooms read; `border` and `alone` try its parts when it is made. Forms
that solvers work on are problems again: `horizons` ends some early, `rates` carries controls along, `in_time` frees
the time. It knows no solver, and imports `maps`, `obstacles` and what is before them. Begin with `problem.py`.
"""
