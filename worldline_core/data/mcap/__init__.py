"""MCAP recordings: this project's own topics, and those of ROS 2 and Foxglove (`topics`)."""
