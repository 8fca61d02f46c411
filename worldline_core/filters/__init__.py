"""Filters: which episodes, and which of their frames, are fit for training.

`examine` lists the detectors, `filter_config` has their thresholds, `filter` applies them to a set.
Axis legend: n frames, h w image, a arms.
"""
