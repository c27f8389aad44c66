"""Missions as environments of Gymnasium: `pip install torchgco[gym]`.

    env = gymnasium.make_vec("torchgco.envs:torchgco/Mission-v0", num_envs=256)

The import registers `torchgco/Mission-v0`, as a vector and as a single environment.
"""

from torchgco.base.errors import InputError

try:
    import gymnasium
except ImportError as error:
    raise InputError("torchgco.envs", "gymnasium (`pip install torchgco[gym]`)", error) from None

from torchgco.envs.baseline import PlannerPolicy as PlannerPolicy
from torchgco.envs.missions import MissionEnv as MissionEnv
from torchgco.envs.missions import MissionVectorEnv as MissionVectorEnv

NAME = "torchgco/Mission-v0"

if NAME not in gymnasium.registry:
    gymnasium.register(
        NAME,
        entry_point="torchgco.envs.missions:MissionEnv",
        vector_entry_point="torchgco.envs.missions:MissionVectorEnv",
    )
