"""`filter`: drop static, reset, corrupted, moving-base, misaligned and badly calibrated segments."""

from tasks.artifact_task import artifact_task

filter_episodes = artifact_task("filter")

if __name__ == "__main__":
    filter_episodes.main()
