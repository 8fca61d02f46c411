"""The world model as users open and hand it on: from a folder or the Hugging Face hub, with its card."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Literal, Self

import torch

from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model import world_model
from worldline_core.model.checkpoint import CheckpointInfo, CheckpointKind, load_checkpoint, save_checkpoint
from worldline_core.model.model_card import manifest_with_sources, model_card
from worldline_core.model.weight_files import MAX_SHARD_BYTES
from worldline_core.store.atomic import write_bytes_atomic

_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
_WANTED = ("*.safetensors", "*.json")
"""All that is fetched: numbers and JSON, nothing that could run."""


def pretrained_folder(source: Path | str, revision: str | None = None) -> Path:
    """A local folder: ``source`` itself, or a snapshot of that hub repository (safetensors and JSON files alone).

    The token is HF_TOKEN's, and HF_ENDPOINT names another hub. What was fetched before is not fetched again.

    Args:
        source: a folder, or ORG/NAME where there is no such folder.
        revision: branch, tag or commit of a hub repository.

    Raises:
        CheckpointError: there is no such folder, and it is no name on the hub.
        ConfigError: a revision of a folder.
        UnavailableError: the hub does not give it.
    """
    if Path(source).is_dir():
        if revision is not None:
            raise ConfigError("A folder has no revisions", where=source, got=revision, next_step="leave it out")
        return Path(source)
    if isinstance(source, Path) or _HUB_ID.fullmatch(source) is None:
        raise CheckpointError("No model here", where=source, expected="a folder, or ORG/NAME of the hub")
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        found = snapshot_download(
            source,
            revision=revision,
            allow_patterns=list(_WANTED),
            endpoint=os.environ.get("HF_ENDPOINT"),
            # False: without a token the client would look for one that some other program stored.
            token=os.environ.get("HF_TOKEN") or False,
        )
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, httpx.HTTPError, OSError, ValueError) as error:
        text = str(error).strip().splitlines()
        raise UnavailableError(
            "The hub does not give this model",
            where=source,
            expected="a folder of that name here, or the repository on the hub or in its local cache",
            got=f"{type(error).__name__}: {text[0] if text else ''}"[:300],
            next_step="check the name, the network and HF_TOKEN; offline, download it elsewhere and give its folder",
        ) from error
    return Path(found)


class WorldModel(world_model.WorldModel):
    """The network with the description of its checkpoint.

    Attributes:
        info: kind, contract of the controls, causal blocks, and what it was trained on.
    """

    info: CheckpointInfo
    manifest: dict[str, object]

    @classmethod
    def from_pretrained(
        cls,
        source: Path | str,
        *,
        revision: str | None = None,
        expect_kind: CheckpointKind | None = None,
        towers: Literal["both", "generation"] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Self:
        """Open a checkpoint of a folder or of the hub.

        Args:
            source: a folder, or ORG/NAME.
            expect_kind: refuse checkpoints of another kind.
            towers: ``generation`` leaves the text tower out.

        Raises:
            CheckpointError: nothing is here, or something does not fit; the message says what.
            UnavailableError: the hub does not give it.
        """
        folder = pretrained_folder(source, revision)
        model, info = load_checkpoint(folder, expect_kind=expect_kind, towers=towers, dtype=dtype, model_class=cls)
        model.info = info
        model.manifest = manifest_with_sources(folder)
        return model.eval()

    def save_pretrained(self, folder: Path | str, *, max_shard_bytes: int = MAX_SHARD_BYTES) -> None:
        """Write the checkpoint as it was opened, with a model card (README.md); weights keep their stored type.

        Args:
            max_shard_bytes: weights above this go into several files with an index.

        Raises:
            CheckpointError: a weight is not finite in the type of the checkpoint, or the model was not opened from one.
        """
        target, info = Path(folder), self.__dict__.get("info")
        if info is None:
            raise CheckpointError(
                "The model has no description to save",
                expected="a model of WorldModel.from_pretrained",
                got="one that was built from a configuration",
                next_step="write it with save_checkpoint, which is told its kind and contract",
            )
        save_checkpoint(
            target,
            self,
            kind=info.kind,
            action_contract=info.action_contract,
            causal=info.causal,
            trained=info.trained,
            metadata=info.metadata,
            dtype=getattr(torch, info.dtype),
            max_shard_bytes=max_shard_bytes,
        )
        write_bytes_atomic(target / "README.md", model_card(info, self.manifest).encode())
