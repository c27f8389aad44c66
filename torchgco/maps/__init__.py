"""Maps as obstacles: occupancy grids, clouds of points, their distance fields, and the constraint."""

from torchgco.maps.distance import DistanceField as DistanceField
from torchgco.maps.field import Field as Field
from torchgco.maps.grid import OccupancyGrid as OccupancyGrid
from torchgco.maps.points import PointCloud as PointCloud
