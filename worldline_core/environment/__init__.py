"""The simulator as a Gymnasium environment; importing this registers ``worldline/Simulator-v0`` (extra ``gym``) and, with the
extra ``sim``, its twin in MuJoCo, ``worldline/Mujoco-v0``.

``gymnasium.make("worldline_core.environment:worldline/Simulator-v0", embodiment="ur5e_silver")``, ``make_vec`` alike.
"""

import gymnasium

ENVIRONMENT = "worldline/Simulator-v0"
MUJOCO_ENVIRONMENT = "worldline/Mujoco-v0"

gymnasium.register(
    ENVIRONMENT,
    entry_point="worldline_core.environment.environment:WorldLineEnv",
    vector_entry_point="worldline_core.environment.environment:WorldLineVectorEnv",
)
gymnasium.register(MUJOCO_ENVIRONMENT, entry_point="worldline_core.environment.mujoco_world:MujocoEnv")
