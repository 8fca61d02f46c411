"""`report`: one static page with tables, plots and videos."""

from tasks.artifact_task import artifact_task

report = artifact_task("report")

if __name__ == "__main__":
    report.main()
