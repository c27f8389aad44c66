"""Maps as obstacles: occupancy grids and clouds of points."""

from torchgco.maps.files import read as read
from torchgco.maps.grid import OccupancyGrid as OccupancyGrid
from torchgco.maps.points import PointCloud as PointCloud
