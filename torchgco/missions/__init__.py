"""Missions: a planner, a tracker and a plant in closed loop.

`mission.Mission` puts them together, and a `Flight` goes through it step by step; `planner` solves problems again and
again, `plant` is the true vehicle, `simulators` are other authors' ones, `contact` tells collisions by the judge's
distances. It imports `solvers`, no search. Begin with `mission.py`.
"""

from torchgco.missions.disturbance import Disturbance as Disturbance
from torchgco.missions.log import MissionLog as MissionLog
from torchgco.missions.mission import Flight as Flight
from torchgco.missions.mission import Frame as Frame
from torchgco.missions.mission import Mission as Mission
from torchgco.missions.outcome import Ending as Ending
from torchgco.missions.outcome import Outcome as Outcome
from torchgco.missions.outcome import endings as endings
from torchgco.missions.pilot import Pilot as Pilot
from torchgco.missions.planner import MissionPlan as MissionPlan
from torchgco.missions.planner import Planner as Planner
from torchgco.missions.plant import Plant as Plant
from torchgco.missions.plant import RotorPlant as RotorPlant
from torchgco.missions.race import RaceMission as RaceMission
from torchgco.missions.race import RacePlanner as RacePlanner
from torchgco.missions.remote import RemotePlant as RemotePlant
from torchgco.missions.tracker import Tracker as Tracker
