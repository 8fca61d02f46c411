"""Checkpoints on disk: ``model.safetensors`` (or several files with an index) and ``checkpoint.json``, read strictly.

Several files have the form of transformers and diffusers: ``NAME.safetensors.index.json`` maps every tensor to a file beside
it. An index written here also holds the SHA-256 of each file, so that its own digest covers all of them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Self

import torch
from pydantic import BaseModel, ValidationError, model_validator
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError
from worldline_core.model.layers import is_action_parameter, new_action_tensors
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import (
    ActionContract,
    CausalSpec,
    NativeVectors,
    NetworkConfig,
    TrainedClips,
    WorldModelConfig,
)
from worldline_core.store.artifact_files import digest_file
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

INDEX_SUFFIX = ".index.json"
MAX_SHARD_BYTES = 5_000_000_000
"""Weights above this go into several files."""
_AGAIN = "fetch the folder again; what makes a checkpoint here writes its description last"


def write_weights(path: Path, tensors: Mapping[str, Tensor], dtype: torch.dtype) -> str:
    """Write ``path``, or, above `MAX_SHARD_BYTES`, ``NAME-00001-of-0000N.safetensors`` and so on with an index.

    Equal tensors give equal bytes. They are cast file by file. Files of an earlier write of the same name are removed.

    Returns:
        SHA-256 of the one file, or of the index.
    """
    shards: list[list[str]] = [[]]
    size = total = 0
    for name in sorted(tensors):
        own = tensors[name].numel() * dtype.itemsize
        if shards[-1] and size + own > MAX_SHARD_BYTES:
            shards.append([])
            size = 0
        shards[-1].append(name)
        size, total = size + own, total + own
    files = {path.name: shards[0]}
    if len(shards) > 1:
        places = enumerate(shards, start=1)
        files = {f"{path.stem}-{n:05d}-of-{len(shards):05d}{path.suffix}": names for n, names in places}
    digests: dict[str, str] = {}
    for file, names in files.items():
        # Clones: tensors that share memory are in every file.
        content = save({name: tensors[name].detach().to("cpu", dtype).contiguous().clone() for name in names})
        write_bytes_atomic(path.with_name(file), content)
        digests[file] = hashlib.sha256(content).hexdigest()
    digest, index = digests.get(path.name, ""), path.with_name(path.name + INDEX_SUFFIX)
    if len(shards) > 1:
        weight_map = {name: file for file, names in files.items() for name in names}
        write_json_atomic(index, {"metadata": {"total_size": total, "sha256": digests}, "weight_map": weight_map})
        digest = digest_file(index)
        digests[index.name] = digest
    for old in (path, index, *path.parent.glob(f"{path.stem}-*-of-*{path.suffix}")):
        if old.name not in digests:
            old.unlink(missing_ok=True)
    return digest


def read_weights(path: Path, sha256: str | None) -> dict[str, Tensor]:
    """The tensors of a safetensors file, or of those that its index names where ``path`` itself is not there.

    Args:
        sha256: digest of the file or of the index; None: not known.

    Raises:
        CheckpointError: a file is missing or damaged, or holds other weights; the index names a file outside of the folder,
            or disagrees with the files. The message names the file.
    """
    index = path.with_name(path.name + INDEX_SUFFIX)
    if path.is_file():
        return _read(path, sha256)
    if not index.is_file():
        raise CheckpointError(
            "The checkpoint has no weights", where=path, expected=f"{path.name}, or {index.name} and its files",
            next_step=_AGAIN,
        )  # fmt: skip
    content = index.read_bytes()
    _check_digest(index, hashlib.sha256(content).hexdigest(), sha256)
    tensors: dict[str, Tensor] = {}
    for shard, names, digest in _indexed(index, content):
        found = _read(shard, digest)
        if found.keys() != names:
            raise CheckpointError(
                "An index and a file of weights disagree",
                where=shard,
                expected=f"the {len(names)} tensors that {index.name} names",
                got=f"missing {sorted(names - found.keys())[:8]}, others {sorted(found.keys() - names)[:8]}",
                next_step=_AGAIN,
            )
        tensors |= found
    return tensors


def _indexed(index: Path, content: bytes) -> Iterator[tuple[Path, set[str], str | None]]:
    """Each file of an index, with its tensors and its digest where that is stated.

    Raises: CheckpointError when the index is damaged, or names something else than a file beside it.
    """
    try:
        read: Any = json.loads(content)
        weight_map = {str(key): str(name) for key, name in read["weight_map"].items()}
        digests = read.get("metadata", {}).get("sha256", {})
        stated = {str(name): str(value) for name, value in digests.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(
            "An index of weights is damaged", where=index, expected="{weight_map: {tensor: file}}",
            got=f"{type(error).__name__}: {error}", next_step=_AGAIN,
        ) from error  # fmt: skip
    for name in sorted(set(weight_map.values())):
        if Path(name).name != name or not name.endswith(".safetensors") or "\\" in name:
            raise CheckpointError(
                "An index of weights names something else than a file of its folder",
                where=index,
                expected="NAME.safetensors",
                got=name,
                next_step="do not use weights of this origin",
            )
        shard = index.with_name(name)
        if not shard.is_file():
            raise CheckpointError(
                "A weight file is missing", where=shard, expected=f"all files that {index.name} names",
                got="no such file", next_step=_AGAIN,
            )  # fmt: skip
        yield shard, {key for key, file in weight_map.items() if file == name}, stated.get(name)


def _read(path: Path, sha256: str | None) -> dict[str, Tensor]:
    """Views of the mapped file: it takes no memory until it is read, and can be dropped from there at any time."""
    _check_digest(path, digest_file(path), sha256)
    try:
        return load_file(path)
    except SafetensorError as error:
        raise CheckpointError("The weights file is damaged", where=path, got=str(error), next_step=_AGAIN) from error


def _check_digest(path: Path, digest: str, sha256: str | None) -> None:
    if sha256 not in (None, digest):
        raise CheckpointError(
            "The weights are not those that are described", where=path, expected=sha256, got=digest, next_step=_AGAIN
        )


CheckpointKind = Literal["base", "stage1", "stage2", "causal"]
FORMAT = "worldline.checkpoint"
VERSION = 1
WEIGHTS, DESCRIPTION = "model.safetensors", "checkpoint.json"
BY_FRAME = ("action_encoder.proj.weight", "action_film.hidden.weight")
"""Weights whose columns are of one control frame after the other."""
CHECKPOINT_DTYPE = torch.float16
SINGLE_PRECISION = ("time_embedder.",)
"""Parameters that are never rounded to half precision: a noise level of 1000 sigma needs its digits (Cosmos3)."""


class CheckpointInfo(StrictModel):
    """The content of ``checkpoint.json``.

    Attributes:
        action_contract: meaning of the controls in training; None for models that have seen none.
        vectors: of a model that takes control vectors: the robots that it knows by them.
        trained: views and strides of the clips that it was trained on; None: all views together, at stride 1.
        metadata: where it comes from; nothing is computed from it.
    """

    kind: CheckpointKind
    config: NetworkConfig
    action_contract: ActionContract | None
    causal: CausalSpec | None = None
    trained: TrainedClips | None = None
    vectors: NativeVectors | None = None
    metadata: dict[str, Any]
    dtype: str
    weights_sha256: str

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.kind in ("stage2", "causal") and self.action_contract is None:
            raise ValueError(f"action_contract: a checkpoint of kind {self.kind} needs one")
        drawn, takes = self.action_contract and self.action_contract.sigma_px_ref, self.config.action_conditioning
        if self.action_contract is not None and self.config.takes_maps == (drawn is None):
            raise ValueError(f"action_contract.sigma_px_ref: {drawn}, of a model that takes {takes}")
        if self.action_contract is not None and (self.config.native_size is None) != (self.vectors is None):
            raise ValueError(f"vectors: {self.vectors}, of a model that takes {takes}")
        if (self.kind == "causal") != (self.causal is not None):
            raise ValueError(f"causal: needed by the kind causal and no other, not by {self.kind}")
        shown = {view for views in (self.trained.view_sets if self.trained else ()) for view in views}
        if unknown := sorted(shown - set(self.config.views)):
            raise ValueError(f"trained.view_sets: {unknown} are none of the model's views {self.config.views}")
        return self

    @property
    def view_sets(self) -> tuple[tuple[str, ...], ...]:
        """Sets of views that a prediction may show: those that training clips showed together and that hold the model's first
        trained view; the largest comes first."""
        slots = tuple(self.config.views)
        trained = {slots} if self.trained is None else set(self.trained.view_sets)
        orders = {views: [slots.index(view) for view in views] for views in trained}
        first = min(order[0] for order in orders.values())
        fitting = [views for views, order in orders.items() if order[0] == first]
        return tuple(sorted(fitting, key=lambda views: (-len(views), orders[views])))

    @property
    def views(self) -> tuple[str, ...]:
        """Views of the largest trained set."""
        return self.view_sets[0]

    @property
    def strides(self) -> tuple[int, ...]:
        return (1,) if self.trained is None else self.trained.strides

    @property
    def contract(self) -> ActionContract:
        """The action contract. Raises: CheckpointError when the model takes no actions."""
        if self.action_contract is None:
            raise CheckpointError("The model takes no actions", expected="a Stage II or causal model", got=self.kind)
        return self.action_contract


def save_checkpoint(
    folder: Path,
    model: WorldModel,
    *,
    kind: CheckpointKind,
    action_contract: ActionContract | None,
    causal: CausalSpec | None = None,
    trained: TrainedClips | None = None,
    vectors: NativeVectors | None = None,
    metadata: Mapping[str, Any] | None = None,
    dtype: torch.dtype = CHECKPOINT_DTYPE,
    state_dict: Mapping[str, Tensor] | None = None,
) -> None:
    """Write a model, or ``state_dict`` (an averaged copy) in its place. Equal weights and metadata give equal bytes.

    Raises:
        CheckpointError: the kind is unknown or lacks its contract, or a weight is not finite in ``dtype``.
    """
    source = model.state_dict() if state_dict is None else state_dict
    for name, tensor in sorted(source.items()):
        if not bool(torch.isfinite(tensor.detach().to(dtype)).all()):
            raise CheckpointError(
                "A weight is not finite", where=name, next_step=f"it may overflow {dtype}; check training"
            )
    info = described(
        CheckpointInfo,
        {
            "kind": kind,
            "config": model.config,
            "action_contract": action_contract,
            "causal": causal,
            "trained": trained,
            "vectors": vectors,
            "metadata": dict(metadata or {}),
            "dtype": str(dtype).removeprefix("torch."),
            "weights_sha256": "",
        },
        folder,
    )
    # The description goes last: until then the folder is no checkpoint.
    digest = write_weights(folder / WEIGHTS, source, dtype)
    stated = info.model_copy(update={"weights_sha256": digest}).model_dump(mode="json")
    write_json_atomic(folder / DESCRIPTION, {"format": FORMAT, "version": VERSION, **stated})


def read_checkpoint_info(folder: Path) -> CheckpointInfo:
    """Read ``checkpoint.json`` alone.

    Raises:
        CheckpointError: the file is missing, damaged, of another format, or lacks a field; the message names it.
    """
    path = folder / DESCRIPTION
    content = read_description(path, FORMAT, "checkpoint", VERSION)
    return described(CheckpointInfo, content, path)


_KIND_HINTS = {
    "causal": "train from the Stage II model that it was distilled from, or go on with it by"
    " worldline task distill --input causal=FOLDER; its rollouts have sampler.kind block_causal",
    "stage2": "worldline task distill makes a causal model of it; its rollouts have sampler.kind full_clip",
    "stage1": "worldline task train_stage2 makes a model that takes controls of it",
}


def load_checkpoint(
    folder: Path,
    *,
    expect_kind: CheckpointKind | tuple[CheckpointKind, ...] | None = None,
    towers: Literal["both", "generation"] | None = None,
    adapt: Callable[[WorldModelConfig], WorldModelConfig] = lambda config: config,
    dtype: torch.dtype = torch.float32,
    weights: bool = True,
) -> tuple[WorldModel, CheckpointInfo]:
    """Build the model and fill it; nothing may be missing, left over, or of another shape.

    Args:
        expect_kind: kind or kinds the caller can use.
        towers: ``generation`` drops the understanding tower of a checkpoint that has it; None keeps what is stored.
        adapt: gives the model other action branches, or more control frames per latent frame. What the checkpoint does not know
            of them starts without effect, so that the model computes what it computed.
        weights: False gives an empty model (on the meta device), for a process that gets its weights from another one.

    Raises:
        CheckpointError: anything that does not fit, with what was expected.
    """
    info = read_checkpoint_info(folder)
    kinds = (expect_kind,) if isinstance(expect_kind, str) else expect_kind
    if kinds is not None and info.kind not in kinds:
        raise CheckpointError(
            "The checkpoint is of the wrong kind",
            where=folder,
            expected=" or ".join(kinds),
            got=info.kind,
            next_step=_KIND_HINTS.get(info.kind),
        )
    config = info.config
    if towers == "both" and config.towers != "both":
        raise CheckpointError(
            "The checkpoint has no understanding tower", where=folder, expected="both", got=config.towers
        )
    if towers == "generation":
        config = config.model_copy(update={"towers": "generation"})
    config = adapt(config)
    if config.action_frames < info.config.action_frames:
        raise CheckpointError(
            "The checkpoint takes the controls of more frames",
            where=folder,
            expected=f"action_frames {info.config.action_frames}",
            got=config.action_frames,
            next_step=f"set action_frames to {info.config.action_frames}, or start from another checkpoint",
        )
    with torch.device("meta"):  # a description may ask for any size: only weights that are there take memory
        model = build_world_model(config)
    if weights:
        path = folder / WEIGHTS
        tensors = _with_branches(config, info.config, read_weights(path, info.weights_sha256))
        if config.towers == "generation":
            tensors = {name: tensor for name, tensor in tensors.items() if not model.is_text_parameter(name)}
        fill(model, tensors, where=path, dtype=dtype)
    return model, info


def _with_branches(config: WorldModelConfig, stored: WorldModelConfig, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors, with those of the action branches as ``config`` has them."""
    fields = ("action_conditioning", "native_size", "action_frames")
    if all(getattr(config, name) == getattr(stored, name) for name in fields):
        return tensors
    new = new_action_tensors(config)
    kept = {name: tensor for name, tensor in tensors.items() if name in new or not is_action_parameter(name)}
    if config.action_frames != stored.action_frames:
        for name in kept.keys() & set(BY_FRAME):
            kept[name] = torch.nn.functional.pad(kept[name], (0, new[name].shape[1] - kept[name].shape[1]))
    return new | kept


