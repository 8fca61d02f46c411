"""`train_teacher`: train the small relational teacher of the embedded default."""

from tasks.artifact_task import artifact_task

train_teacher = artifact_task("train_teacher")

if __name__ == "__main__":
    train_teacher.main()
