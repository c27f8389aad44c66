"""Fleets: vehicles that move at the same time and keep apart.

`fleet.Fleet` says what one is. `solve.solve_fleet` plans each vehicle alone, then all together as one problem
(`joint`, `together`), and one after the other among each other's motions (`prioritised`) where that doesn't do; what
`verdict.judge_fleet` finds best is the `FleetSolution`. Begin with `solve.py`.
"""

from torchgco.fleets.fleet import Fleet as Fleet
from torchgco.fleets.solution import FleetSolution as FleetSolution
