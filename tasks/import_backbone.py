"""`import_backbone`: turn pretrained weights (Cosmos3, Wan) into the base checkpoint."""

from tasks.execution.artifact_task import ArtifactTask

import_backbone = ArtifactTask(
    name="import_backbone",
    version=5,
    function="worldline_core.model.backbone:import_backbone",
    config="worldline_core.model.world_model_config:ImportBackboneConfig",
    inputs=("diffusers",),
)

if __name__ == "__main__":
    import_backbone.main()
