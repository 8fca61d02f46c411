"""`train_segmenter`: train the small robot segmenter."""

from tasks.execution.artifact_task import ArtifactTask

train_segmenter = ArtifactTask(
    name="train_segmenter",
    version=6,
    function="worldline_core.evaluation.segmenters.learned:train_segmenter",
    config="worldline_core.evaluation.evaluation_config:SegmenterConfig",
    inputs=("episodes",),
    optional_inputs=("tracks",),
)

if __name__ == "__main__":
    train_segmenter.main()
