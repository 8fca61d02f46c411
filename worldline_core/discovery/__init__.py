"""Look at a folder of recordings: its kind, robot, columns, units and cameras, each with the evidence for it."""
