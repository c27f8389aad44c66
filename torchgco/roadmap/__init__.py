"""The roadmap: points and paths around obstacles, one path per homotopy class.

Geometry alone: `geometry.Scene` is a problem as the search sees it, `roadmap.Roadmap` finds paths there, `homotopy`
tells classes apart, `lattice` is the free space of maps. The searches are C (`c/`). It imports `kernels`. Begin with
`roadmap.py`.
"""

from torchgco.roadmap.roadmap import Roadmap as Roadmap
