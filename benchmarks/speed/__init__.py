"""The speed of torchgco and of other solvers, measured under the same conditions: `python -m benchmarks.speed`.

All measurements of a section come from one process on one core with one thread, so that their ratios transfer to other
machines better than times. Set-up and compilation are never part of a time; they have separate rows.
"""
