"""The simulator as a Gymnasium environment; importing this registers ``worldline/Simulator-v0`` (extra ``gym``).

``gymnasium.make("worldline_core.environment:worldline/Simulator-v0", embodiment="ur5e_silver")``, ``make_vec`` alike.
"""

import gymnasium

ENVIRONMENT = "worldline/Simulator-v0"

if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(
        ENVIRONMENT,
        entry_point="worldline_core.environment.environment:WorldLineEnv",
        vector_entry_point="worldline_core.environment.environment:WorldLineVectorEnv",
    )
