"""Missions: a planner, a tracker and a plant in closed loop."""

from torchgco.simulation.disturbance import Disturbance as Disturbance
from torchgco.simulation.log import MissionLog as MissionLog
from torchgco.simulation.mission import Mission as Mission
from torchgco.simulation.planner import Planner as Planner
from torchgco.simulation.plant import Plant as Plant
from torchgco.simulation.plant import RotorPlant as RotorPlant
from torchgco.simulation.tracker import Tracker as Tracker
