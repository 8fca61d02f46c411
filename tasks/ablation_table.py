"""`ablation_table`: the paper's ablations as one table beside the paper's numbers."""

from tasks.artifact_task import artifact_task

ablation_table = artifact_task("ablation_table")

if __name__ == "__main__":
    ablation_table.main()
