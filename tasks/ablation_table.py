"""`ablation_table`: the paper's ablations as one table beside the paper's numbers."""

from tasks.execution.artifact_task import ArtifactTask

ablation_table = ArtifactTask(
    name="ablation_table",
    version=5,
    function="worldline_core.report.ablation_table:ablation_table",
    config="worldline_core.report.ablation_table:AblationTableConfig",
    inputs=("evaluate_video.*",),
    optional_inputs=("evaluate_planning.*",),
)

if __name__ == "__main__":
    ablation_table.main()
