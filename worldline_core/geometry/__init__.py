"""Rigid transforms, cameras, embodiments and kinematics.

Frames: base (of the robot), link, tool (between the fingertips, +z out of the gripper), camera (OpenCV axes).
"""
