"""`curate`: read recordings of any source into one EpisodeSet."""

from tasks.execution.artifact_task import ArtifactTask

curate = ArtifactTask(
    name="curate",
    version=26,
    function="worldline_core.data.curation.curate:curate",
    config="worldline_core.data.curation.curate_config:CurateConfig",
    optional_inputs=("source.*",),
    mapped=True,
)

if __name__ == "__main__":
    curate.main()
