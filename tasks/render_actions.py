"""`render_actions`: project the controls into every view: action tracks and overlay previews."""

from tasks.execution.artifact_task import ArtifactTask

render_actions = ArtifactTask(
    name="render_actions",
    version=8,
    function="worldline_core.actions.render_actions:render_actions",
    config="worldline_core.actions.actions_config:RenderActionsConfig",
    inputs=("episodes",),
    mapped=True,
)

if __name__ == "__main__":
    render_actions.main()
