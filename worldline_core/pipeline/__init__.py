"""The configuration of a run, its ablations, and estimates of its memory."""
