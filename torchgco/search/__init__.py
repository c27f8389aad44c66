"""Search above the local solver: a table of rows, along paths and from samples; or restarts from random guesses.

`table` says which passes a solver makes, `rows` and `steps` what each does, `proposals` follow the roadmap's paths,
`restarts` begin again from drawn guesses; `search.Search` is what they share, the best trajectory so far above all. It
imports `roadmap`, `guidance` and `solvers`. Begin with `table.py`.
"""

from torchgco.search.candidates import Refine as Refine
from torchgco.search.finish import ClearChords as ClearChords
from torchgco.search.finish import Converge as Converge
from torchgco.search.following import Follow as Follow
from torchgco.search.multistart import MultiStart as MultiStart
from torchgco.search.proposals import PathProposals as PathProposals
from torchgco.search.restarts import Restarts as Restarts
from torchgco.search.rows import FirstSolve as FirstSolve
from torchgco.search.rows import Paths as Paths
from torchgco.search.rows import Samples as Samples
from torchgco.search.rows import Tighten as Tighten
from torchgco.search.starts import Direct as Direct
from torchgco.search.starts import Join as Join
from torchgco.search.starts import Starts as Starts
from torchgco.search.steps import FromProposal as FromProposal
from torchgco.search.steps import FromSamples as FromSamples
from torchgco.search.steps import IntoGoal as IntoGoal
from torchgco.search.steps import Solve as Solve
from torchgco.search.table import Passes as Passes
from torchgco.search.table import Row as Row
from torchgco.search.timed import Timed as Timed
from torchgco.search.tube import Tube as Tube
