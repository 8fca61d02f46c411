"""Curation: recordings in, an EpisodeSet and a quarantine out; duplicates, splits, primary views, weights."""
