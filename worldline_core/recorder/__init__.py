"""Recorder: simulated robots, scenes and noisy controllers that produce the embedded recordings."""
