"""`render_actions`: project the controls into every view: action tracks and overlay previews."""

from tasks.artifact_task import artifact_task

render_actions = artifact_task("render_actions")

if __name__ == "__main__":
    render_actions.main()
