"""What happened in a solve, in words: `Solution.explain`, and the facts that it rests on.

`explain` collects facts, of which `Account` keeps a solve's, `passes` tell its course, `advice` what to try next.
Words come from the parts of a problem themselves. It imports `judging`. Begin with `explain.py`.
"""
