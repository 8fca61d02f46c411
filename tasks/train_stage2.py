"""`train_stage2`: Stage II: action-driven three-view prediction on successes and failures."""

from tasks.artifact_task import artifact_task

train_stage2 = artifact_task("train_stage2")

if __name__ == "__main__":
    train_stage2.main()
