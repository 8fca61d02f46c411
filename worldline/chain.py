"""The project's chain, for a task that runs alone: tasks do not import flows."""

from flows.pipeline import chain

__all__ = ["chain"]
