"""The roadmap: points and paths around obstacles, one path per homotopy class."""

from torchgco.roadmap.roadmap import Roadmap as Roadmap
