"""Evaluation: video metrics, policy evaluation by evidence and rules, planning by brackets.

Axis legend for arrays below: n frames, h rows, w columns, v views, a arms, p points, c channels.
"""
