"""Obstacles: their common interface, spheres, boxes and capsules."""

from torchgco.obstacles.base import CONTACT_FACTOR as CONTACT_FACTOR
from torchgco.obstacles.base import Obstacles as Obstacles
from torchgco.obstacles.boxes import Boxes as Boxes
from torchgco.obstacles.capsules import Capsules as Capsules
from torchgco.obstacles.spheres import Spheres as Spheres
