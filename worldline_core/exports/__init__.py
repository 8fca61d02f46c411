"""Episodes and predictions in formats of other tools: MCAP, Rerun, LeRobotDataset v3, videos."""
