"""WorldLine: from robot recordings to an action-driven visual simulator.

``WorldLine.from_pretrained(folder).predict(images, controls, cameras)`` predicts videos, ``PretrainedWorldModel.from_pretrained(folder)``
is the network alone; both take a hub's ORG/NAME too. Importing the package alone imports no torch.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worldline_core.model.pretrained import PretrainedWorldModel
    from worldline_core.rollout.worldline import Camera, WorldLine

__all__ = ["Camera", "PretrainedWorldModel", "WorldLine"]


def __getattr__(name: str) -> object:
    if name == "PretrainedWorldModel":
        from worldline_core.model.pretrained import PretrainedWorldModel

        return PretrainedWorldModel
    if name in __all__:
        from worldline_core.rollout import worldline

        return getattr(worldline, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
