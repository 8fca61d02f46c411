"""Rollouts of the views that there are, and of any length: whole recordings, chains of clips, strides."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from tests.rollout.conftest import SIZE, write_recordings  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import WorldLineEnv
from worldline_core.errors import CheckpointError, DataError
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.model.world_model_config import TrainedClips
from worldline_core.rollout.observation import Camera
from worldline_core.rollout.predictions import plan_predictions
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import FullClipConfig, RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.rollout.worldline import WorldLine

HEAD, RIGHT = ("head",), ("head", "right_wrist")
SETS = (HEAD, VIEWS, RIGHT)
EPISODES = (
    ("three", "test", 33, VIEWS, VIEWS),
    ("two", "test", 33, RIGHT, RIGHT),
    ("one", "test", 33, HEAD, HEAD),
    ("uncalibrated-wrist", "test", 33, RIGHT, HEAD),
    ("long", "test", 70, VIEWS, VIEWS),
    ("no-head", "test", 33, VIEWS[1:], VIEWS[1:]),
    ("no-camera", "test", 33, HEAD, VIEWS[1:]),
    ("short", "test", 9, VIEWS, VIEWS),
)
CONFIG = RolloutConfig(method="causal", batch_size=8, bfloat16=False)


@pytest.fixture(scope="module")
def mixed(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of several sets of views and lengths, some of which cannot be predicted, and a model of three sets."""
    root = tmp_path_factory.mktemp("mixed")
    return inputs | write_recordings(root, EPISODES) | {"checkpoint": trained_on(inputs, root / "sets", SETS)}


def trained_on(inputs: dict[str, Path], folder: Path, view_sets: Sequence[tuple[str, ...]]) -> Path:
    """The causal model as one that saw these sets of views."""
    model, info = load_checkpoint(inputs["checkpoint"])
    trained = TrainedClips(view_sets=tuple(view_sets), strides=(1,))
    save_checkpoint(folder, model, kind="causal", action_contract=info.contract, causal=info.causal, trained=trained)
    return folder


