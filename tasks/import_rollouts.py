"""`import_rollouts`: any folder of predicted videos as a set of rollouts, every file accounted for."""

from tasks.execution.artifact_task import ArtifactTask

import_rollouts = ArtifactTask(
    name="import_rollouts",
    version=5,
    function="worldline_core.rollout.import_rollouts:import_rollouts",
    config="worldline_core.rollout.rollout_config:ImportRolloutsConfig",
    inputs=("videos", "episodes"),
)

if __name__ == "__main__":
    import_rollouts.main()
