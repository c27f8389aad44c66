"""What a vehicle sees of its world: rays, sensors, and the map that it makes of them."""

from torchgco.missions.sensing.grid import SeenMap as SeenMap
from torchgco.missions.sensing.sensors import Depth as Depth
from torchgco.missions.sensing.sensors import Lidar as Lidar
from torchgco.missions.sensing.sensors import Scan as Scan
from torchgco.missions.sensing.sensors import Sensor as Sensor
from torchgco.missions.sensing.world import World as World