@pytest.fixture(scope="module")
def predicted(mixed: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    output = tmp_path_factory.mktemp("predicted")
    return output, rollout(CONFIG, mixed, output)


def test_every_recording_is_predicted_in_its_views_or_left_out_with_a_reason(predicted: tuple[Path, dict]) -> None:
    output, summary = predicted
    rollouts = RolloutSet.open(output)
    views = {name: tuple(view for view in VIEWS if view in rollouts.views(name)) for name in rollouts.episode_ids}
    assert views == {"long": VIEWS, "one": HEAD, "three": VIEWS, "two": RIGHT, "uncalibrated-wrist": HEAD}
    assert summary["left_out"] == {"missing_view": 1, "missing_calibration": 1, "too_short": 1}
    assert summary["without_view"] == {"left_wrist": 3, "right_wrist": 2}
    rows = {row.episode_id: row for row in read_quarantine(output)}
    assert {name: row.reason for name, row in rows.items()} == {
        "no-head": "missing_view", "no-camera": "missing_calibration", "short": "too_short",
    }  # fmt: skip
    assert rows["no-head"].detail == "no video of head; there are left_wrist, right_wrist"
    assert len(rollouts.episode_ids) + len(rows) == len(EPISODES)


def test_a_prediction_does_not_depend_on_whose_views_share_the_run(
    mixed: dict[str, Path], predicted: tuple[Path, dict], tmp_path: Path
) -> None:
    rollout(CONFIG.model_copy(update={"batch_size": 1}), mixed, tmp_path)
    together, alone = RolloutSet.open(predicted[0]), RolloutSet.open(tmp_path)
    for row in together.rows:
        pair = [part.frames(row.episode_id, row.view).astype(int) for part in (together, alone)]
        # Single precision rounds sums of another batch size otherwise, at most by one grey level here.
        assert np.abs(pair[0] - pair[1]).max() <= 1, row
        assert np.abs(pair[0] - pair[1]).mean() < 1e-3


def test_the_views_that_are_asked_for_are_predicted_alone(mixed: dict[str, Path], tmp_path: Path) -> None:
    summary = rollout(CONFIG.model_copy(update={"views": ("right_wrist", "head")}), mixed, tmp_path)
    rollouts = RolloutSet.open(tmp_path)
    assert {name: set(rollouts.views(name)) for name in rollouts.episode_ids} == {
        name: set(RIGHT) for name in ("long", "three", "two")
    }
    assert summary["left_out"] == {"missing_view": 3, "missing_calibration": 1, "too_short": 1}
    for wrong in (("right_wrist",), ("head", "left_wrist"), ("head", "exterior_2"), ()):
        with pytest.raises(
            DataError, match=r"(?s)trained on these views together.*rollout\.views.*or head \+ right_wrist or"
        ):
            rollout(CONFIG.model_copy(update={"views": wrong}), mixed, tmp_path / "wrong")
    with pytest.raises(DataError, match=r"(?s)No episode can be predicted.*1 left out.*no video of head"):
        rollout(CONFIG, mixed | write_recordings(tmp_path / "none", EPISODES[5:6]), tmp_path / "none" / "out")


def test_a_model_trained_on_the_head_alone_predicts_the_head_alone(
    inputs: dict[str, Path], mixed: dict[str, Path], tmp_path: Path
) -> None:
    summary = rollout(CONFIG, mixed | {"checkpoint": trained_on(inputs, tmp_path / "head", [HEAD])}, tmp_path / "out")
    assert {row.view for row in RolloutSet.open(tmp_path / "out").rows} == {"head"}
    assert "without_view" not in summary
    world = WorldLine.from_pretrained(tmp_path / "head", tokenizer=inputs["tokenizer"])
    assert (world.views, world.info.strides) == (HEAD, (1,))
    with pytest.raises(CheckpointError, match=r"trained.view_sets: \['exterior_2'\] are none of the model's views"):
        trained_on(inputs, tmp_path / "other", [("exterior_2",)])


def test_views_that_were_not_trained_together_are_refused_everywhere(
    inputs: dict[str, Path], mixed: dict[str, Path], tmp_path: Path
) -> None:
    """A model of all views, and one that saw the head alone besides: at every door but the rollout step's."""
    summary = rollout(CONFIG, mixed | {"checkpoint": inputs["checkpoint"]}, tmp_path / "out")
    assert {row.episode_id for row in RolloutSet.open(tmp_path / "out").rows} == {"three", "long"}
    assert summary["left_out"] == {"missing_view": 5, "too_short": 1}
    images = {view: np.zeros((*SIZE, 3), np.uint8) for view in VIEWS}
    camera = Camera(np.array([[40.0, 0, SIZE[1] / 2], [0, 40, SIZE[0] / 2], [0, 0, 1]]), np.eye(4))
    for name, sets, wrong in (
        ("all", [VIEWS], HEAD), ("all", [VIEWS], RIGHT), ("both", [VIEWS, HEAD], RIGHT), ("one", [HEAD], VIEWS),
    ):  # fmt: skip
        folder = trained_on(inputs, tmp_path / name, sets)
        world = WorldLine.from_pretrained(folder, tokenizer=inputs["tokenizer"], bfloat16=False)
        shown, cameras = {view: images[view] for view in wrong}, dict.fromkeys(wrong, camera)
        doors: dict[Callable[..., Any], tuple[Any, ...]] = {
            partial(world.predict, embodiment="ur5e_silver"): (shown, np.zeros((17, 14)), cameras),
            partial(world.start, embodiment="ur5e_silver", state=np.zeros(14)): (shown, cameras),
            world.session: (torch.zeros(1, len(wrong), 3, *SIZE), [0], wrong),
            world.simulator: ([0], wrong),
            partial(WorldLineEnv, model=world, views=wrong): (),
        }
        for door, arguments in doors.items():
            with pytest.raises(DataError, match=r"(?s)not trained on these views together.*expected:.*head"):
                door(*arguments)


def test_a_view_keeps_its_slot_whichever_others_are_there(inputs: dict[str, Path]) -> None:
    """With cross-view attention switched off by distance nothing may move: the same vector and offset per view name."""
    model, _ = load_checkpoint(inputs["checkpoint"])
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(1, 3, 8, 2, 4, 6, generator=generator)
    level = torch.tensor([0.5])
    swapped = latents[:, [2, 0]]
    pair = model(latents[:, [0, 2]], level, views=RIGHT).velocity
    other = model(swapped, level, views=RIGHT[::-1]).velocity
    torch.testing.assert_close(pair, other[:, [1, 0]], rtol=1e-4, atol=1e-5)
    wrong = model(latents[:, [0, 2]], level, views=VIEWS[:2]).velocity
    assert not torch.allclose(pair, wrong, atol=1e-3)


def test_whole_recordings_are_predicted_to_their_end(mixed: dict[str, Path], tmp_path: Path) -> None:
    summary = rollout(CONFIG.model_copy(update={"num_frames": "whole", "crf": 0}), mixed, tmp_path)
    rollouts = RolloutSet.open(tmp_path)
    counts = {row.episode_id: row.num_frames for row in rollouts.rows}
    assert counts == {name: n for name, _, n, *_ in EPISODES if name not in ("no-head", "no-camera")}
    assert rollouts.frames("long", "head").shape == (70, *SIZE, 3)
    # 70 = 1 + 5 blocks of 16 less 11; 9 = 1 + 1 block less 8: what lies after the end is cut off, and said.
    assert summary["cut_frames"] == 11 + 8
    assert summary["left_out"] == {"missing_view": 1, "missing_calibration": 1}
    shorter = RolloutSet.open(
        _rolled(CONFIG.model_copy(update={"num_frames": 65, "crf": 0}), mixed, tmp_path / "numbered")
    )
    difference = shorter.frames("long", "head").astype(int) - rollouts.frames("long", "head")[:65]
    assert np.abs(difference).max() <= 1  # the same blocks, sampled beside others


def _rolled(config: RolloutConfig, inputs: dict[str, Path], output: Path) -> Path:
    rollout(config, inputs, output)
    return output


def test_stage2_goes_on_where_its_last_clip_ended(mixed: dict[str, Path], inputs: dict[str, Path]) -> None:
    """A chain is what one gets by predicting again from the last picture, with the noise going on."""
    checkpoint = inputs["checkpoint"].parent / "stage2"
    options = {"tokenizer": inputs["tokenizer"], "bfloat16": False, "steps": 2}
    world = WorldLine.from_pretrained(checkpoint, clip_frames=17, **options)
    episodes, tracks = EpisodeSet.open(mixed["episodes"]), ActionTracks.open(mixed["tracks"]).tracks("long")
    position = episodes.position("long")
    images = torch.stack([frames_to_video(episodes.frames(position, view, [0]))[:, 0] for view in VIEWS])[None]

    def pieces(world: WorldLine, frames: int) -> list[np.ndarray]:
        return [clips[0]["head"] for clips in world.stream(images, [tracks], frames, [42])]

    chained = pieces(world, 40)
    assert [len(piece) for piece in chained] == [1, 16, 16, 7]
    first = pieces(WorldLine.from_pretrained(checkpoint, **options), 17)
    assert np.array_equal(np.concatenate(chained)[:17], np.concatenate(first))
    session = world.session(images, [42])
    last = session.step(world.action_maps([tracks], range(0, 17, 4), views=VIEWS))[0]
    again = world.session(torch.stack([frames_to_video(last[view][-1:])[:, 0] for view in VIEWS])[None], [42])
    again._sampler._noise = session._sampler._noise  # type: ignore[attr-defined]
    maps = world.action_maps([tracks], range(16, 33, 4), views=VIEWS)
    assert np.array_equal(again.step(maps)[0]["head"], chained[2])
    with pytest.raises(ValidationError, match=r"clip_frames\n.*1 \+ a multiple of 4"):
        FullClipConfig(clip_frames=16)


def test_a_causal_rollout_begins_anew_at_its_own_picture_every_few_blocks(
    mixed: dict[str, Path], inputs: dict[str, Path]
) -> None:
    """With anchors every two blocks, the third block is the first one of a rollout from the last picture of the second."""
    world = WorldLine.from_pretrained(inputs["checkpoint"], tokenizer=inputs["tokenizer"], bfloat16=False)
    free = list(_causal_pieces(world, mixed, 65))
    world.causal = world.causal.model_copy(update={"anchor_blocks": 2})
    pieces = list(_causal_pieces(world, mixed, 65))
    assert [len(piece["head"]) for piece in pieces] == [1, 16, 16, 16, 16]
    for view in VIEWS:
        assert all(np.array_equal(pieces[block][view], free[block][view]) for block in range(3))
        assert not np.array_equal(pieces[3][view], free[3][view])
    tracks = ActionTracks.open(mixed["tracks"]).tracks("long")
    last = torch.stack([frames_to_video(pieces[2][view][-1:])[:, 0] for view in VIEWS])[None]
    session = world.session(last, [42])
    for _ in range(2):  # the noise goes on
        session._sampler.noise.draw((3, world.model.config.latent_channels, 4, *world.contract.grid_size))  # type: ignore[union-attr]
    for block in (3, 4):
        maps = world.action_maps([tracks], range(16 * (block - 1), 16 * block + 1, 4), views=VIEWS)
        assert np.array_equal(session.step(maps)[0]["head"], pieces[block]["head"])


def _causal_pieces(world: WorldLine, mixed: dict[str, Path], frames: int) -> Iterator[dict[str, np.ndarray]]:
    episodes, tracks = EpisodeSet.open(mixed["episodes"]), ActionTracks.open(mixed["tracks"]).tracks("long")
    position = episodes.position("long")
    images = torch.stack([frames_to_video(episodes.frames(position, view, [0]))[:, 0] for view in VIEWS])[None]
    return (clips[0] for clips in world.stream(images, [tracks], frames, [42]))


def test_strides_are_those_of_the_training(inputs: dict[str, Path], mixed: dict[str, Path], tmp_path: Path) -> None:
    strided = CONFIG.model_copy(update={"stride": 2, "num_frames": "whole"})
    with pytest.raises(CheckpointError, match=r"(?s)not trained at this stride.*\(1,\).*got: 2"):
        rollout(strided, mixed, tmp_path / "refused")
    model, info = load_checkpoint(inputs["checkpoint"])
    trained = TrainedClips(view_sets=(VIEWS,), strides=(1, 2))
    save_checkpoint(
        tmp_path / "model", model, kind="causal", action_contract=info.contract, causal=info.causal, trained=trained
    )
    rollout(strided.model_copy(update={"crf": 0}), mixed | {"checkpoint": tmp_path / "model"}, tmp_path / "out")
    rollouts = RolloutSet.open(tmp_path / "out")
    assert rollouts.fps == 4.0
    found = rollouts.frames("long", "head").astype(int)
    assert len(found) == 35
    # Every second control of the recording is what a recording at half the rate would hold.
    world = WorldLine.from_pretrained(tmp_path / "model", tokenizer=inputs["tokenizer"], bfloat16=False)
    episodes, tracks = EpisodeSet.open(mixed["episodes"]), ActionTracks.open(mixed["tracks"]).tracks("long")
    position = episodes.position("long")
    images = torch.stack([frames_to_video(episodes.frames(position, view, [0]))[:, 0] for view in VIEWS])[None]

    def difference(frames: range) -> float:
        clips = world.stream(images, [tracks.clip(frames)], 35, list(CONFIG.seeds))
        return float(np.abs(np.concatenate([clip["head"] for (clip,) in clips]).astype(int) - found).mean())

    # The colours of the stored video are rounded.
    assert difference(range(0, 70, 2)) < 0.5
    assert difference(range(35)) > 1


def test_recordings_of_another_rate_are_left_out(mixed: dict[str, Path]) -> None:
    episodes, tracks = EpisodeSet.open(mixed["episodes"]), ActionTracks.open(mixed["tracks"])
    other = episodes.position("two")
    episodes.rows[other] = replace(episodes.rows[other], fps=5.0)
    chosen = [episodes.position(name) for name in ("three", "two")]

    class Any3:
        views: tuple[str, ...] = VIEWS
        view_sets = SETS
        frames_per_unit, takes_maps = 16, True
        vector_robots: tuple[str, ...] | None = ()

        def unit(self, frames: int) -> int:
            return 16

    planned, left_out = plan_predictions(CONFIG, episodes, tracks, chosen, Any3(), 8.0)
    assert [item.episode_id for item in planned] == ["three"]
    assert Counter(row.reason for row in left_out) == {"wrong_fps": 1}
