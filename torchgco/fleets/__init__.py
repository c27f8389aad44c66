"""Fleets: vehicles that move at the same time and keep apart.

`fleet.Fleet` says what one is. `solve.solve_fleet` plans each vehicle alone. Where that doesn't do, all pass each other
on one side (`guesses`), come apart (`coming_apart`) and share the room at the least cost of all (`shared_room`), both
by the forces between them (`forces`); or they negotiate ways through space and time (`negotiated`), and share the room
from there. Whom this leaves too close plans again (`replanned`). What `verdict.judge_fleet` finds best is the
`FleetSolution`. Begin with `solve.py`.
"""

from torchgco.fleets.fleet import Fleet as Fleet
from torchgco.fleets.solution import FleetSolution as FleetSolution
