"""iLQR in PyTorch (Algorithm 2): an inner solve's options, backward pass, line search and one iteration.

`step.iterate` is the loop, `riccati.backward` the pass, `step.Descent` the options, which the kernels in C read,
too. It imports `lagrangian`. Begin with `step.py`.
"""
