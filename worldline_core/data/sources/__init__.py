"""Readers of recordings: each turns its own format, units and conventions into `Episode`."""
