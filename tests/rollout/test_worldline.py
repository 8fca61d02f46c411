"""The public entry: a model of a folder, first images and controls in, videos out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.rollout.conftest import ROBOT
from worldline_core import Camera, WorldLine
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.errors import CalibrationError, CheckpointError, ConfigError, DataError
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


@pytest.fixture(scope="module")
def observed(held_out):
    """With a camera pose of the head alone."""
    cameras = {view: Camera(camera.K) for view, camera in held_out[0].cameras.items()}
    cameras["head"] = held_out[0].cameras["head"]
    return replace(held_out[0], cameras=cameras, controls=held_out[0].controls[:FRAMES])


@pytest.fixture(scope="module")
def models(project_root):
    return project_root / "artifacts" / "shipped" / "models"


@pytest.fixture(scope="module")
def causal(models):
    return WorldLine.from_pretrained(models / "causal")


@pytest.mark.parametrize(("kind", "sampler", "steps"), [("causal", "block_causal", None), ("stage2", "full_clip", 1)])
def test_a_prediction_is_the_rollout_steps(observed, models, tmp_path, kind, sampler, steps):
    tracks, _ = compute_tracks(observed.episode, ArmKinematics(load_embodiment(ROBOT)))
    write_index(tmp_path / "tracks", write_shard(tmp_path / "tracks", 0, [tracks]), sigma_px_ref=36.0)
    config = RolloutConfig.model_validate({
        "sampler": {"kind": sampler, "steps": steps}, "num_frames": FRAMES, "embodiments": [ROBOT],
        "max_episodes_per_embodiment": 1,
    })  # fmt: skip
    inputs = {"episodes": observed.root, "tracks": tmp_path / "tracks", "tokenizer": models / "tokenizer"}
    rollout(config, inputs | {"checkpoint": models / kind}, tmp_path / "rollout")
    world = WorldLine.from_pretrained(models / kind, steps=steps)
    predicted = world.predict(observed.images, observed.controls, observed.cameras, embodiment=ROBOT)
    writer = RolloutSetWriter(tmp_path / "mine", "worldline", 8.0)
    writer.add(observed.episode.episode_id, 42, predicted)
    writer.close()
    expected, mine = RolloutSet.open(tmp_path / "rollout"), RolloutSet.open(tmp_path / "mine")
    for view in world.views:
        assert (predicted[view].shape, predicted[view].dtype) == ((FRAMES, 64, 96, 3), np.uint8)
        assert np.array_equal(*(found.frames(observed.episode.episode_id, view) for found in (mine, expected))), view


def test_controls_of_whole_intervals_drive_a_model_that_has_not_learnt_from_them_as_before(observed, causal, models):
    adapt = lambda config: config.model_copy(update={"action_frames": 4})  # noqa: E731
    model, info = load_checkpoint(models / "causal", adapt=adapt)
    world = WorldLine(model, info.model_copy(update={"config": model.config}), causal.tokenizer)
    given = (observed.images, observed.controls, observed.cameras)
    before, after = (simulator.predict(*given, embodiment=ROBOT) for simulator in (causal, world))
    assert all(np.abs(before[view].astype(int) - after[view]).max() <= 2 for view in before)


def test_weights_in_bfloat16_predict_nearly_the_same(observed, causal, models):
    half = WorldLine.from_pretrained(models / "causal", weights="bfloat16")
    assert half.model.proj_in.weight.dtype == torch.bfloat16
    images = [frames_to_video(observed.images[view][None], causal.image_size)[:, 0] for view in causal.views]
    size = (1, len(causal.views), causal.info.config.control_channels, 1 + causal.causal.block_size)
    maps = torch.randn(*size, *causal.contract.grid_size, generator=torch.Generator().manual_seed(0))
    (expected,), (found,) = (line.session(torch.stack(images)[None], [42]).step(maps) for line in (causal, half))
    for view, frames in expected.items():
        assert np.abs(found[view].astype(int) - frames).mean() < 1


@pytest.mark.parametrize("anchor_blocks", [1, *(pytest.param(blocks, marks=pytest.mark.slow) for blocks in (None, 2))])
def test_decoding_one_block_while_the_next_is_sampled_changes_nothing(observed, causal, anchor_blocks):
    images = [frames_to_video(observed.images[view][None], causal.image_size)[:, 0] for view in causal.views]
    size = (1, len(causal.views), causal.info.config.control_channels, 1 + causal.causal.block_size)
    generator = torch.Generator().manual_seed(0)
    maps = [torch.randn(*size, *causal.contract.grid_size, generator=generator) for _ in range(4)]
    spec = causal.causal.model_copy(update={"anchor_blocks": anchor_blocks})

    def blocks(*, overlapped):
        sampler = BlockCausalSimulator(causal.model, spec, noise=Noise([42]), views=causal.views)
        session = Session(sampler, causal.tokenizer, torch.stack(images)[None], device="cpu", bfloat16=False)
        return [clips[0] for clips in session.steps(maps, overlapped=overlapped)]

    for one, other in zip(blocks(overlapped=True), blocks(overlapped=False), strict=True):
        assert all(np.array_equal(one[view], other[view]) for view in causal.views)


def shifted(T, factor):
    return T * np.array([[1, 1, 1, factor]] * 3 + [[1] * 4])


SHEARED = np.eye(4) + np.eye(4, k=1) * 0.01
UNUSABLE = (np.full((3, 3), np.nan), np.zeros((3, 3)), np.diag([80.0, -80.0, 1.0]))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda K, T: (K, None), DataError, "camera without a pose.*head"),
        (lambda K, T: (K, np.eye(3)), DataError, "camera pose has a wrong shape"),
        (lambda K, T: (K, SHEARED), CalibrationError, "not a rigid transform"),
        (lambda K, T: (K, shifted(T, 1000.0)), CalibrationError, "too far from the robot.*head"),
        (lambda K, T: (K, shifted(T, 1e38)), CalibrationError, "too far from the robot.*head"),
        *((lambda K, T, of=of: (np.diag([of, of, 1.0]) @ K, T), CalibrationError, "another image size.*head") for of in (0.5, 2, 10 / 3)),
        *((lambda _, T, K=K: (K, T), CalibrationError, "camera matrix is not usable.*head") for K in UNUSABLE),
    ],
)  # fmt: skip
def test_a_camera_that_cannot_be_right_is_refused(observed, causal, change, error, message):
    head = observed.cameras["head"]
    cameras = observed.cameras | {"head": Camera(*change(head.K, head.T_base_camera))}
    with pytest.raises(error, match=f"(?s){message}"):
        causal.predict(observed.images, observed.controls, cameras, embodiment=ROBOT)


def test_what_does_not_fit_is_refused(observed, causal, models, tmp_path):
    images, controls = observed.images, observed.controls
    grippers = np.isin(np.arange(14), [6, 13])
    beyond = (
        np.degrees(controls), controls * 100, controls.astype(complex), np.where(grippers, 2.0, controls),
        np.ma.masked_less(controls, 0.0),
    )  # fmt: skip
    for changes, error, message in (
        ({"controls": controls[:16]}, DataError, r"1 \+ k \* 16 rows.*got: 16"),
        ({"images": {"left_wrist": images["left_wrist"]}}, DataError, "not trained on these views together"),
        ({"images": images | {"head": images["head"][:8]}}, DataError, "RGB and of one size"),
        ({"images": images | {"head": images["head"] / 255}}, DataError, "arrays of uint8"),
        (
            {"cameras": {}},
            DataError,
            "No camera of the view head, left_wrist, right_wrist: the model takes action maps",
        ),
        ({"embodiment": "ur55_pair"}, ConfigError, "Unknown embodiment"),
        *(({"controls": wrong}, DataError, "beyond its|array of numbers") for wrong in beyond),
        *(({"seed": seed}, DataError, "Not a seed") for seed in (1.5, True, "1", -1)),
    ):
        usual = {"images": images, "controls": controls, "cameras": observed.cameras, "embodiment": ROBOT}
        with pytest.raises(error, match=f"(?s){message}"):
            causal.predict(**usual | changes)
    with pytest.raises(CheckpointError, match="tokenizer is not here"):
        WorldLine.from_pretrained(models / "causal", tokenizer=tmp_path / "none")
    with pytest.raises(CheckpointError, match=r"(?s)wrong kind.*stage2 or causal.*base"):
        WorldLine.from_pretrained(models / "base")
    with pytest.raises(CheckpointError, match="Only a causal model goes block by block"):
        WorldLine.from_pretrained(models / "stage2").simulator([42])


def test_a_name_that_the_package_lacks_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'Simulator'"):
        __import__("worldline_core").Simulator  # noqa: B018
