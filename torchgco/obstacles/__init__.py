"""Obstacles: their common interface, spheres, boxes, capsules and ellipsoids, also such that move along sines or
any known motion.

`base.Obstacles` adds to a constraint what the search for paths, pictures and sensors ask; users give `Spheres`, and
bound to a problem they become `BoundSpheres`. `measured` has the judge's distances, which share no code with the
solvers'. `body` makes a vehicle of several balls of any kind. It imports what `constraints` does. Begin with
`base.py`.
"""

from torchgco.obstacles.base import CONTACT_FACTOR as CONTACT_FACTOR
from torchgco.obstacles.base import Obstacles as Obstacles
from torchgco.obstacles.body import Body as Body
from torchgco.obstacles.boxes import Boxes as Boxes
from torchgco.obstacles.boxes import OscillatingBoxes as OscillatingBoxes
from torchgco.obstacles.capsules import Capsules as Capsules
from torchgco.obstacles.ellipsoids import Ellipsoids as Ellipsoids
from torchgco.obstacles.moved import Moved as Moved
from torchgco.obstacles.spheres import Spheres as Spheres
