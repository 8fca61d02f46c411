"""`report`: static pages with tables, plots and videos."""

from tasks.execution.artifact_task import ArtifactTask

report = ArtifactTask(
    name="report",
    version=34,
    function="worldline_core.report.report:report",
    config="worldline_core.report.context:ReportConfig",
    optional_inputs=("*",),
)

if __name__ == "__main__":
    report.main()
