"""Prefect tasks: one thin file a verb, each also runnable alone with ``python -m tasks.<verb>``."""
