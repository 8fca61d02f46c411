"""WorldLine's simulator as a robot of LeRobot, and recorded commands as its teleoperator.

``lerobot-record --robot.type=worldline --teleop.type=worldline_replay``; ``lerobot-teleoperate``, ``lerobot-rollout`` and
``lerobot-replay`` alike.

Time is counted in commands. Each one advances the simulation by one frame (1/8 s at the rate of the shipped models), whatever
the clock says; without commands the world stands still. The state is new after every command, pictures come block by block, as in
the Gymnasium environment (``observe_every``), and are predicted when they are looked at.

LeRobot tells a robot nothing of its episodes, but announces each in its log ("Recording episode N"). There the simulation
begins anew: episode N at start ``seed + N`` modulo their number, with noise of that seed. Without announcements (teleoperation, a
rollout that records nothing) one simulation goes on from start ``seed``.
"""

from __future__ import annotations

from lerobot_robot_worldline.replay import WorldLineReplay, WorldLineReplayConfig
from lerobot_robot_worldline.robot import WorldLineRobot, WorldLineRobotConfig

__all__ = ["WorldLineReplay", "WorldLineReplayConfig", "WorldLineRobot", "WorldLineRobotConfig"]
