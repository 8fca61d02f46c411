"""WorldLine: from robot recordings to an action-driven visual simulator."""
