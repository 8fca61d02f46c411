"""`evaluate_planning`: bracket selection among candidate controls, success of the choice."""

from tasks.artifact_task import artifact_task

evaluate_planning = artifact_task("evaluate_planning")

if __name__ == "__main__":
    evaluate_planning.main()
