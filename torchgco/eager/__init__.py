"""What PyTorch computes of any code, on any device and in any precision: derivatives of functions, and MPPI's rounds.

`functions` has the values and derivatives of a problem, for which the interior point in C asks where it can't call
the problem's code (`native.called`), and the ways to differentiate; `sampling` has MPPI's rounds. It imports
`problem`. Begin with `functions.py`.
"""
