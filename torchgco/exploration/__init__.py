"""Missions in space that the vehicle has not seen: sensors, its map, paths on it, plans that stop where it is free.

`mission.SensorMission` is a mission whose `explorer` knows only what `sensing` has seen; a `Scout` seeks ways on that
map, `safety` keeps a plan that stops. It imports `missions` and `roadmap`. Begin with `explorer.py`.
"""

from torchgco.exploration.explorer import Explorer as Explorer
from torchgco.exploration.mission import SensorMission as SensorMission
from torchgco.exploration.sensing.sensors import Depth as Depth
from torchgco.exploration.sensing.sensors import Lidar as Lidar
