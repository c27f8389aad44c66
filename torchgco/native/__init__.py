"""Kernels in C for the CPU: generated from traced functions, compiled at first use, kept in the user's cache folder.

find_compiler    the C compiler of this machine, or None
build            C source -> a loaded library
emit             a CasADi function -> C over vectors whose lanes are problems
trace_dynamics   a model -> C of its step and Jacobian, and its numbers per problem
trace_cost       a user's cost -> C of a stage and of the last knot, with their derivatives
trace_rows       a user's constraint -> the same of its rows at a knot

`packing` fills the structures of `c/structures.h` with a problem's costs, rows and obstacles, and `engine` calls the
kernels. It imports `lagrangian`. Begin with `engine.py`.
"""
