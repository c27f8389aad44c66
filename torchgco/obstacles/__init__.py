"""Obstacles: their common interface, spheres, boxes and capsules, also boxes that move along sines."""

from torchgco.obstacles.base import CONTACT_FACTOR as CONTACT_FACTOR
from torchgco.obstacles.base import Obstacles as Obstacles
from torchgco.obstacles.body import Body as Body
from torchgco.obstacles.boxes import Boxes as Boxes
from torchgco.obstacles.capsules import Capsules as Capsules
from torchgco.obstacles.oscillating import OscillatingBoxes as OscillatingBoxes
from torchgco.obstacles.spheres import Spheres as Spheres
