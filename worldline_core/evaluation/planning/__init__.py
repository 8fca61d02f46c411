"""Planning: choose one of N candidate control sequences by their predicted videos."""
