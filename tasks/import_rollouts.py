"""`import_rollouts`: any folder of predicted videos as a set of rollouts, every file accounted for."""

from tasks.artifact_task import artifact_task

import_rollouts = artifact_task("import_rollouts")

if __name__ == "__main__":
    import_rollouts.main()
