"""The public entry: a model of a folder, first images and controls in, videos out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from worldline_core import Camera, WorldLine
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CalibrationError, CheckpointError, ConfigError, DataError, UnavailableError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.rollout.simulation import Session

FRAMES = 17


class Observation:
    """The first held-out recording of a UR5e pair, as a user would have it at hand."""

    def __init__(self, recordings: Path) -> None:
        self.set = EpisodeSet.open(recordings)
        self.position = next(
            i for i, row in enumerate(self.set.rows) if row.embodiment == "ur5e_silver" and row.split == "test"
        )
        self.episode = self.set.episode(self.position)
        self.images = {view: self.set.frames(self.position, view, [0])[0] for view in self.episode.cameras}
        self.controls = self.episode.action[:FRAMES]
        self.cameras = {view: Camera(camera.K) for view, camera in self.episode.cameras.items()}
        head = self.episode.cameras["head"]
        self.cameras["head"] = Camera(head.K, head.T_base_camera[0])


@pytest.fixture(scope="module")
def observed(project_root: Path) -> Observation:
    return Observation(project_root / "artifacts" / "shipped" / "recordings")


@pytest.fixture(scope="module")
def models(project_root: Path) -> Path:
    return project_root / "artifacts" / "shipped" / "models"


@pytest.fixture(scope="module")
def causal(models: Path) -> WorldLine:
    return WorldLine.from_pretrained(models / "causal")


@pytest.mark.parametrize(("kind", "sampler", "steps"), [("causal", "block_causal", None), ("stage2", "full_clip", 1)])
def test_a_prediction_is_the_rollout_steps(
    observed: Observation, models: Path, tmp_path: Path, kind: str, sampler: str, steps: int | None
) -> None:
    tracks, _ = compute_tracks(observed.episode, ArmKinematics(load_embodiment("ur5e_silver")))
    write_index(tmp_path / "tracks", write_shard(tmp_path / "tracks", 0, [tracks]), sigma_px_ref=36.0)
    config = RolloutConfig.model_validate(
        {
            "sampler": {"kind": sampler, "steps": steps},
            "num_frames": FRAMES,
            "embodiments": ["ur5e_silver"],
            "max_episodes_per_embodiment": 1,
        }
    )
    inputs = {"episodes": observed.set.root, "tracks": tmp_path / "tracks", "tokenizer": models / "tokenizer"}
    rollout(config, inputs | {"checkpoint": models / kind}, tmp_path / "rollout")
    world = WorldLine.from_pretrained(models / kind, steps=steps)
    predicted = world.predict(observed.images, observed.controls, observed.cameras, embodiment="ur5e_silver")
    writer = RolloutSetWriter(tmp_path / "mine", "worldline", 8.0)
    writer.add(observed.episode.episode_id, 42, predicted)
    writer.close()
    steps_own, mine = RolloutSet.open(tmp_path / "rollout"), RolloutSet.open(tmp_path / "mine")
    for view in world.views:
        assert predicted[view].shape == (FRAMES, 64, 96, 3)
        assert predicted[view].dtype == np.uint8
        expected = steps_own.frames(observed.episode.episode_id, view)
        assert np.array_equal(mine.frames(observed.episode.episode_id, view), expected), view


def test_the_seed_and_the_controls_decide(observed: Observation, causal: WorldLine) -> None:
    assert causal.simulator([42]).fps == causal.contract.fps

    def predict(controls: np.ndarray, seed: int = 42) -> np.ndarray:
        videos = causal.predict(observed.images, controls, observed.cameras, embodiment="ur5e_silver", seed=seed)
        return videos["head"]

    first = predict(observed.controls)
    assert np.array_equal(first, predict(observed.controls))
    assert not np.array_equal(first, predict(observed.controls, seed=43))
    still = np.repeat(observed.controls[:1], FRAMES, axis=0)
    assert not np.array_equal(first, predict(still))


def test_controls_of_whole_intervals_drive_a_model_that_has_not_learnt_from_them_as_before(
    observed: Observation, causal: WorldLine, models: Path
) -> None:
    adapt = lambda config: config.model_copy(update={"action_frames": 4})  # noqa: E731
    model, info = load_checkpoint(models / "causal", adapt=adapt)
    world = WorldLine(model, info.model_copy(update={"config": model.config}), causal.tokenizer)
    given = (observed.images, observed.controls, observed.cameras)
    before, after = (simulator.predict(*given, embodiment="ur5e_silver") for simulator in (causal, world))
    assert all(np.abs(before[view].astype(int) - after[view]).max() <= 2 for view in before)


def test_weights_in_bfloat16_predict_nearly_the_same(observed: Observation, causal: WorldLine, models: Path) -> None:
    half = WorldLine.from_pretrained(models / "causal", weights="bfloat16")
    assert half.model.proj_in.weight.dtype == torch.bfloat16
    images = [frames_to_video(observed.images[view][None], causal.image_size)[:, 0] for view in causal.views]
    size = (1, len(causal.views), causal.info.config.control_channels, 1 + causal.causal.block_size)
    maps = torch.randn(*size, *causal.contract.grid_size, generator=torch.Generator().manual_seed(0))
    (expected,), (found,) = (line.session(torch.stack(images)[None], [42]).step(maps) for line in (causal, half))
    for view, frames in expected.items():
        assert np.abs(found[view].astype(int) - frames).mean() < 1


@pytest.mark.parametrize("anchor_blocks", [1, *(pytest.param(blocks, marks=pytest.mark.slow) for blocks in (None, 2))])
def test_decoding_one_block_while_the_next_is_sampled_changes_nothing(
    observed: Observation, causal: WorldLine, anchor_blocks: int | None
) -> None:
    images = [frames_to_video(observed.images[view][None], causal.image_size)[:, 0] for view in causal.views]
    size = (1, len(causal.views), causal.info.config.control_channels, 1 + causal.causal.block_size)
    generator = torch.Generator().manual_seed(0)
    maps = [torch.randn(*size, *causal.contract.grid_size, generator=generator) for _ in range(4)]
    spec = causal.causal.model_copy(update={"anchor_blocks": anchor_blocks})

    def blocks(*, overlapped: bool) -> list[dict[str, np.ndarray]]:
        sampler = BlockCausalSimulator(causal.model, spec, noise=Noise([42]), views=causal.views)
        session = Session(sampler, causal.tokenizer, torch.stack(images)[None], device="cpu", bfloat16=False)
        return [clips[0] for clips in session.steps(maps, overlapped=overlapped)]

    for one, other in zip(blocks(overlapped=True), blocks(overlapped=False), strict=True):
        assert all(np.array_equal(one[view], other[view]) for view in causal.views)


def test_what_does_not_fit_is_refused(observed: Observation, causal: WorldLine, models: Path, tmp_path: Path) -> None:
    def refused(match: str, error: type[Exception] = DataError, **changes: object) -> None:
        given: dict[str, object] = {
            "images": observed.images,
            "controls": observed.controls,
            "cameras": observed.cameras,
            "embodiment": "ur5e_silver",
        }
        with pytest.raises(error, match=match):
            causal.predict(**(given | changes))  # type: ignore[arg-type]

    refused(r"(?s)1 \+ k \* 16 rows.*got: 16", controls=observed.controls[:16])
    refused("not trained on these views together", images={"left_wrist": observed.images["left_wrist"]})
    refused("No camera of the view head, left_wrist, right_wrist: the model takes action maps alone", cameras={})
    refused("RGB and of one size", images=observed.images | {"head": observed.images["head"][:8]})
    refused(r"(?s)camera without a pose.*head", cameras=observed.cameras | {"head": Camera(observed.cameras["head"].K)})
    refused(
        "camera pose has a wrong shape",
        cameras=observed.cameras | {"head": Camera(observed.cameras["head"].K, np.eye(3))},
    )
    head = observed.cameras["head"]
    for factor in (1000.0, 1e38):
        pose = head.T_base_camera.copy()
        pose[:3, 3] *= factor
        cameras = observed.cameras | {"head": Camera(head.K, pose)}
        refused(r"(?s)too far from the robot.*head", CalibrationError, cameras=cameras)
    for factor in (0.5, 2.0, 10 / 3):
        cameras = observed.cameras | {"head": Camera(np.diag([factor, factor, 1.0]) @ head.K, head.T_base_camera)}
        refused(r"(?s)another image size.*head", CalibrationError, cameras=cameras)
    grippers = np.isin(np.arange(14), [6, 13])
    for controls in (
        np.degrees(observed.controls), observed.controls * 100, observed.controls.astype(complex),
        np.where(grippers, 2.0, observed.controls), np.ma.masked_less(observed.controls, 0.0),
    ):  # fmt: skip
        refused(r"beyond its|array of numbers", controls=controls)
    for seed in (1.5, True, "1", -1):
        refused("Not a seed", seed=seed)
    refused("arrays of uint8", images=observed.images | {"head": observed.images["head"] / 255})
    for K in (np.full((3, 3), np.nan), np.zeros((3, 3)), np.diag([80.0, -80.0, 1.0])):
        cameras = observed.cameras | {"head": Camera(K, head.T_base_camera)}
        refused(r"(?s)camera matrix is not usable.*head", CalibrationError, cameras=cameras)
    sheared = np.eye(4) + np.eye(4, k=1) * 0.01
    refused("not a rigid transform", CalibrationError, cameras=observed.cameras | {"head": Camera(head.K, sheared)})
    refused("Unknown embodiment", ConfigError, embodiment="ur55_pair")
    with pytest.raises(CheckpointError, match="tokenizer is not here"):
        WorldLine.from_pretrained(models / "causal", tokenizer=tmp_path / "none")
    with pytest.raises(CheckpointError, match=r"(?s)wrong kind.*stage2 or causal.*base"):
        WorldLine.from_pretrained(models / "base")
    with pytest.raises(CheckpointError, match="Only a causal model goes block by block"):
        WorldLine.from_pretrained(models / "stage2").simulator([42])


def test_a_name_that_the_package_lacks_is_an_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Simulator'"):
        __import__("worldline_core").Simulator  # noqa: B018


def test_a_gpu_that_is_not_here_is_said_before_anything_is_loaded(
    models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device in ("cuda", "cuda:1"):
        with pytest.raises(UnavailableError, match=rf"(?s)No GPU.*device={device}.*next step: device=cpu"):
            WorldLine.from_pretrained(models / "causal", device=device)
