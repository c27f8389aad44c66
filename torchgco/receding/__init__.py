"""What a receding horizon flies, in every loop: its plans, and what it goes on with where no solve gives one.

`plan.Plan` is a trajectory with feedback, sampled at any time and moved on to a later one; `holding` chooses between
the plan before and ways to rest, which it makes. `compiled.MPC` and the planners of `missions` plan by them. It
imports `kernels`, no solver. Begin with `plan.py`.
"""
