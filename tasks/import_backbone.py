"""`import_backbone`: turn pretrained Cosmos3 weights into the base checkpoint."""

from tasks.execution.artifact_task import ArtifactTask

import_backbone = ArtifactTask(
    name="import_backbone",
    summary="turn pretrained Cosmos3 weights into the base checkpoint",
    version=4,
    function="worldline_core.model.cosmos3:import_backbone",
    config="worldline_core.model.world_model_config:ImportBackboneConfig",
    inputs=("diffusers",),
)

if __name__ == "__main__":
    import_backbone.main()
