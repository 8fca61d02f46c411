"""`train_stage1`: Stage I: action-free, text-conditioned video prediction."""

from tasks.artifact_task import artifact_task

train_stage1 = artifact_task("train_stage1")

if __name__ == "__main__":
    train_stage1.main()
