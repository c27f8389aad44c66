"""Maps as obstacles: occupancy grids, clouds of points, their distance fields, and the constraint.

`grid` has what a map holds, cells or points, `distance` the field made of it, `field` the obstacle, and `measured`
what the judge makes of the same cells and points. `files` reads formats of other tools. It imports `obstacles`. Begin
with `field.py`.
"""

from torchgco.maps.distance import DistanceField as DistanceField
from torchgco.maps.field import Field as Field
from torchgco.maps.files import read as read
from torchgco.maps.grid import OccupancyGrid as OccupancyGrid
from torchgco.maps.grid import PointCloud as PointCloud
