"""Filters: which episodes, and which of their frames, are fit for training.

`filter` lists the detectors and applies them to a set, `filter_config` has their thresholds.
Axis legend: n frames, h w image, a arms.
"""
