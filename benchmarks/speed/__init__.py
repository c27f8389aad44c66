"""How fast torchgco is, and how fast others are, measured side by side: `python -m benchmarks.speed`.

All measurements of a section come from one process on one core with one thread, so that a ratio of two of them holds
where a time alone does not. Set-up and compilation are never part of a time; they are rows of their own.
"""
