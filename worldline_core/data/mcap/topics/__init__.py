"""MCAP recordings of other tools (ROS 2, Foxglove): messages of declared topics resampled to episodes of a fixed rate.

Axis legend: `n` messages of a topic, `t` instants of the fixed rate. Times are int64 nanoseconds.
"""
