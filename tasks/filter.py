"""`filter`: drop static, reset, corrupted, moving-base, misaligned and badly calibrated segments."""

from tasks.execution.artifact_task import ArtifactTask

filter_episodes = ArtifactTask(
    name="filter",
    version=18,
    function="worldline_core.filters.filter:filter_episodes",
    config="worldline_core.filters.filter_config:FilterConfig",
    inputs=("episodes",),
    mapped=True,
)

if __name__ == "__main__":
    filter_episodes.main()
