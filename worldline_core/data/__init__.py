"""Recordings: episodes, the sets they form, and the formats they come in."""
