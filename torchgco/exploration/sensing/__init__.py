"""What a vehicle sees of its world: rays, sensors, and the map that it makes of them."""

from torchgco.exploration.sensing.grid import SeenMap as SeenMap
from torchgco.exploration.sensing.sensors import Depth as Depth
from torchgco.exploration.sensing.sensors import Lidar as Lidar
from torchgco.exploration.sensing.sensors import Scan as Scan
from torchgco.exploration.sensing.sensors import Sensor as Sensor
from torchgco.exploration.sensing.sensors import World as World
