"""`train_segmenter`: train the small robot segmenter of the embedded default."""

from tasks.artifact_task import artifact_task

train_segmenter = artifact_task("train_segmenter")

if __name__ == "__main__":
    train_segmenter.main()
