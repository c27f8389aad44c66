"""Named sources of obstacle layouts: random families and files.

`base.Scenario` draws `layouts.Layouts`, arrays of obstacles, starts and goals, and `vehicle.Vehicle` makes problems
of them. A family is a file. It imports `problem` and `maps`. Begin with `vehicle.py`.
"""

from torchgco.scenarios.base import Scenario as Scenario
from torchgco.scenarios.crossing import Crossing as Crossing
from torchgco.scenarios.cylinders import Cylinders as Cylinders
from torchgco.scenarios.files import LayoutFile as LayoutFile
from torchgco.scenarios.fleets import FleetCircle as FleetCircle
from torchgco.scenarios.fleets import FleetDoor as FleetDoor
from torchgco.scenarios.fleets import FleetForest as FleetForest
from torchgco.scenarios.floors import Floors as Floors
from torchgco.scenarios.gates import GateForest as GateForest
from torchgco.scenarios.gates import Race as Race
from torchgco.scenarios.layouts import Layouts as Layouts
from torchgco.scenarios.layouts import concatenate as concatenate
from torchgco.scenarios.maps import MapFile as MapFile
from torchgco.scenarios.mazes import Mazes as Mazes
from torchgco.scenarios.moving import Conveyor as Conveyor
from torchgco.scenarios.moving import Revolving as Revolving
from torchgco.scenarios.moving import Sliding as Sliding
from torchgco.scenarios.moving import Swarm as Swarm
from torchgco.scenarios.moving import Traffic as Traffic
from torchgco.scenarios.moving import Walkers as Walkers
from torchgco.scenarios.parking import Parking as Parking
from torchgco.scenarios.planar import PlanarRandom as PlanarRandom
from torchgco.scenarios.planar import PlanarTrap as PlanarTrap
from torchgco.scenarios.quadrotor import Forest as Forest
from torchgco.scenarios.quadrotor import ForestMoving as ForestMoving
from torchgco.scenarios.quadrotor import Walls as Walls
from torchgco.scenarios.rooms import Rooms as Rooms
from torchgco.scenarios.trefoils import Trefoils as Trefoils
from torchgco.scenarios.vehicle import Task as Task
from torchgco.scenarios.vehicle import Vehicle as Vehicle
from torchgco.scenarios.woods import Woods as Woods
from torchgco.scenarios.yard import Yard as Yard

# The random families, each an option `scenario=` of the command line under its `name`.
FAMILIES: tuple[type[Scenario], ...] = (
    Forest, ForestMoving, Walls, Woods, Mazes, Crossing, Cylinders, Rooms, Trefoils, PlanarTrap, PlanarRandom, Yard,
    Floors, GateForest, Race, Parking, Traffic, Sliding, Walkers, Revolving, Conveyor, Swarm,
    FleetCircle, FleetDoor, FleetForest,
)  # fmt: skip
