"""`evaluate_policy`: evidence, rules, accuracy against the recorded outcome."""

from tasks.artifact_task import artifact_task

evaluate_policy = artifact_task("evaluate_policy")

if __name__ == "__main__":
    evaluate_policy.main()
