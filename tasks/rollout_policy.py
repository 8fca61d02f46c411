"""`rollout_policy`: videos of a policy that drives the simulator from recorded first frames on."""

from tasks.execution.artifact_task import ArtifactTask

rollout_policy = ArtifactTask(
    name="rollout_policy",
    version=2,
    function="worldline_core.rollout.policy_rollout:rollout_policy",
    config="worldline_core.rollout.rollout_config:PolicyRolloutConfig",
    inputs=("checkpoint", "tokenizer", "episodes"),
)

if __name__ == "__main__":
    rollout_policy.main()
