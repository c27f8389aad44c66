"""Named sources of obstacle layouts: random families and files."""

from torchgco.scenarios.base import Scenario
from torchgco.scenarios.crossing import Crossing
from torchgco.scenarios.cylinders import Cylinders
from torchgco.scenarios.files import LayoutFile
from torchgco.scenarios.floors import Floors
from torchgco.scenarios.gates import GateForest, Race
from torchgco.scenarios.layouts import Layouts, concatenate
from torchgco.scenarios.maps import MapFile
from torchgco.scenarios.mazes import Mazes
from torchgco.scenarios.parking import Parking
from torchgco.scenarios.planar import PlanarRandom, PlanarTrap
from torchgco.scenarios.quadrotor import Forest, ForestMoving, Walls
from torchgco.scenarios.rooms import Rooms
from torchgco.scenarios.trefoils import Trefoils
from torchgco.scenarios.vehicle import Task, Vehicle
from torchgco.scenarios.woods import Woods
from torchgco.scenarios.yard import Yard

# The random families, each an option `scenario=` of the command line under its `name`.
FAMILIES: tuple[type[Scenario], ...] = (
    Forest, ForestMoving, Walls, Woods, Mazes, Crossing, Cylinders, Rooms, Trefoils, PlanarTrap, PlanarRandom, Yard,
    Floors, GateForest, Race, Parking,
)  # fmt: skip

__all__ = [
    "Crossing",
    "Cylinders",
    "Floors",
    "Forest",
    "ForestMoving",
    "GateForest",
    "LayoutFile",
    "Layouts",
    "MapFile",
    "Mazes",
    "Parking",
    "PlanarRandom",
    "PlanarTrap",
    "Race",
    "Rooms",
    "Scenario",
    "Task",
    "Trefoils",
    "Vehicle",
    "Walls",
    "Woods",
    "Yard",
    "concatenate",
]
