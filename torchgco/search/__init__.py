"""Search above the local solver: restarts from paths of several homotopy classes, from samples, or at random."""

from torchgco.search.multistart import MultiStart as MultiStart
from torchgco.search.paths import PathProposals as PathProposals
from torchgco.search.restarts import Restarts as Restarts
