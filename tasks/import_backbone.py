"""`import_backbone`: turn pretrained Cosmos3 weights into the base checkpoint."""

from tasks.artifact_task import artifact_task

import_backbone = artifact_task("import_backbone")

if __name__ == "__main__":
    import_backbone.main()
