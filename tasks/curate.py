"""`curate`: read recordings of any source into one EpisodeSet."""

from tasks.artifact_task import artifact_task

curate = artifact_task("curate")

if __name__ == "__main__":
    curate.main()