def read_description(path: Path, form: str, noun: str, version: int) -> dict[str, Any]:
    """Read the JSON description of weights (``noun`` in errors), without its ``format`` and ``version``, which are checked.

    Raises:
        CheckpointError: it is missing, damaged, or of another ``format`` or ``version``.
    """
    if not path.is_file():
        raise CheckpointError(f"No {noun} here", where=path.parent, expected=f"a folder with {path.name}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"The {noun} description is not JSON", where=path, got=str(error)) from error
    found = (content.pop("format", None), content.pop("version", None)) if isinstance(content, dict) else type(content)
    if found != (form, version):
        raise CheckpointError(f"Not a {noun} of this version", where=path, expected=(form, version), got=found)
    return content


def described[M: BaseModel](model: type[M], values: object, where: object) -> M:
    """Values of a description as a model. Raises: CheckpointError where they are not valid."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in error.errors()]
        raise CheckpointError(
            "The description of the weights is not valid", where=where, got="; ".join(problems),
            next_step="train it again with this version",
        ) from error  # fmt: skip


def fill(model: torch.nn.Module, tensors: Mapping[str, Tensor], *, where: object, dtype: torch.dtype) -> None:
    """Load ``tensors`` into ``model`` in ``dtype``, strictly; each takes the parameter's place as soon as it is cast.

    ``model`` may be on the meta device: then nothing takes memory but the weights themselves. Embedders of the noise level
    stay in float32, as they are computed.

    Raises:
        CheckpointError: keys are missing or left over, a shape differs, or values are not finite floating-point numbers.
    """
    check_fit({name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}, tensors, where)
    for name, tensor in tensors.items():
        if not tensor.is_floating_point() or not bool(torch.isfinite(tensor.float()).all()):
            raise CheckpointError(
                "A weight is not finite", where=f"{where}: {name}", expected="finite floating-point numbers",
                got=tensor.dtype, next_step="fetch the checkpoint again, or train it again",
            )  # fmt: skip
    model.to(dtype)
    # Copies: what was read may be a view of the file.
    cast = {
        name: tensor.to(torch.float32 if name.startswith(SINGLE_PRECISION) else dtype, copy=True)
        for name, tensor in tensors.items()
    }
    model.load_state_dict(cast, assign=True)


def check_fit(own: Mapping[str, tuple[int, ...]], tensors: Mapping[str, Tensor], where: object) -> None:
    """Raises: CheckpointError when keys are missing or left over, or a shape differs."""
    missing, unexpected = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or unexpected:
        raise CheckpointError(
            "The weights do not fit the model",
            where=where,
            expected=f"{len(own)} tensors; missing: {', '.join(missing[:8]) or 'none'}",
            got=f"{len(tensors)} tensors; unexpected: {', '.join(unexpected[:8]) or 'none'}",
        )
    for name, shape in own.items():
        if tuple(tensors[name].shape) != shape:
            raise CheckpointError(
                "A weight has the wrong shape", where=f"{where}: {name}", expected=shape, got=tuple(tensors[name].shape)
            )
