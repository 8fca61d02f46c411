"""`rollout`: predict videos from a first observation and controls."""

from tasks.artifact_task import artifact_task

rollout = artifact_task("rollout")

if __name__ == "__main__":
    rollout.main()
