"""Policy evaluation: evidence from videos, deterministic rules, accuracy against recorded outcomes."""
