"""`evaluate_policy`: evidence, rules, accuracy against the recorded outcome."""

from tasks.execution.artifact_task import ArtifactTask

evaluate_policy = ArtifactTask(
    name="evaluate_policy",
    version=14,
    function="worldline_core.evaluation.policy.evaluate_policy:evaluate_policy",
    config="worldline_core.evaluation.evaluation_config:PolicyEvaluationConfig",
    inputs=("episodes", "rollouts.*"),
    optional_inputs=("tracks", "segmenter", "judge"),
)

if __name__ == "__main__":
    evaluate_policy.main()
