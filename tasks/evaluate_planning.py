"""`evaluate_planning`: bracket selection among candidate controls, success of the choice."""

from tasks.execution.artifact_task import ArtifactTask

evaluate_planning = ArtifactTask(
    name="evaluate_planning",
    version=12,
    function="worldline_core.evaluation.planning.evaluate_planning:evaluate_planning",
    config="worldline_core.evaluation.evaluation_config:PlanningConfig",
    inputs=("banks", "rollouts.*"),
    optional_inputs=("tracks", "segmenter", "judge", "sealed"),
)

if __name__ == "__main__":
    evaluate_planning.main()
