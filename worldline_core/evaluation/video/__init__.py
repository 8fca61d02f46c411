"""Full-frame and robot-mask agreement between predicted and recorded videos."""
