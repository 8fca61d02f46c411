"""`distill`: Stage III: teacher forcing, trajectory regression, distribution matching."""

from tasks.artifact_task import artifact_task

distill = artifact_task("distill")

if __name__ == "__main__":
    distill.main()
