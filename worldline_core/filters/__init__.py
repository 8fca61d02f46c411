"""Filters: which episodes, and which of their frames, are fit for training.

Each module holds one detector, a pure function of arrays; `filter` applies them all.
Axis legend: n frames, h w image, a arms.
"""
