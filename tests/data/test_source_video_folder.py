"""Plain videos with captions beside them, written here with PyAV alone, from the folder to the clips of Stage I."""

from __future__ import annotations

import csv
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tests.data import curating
from tests.data.conftest import make_sample
from tests.data.curating import reasons, record, run
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.sources.video_folder import caption_table
from worldline_core.data.video.clip import frame_times
from worldline_core.errors import DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig

HEIGHT, WIDTH, FRAMES, RATE = 64, 96, 33, 16


def pictures(seed: int, count: int = FRAMES, *, moving: bool = True) -> np.ndarray:
    """A textured table that stands still; over it two blocks move on their own ways."""
    random = np.random.default_rng(seed)
    coarse = random.integers(60, 200, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    frames = np.repeat(np.repeat(np.tile(coarse, (count, 1, 1, 1)), 8, 1), 8, 2)
    for n in range(count if moving else 0):
        left, top = int(30 + 25 * np.sin(0.35 * n + seed)), int(24 + 18 * np.cos(0.25 * n))
        frames[n, top : top + 16, left : left + 16] = (230, 40, 30)
        frames[n, 48 - top // 2 : 60 - top // 2, 90 - left : 102 - left] = (20, 60, 220)
    return frames


def write_video(path: Path, frames: np.ndarray, times: list[int] | None = None) -> None:
    """With B frames, so that file order is not the order of presentation; `times` in ticks of 1/(10 rate)."""
    ticks = times or [10 * n for n in range(len(frames))]
    options = {"bf": "2", "crf": "12"}
    curating.write_video(path, frames, rate=RATE, options=options, times=ticks, tick=Fraction(1, 10 * RATE))


def settings(root: Path) -> dict[str, Any]:
    return {"kind": "video_folder", "path": str(root), "name": "web", "split": "train"}


def test_videos_with_captions_beside_them_come_through(tmp_path: Path) -> None:
    root = tmp_path / "raw"
    write_video(root / "kitchen" / "one.mp4", pictures(1))
    (root / "kitchen" / "one.txt").write_text("  pour the\n tea ")
    write_video(root / "two.MP4", pictures(2, 20))
    counts, curated = run(tmp_path, settings(root))
    assert (counts["found"], counts["splits"]) == (2, {"train": 2})
    one, two = curated.rows
    assert (one.episode_id, one.scene, one.instruction) == ("web-kitchen-one", "web-kitchen", "pour the tea")
    assert (two.episode_id, two.scene, two.instruction) == ("web-two", "web", "")
    assert (one.fps, one.num_frames, two.num_frames, one.views) == (RATE, FRAMES, 20, ("head",))
    assert (one.stage1_ok, one.stage2_ok, one.stage2_reason) == (True, False, "missing_actions")
    episode = curated.episode(0)
    assert (episode.state_kind, episode.state.shape, episode.action.shape) == ("none", (FRAMES, 0), (FRAMES, 0))
    # In order of presentation, although the file is not.
    found = curated.frames(0, "head").astype(int)
    assert np.abs(found - pictures(1)).mean() < 6
    assert all(np.abs(found[n] - pictures(1)[n]).mean() < np.abs(found[n] - pictures(1)[n - 1]).mean() for n in (5, 20))
    # The set has no empty columns, and opens in LeRobot's terms.
    meta = curated.root / "datasets/unspecified/meta"
    features = json.loads((meta / "info.json").read_text())["features"]
    assert not {"observation.state", "action"} & {*features, *json.loads((meta / "stats.json").read_text())}
    contract = json.loads((meta / "worldline/contract.json").read_text())
    assert (contract["state_kind"], contract["action"]) == ("none", "none")


@pytest.mark.slow
@pytest.mark.timeout(600)  # importing LeRobot alone takes minutes on a busy machine
def test_lerobots_own_class_reads_a_set_without_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    write_video(tmp_path / "raw" / "one.mp4", pictures(1))
    counts, _ = run(tmp_path, settings(tmp_path / "raw"))
    assert counts["videos"]["copied"] == 1  # with its frames stored out of order
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    opened: Any = LeRobotDataset("local/set", root=tmp_path / "out/datasets/unspecified", video_backend="pyav")
    assert len(opened) == FRAMES
    shown = curating.plain_frames(tmp_path / "raw" / "one.mp4")
    for n in (0, 7, 14, FRAMES - 1):
        pixels = (opened[n]["observation.images.head"].permute(1, 2, 0).numpy() * 255).round()
        assert np.array_equal(pixels, shown[n])


@pytest.mark.parametrize("suffix", [".jsonl", ".csv"])
def test_captions_may_be_in_one_table(tmp_path: Path, suffix: str) -> None:
    rows = [
        {"clip": "kitchen/one.mp4", "text": 'pour, "slowly"', "n": "1"},
        {"clip": "./2", "text": "wipe  it", "n": "2"},
    ]
    path = tmp_path / f"captions{suffix}"
    if suffix == ".jsonl":
        path.write_text("\n".join(json.dumps(row) for row in rows) + "\n\n")
    else:
        with path.open("w", newline="", encoding="utf-8-sig") as stream:
            writer = csv.DictWriter(stream, ["clip", "text", "n"])
            writer.writeheader()
            writer.writerows(rows)
    assert caption_table(path, "clip", "text") == {"kitchen/one.mp4": 'pour, "slowly"', "2": "wipe it"}
    with pytest.raises(DataError, match="captions cannot be read"):
        caption_table(path, "video", "text")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("captions.jsonl", "{"),
        ("captions.jsonl", "3"),
        ("captions.jsonl", '{"video": "a.mp4", "caption": "x"}\n{"video": "a.mp4", "caption": "y"}'),
        ("captions.jsonl", '{"video": "a.mp4"}'),
        ("captions.jsonl", '{"video": "a.mp4", "caption": 3}'),
        ("captions.jsonl", '{"video": ' + "[" * 1_000_000),
        ("captions.csv", "video,caption\na.mp4"),
        ("captions.csv", ""),
        ("captions.xlsx", ""),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match="captions cannot be read"):
        caption_table(tmp_path / name, "video", "caption")


def test_what_is_no_usable_video_is_quarantined_and_the_rest_goes_on(tmp_path: Path) -> None:
    root = tmp_path / "raw"
    write_video(root / "good.mp4", pictures(1))
    (root / "good.txt").write_text("push")
    write_video(root / "silent.mp4", pictures(4))
    write_video(root / "late.mp4", pictures(2, 20), [10 * n + (40 if n > 9 else 0) for n in range(20)])
    (root / "late.txt").write_text("push")
    content = (root / "good.mp4").read_bytes()
    for name, cut in (("empty", b""), ("garbage", bytes(range(256)) * 8), ("cut", content[: len(content) // 2])):
        (root / f"{name}.mp4").write_bytes(cut)
        (root / f"{name}.txt").write_text("push")
    (root / "strange.mp4").write_bytes(content[::1])
    (root / "strange.txt").write_bytes(b"\xff\xfe\xfa")
    (tmp_path / "secret.mp4").write_bytes(content)
    (root / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    # Paths that would share an id are told apart.
    write_video(root / "a-b" / "c.mp4", pictures(5))
    write_video(root / "a" / "b-c.mp4", pictures(6))
    counts, curated = run(tmp_path, settings(root))
    assert (counts["found"], counts["kept"], len({row.episode_id for row in curated.rows})) == (10, 4, 4)
    found = {name.removeprefix("web-"): reason for name, reason in reasons(curated).items()}
    assert found.pop("garbage") in ("unreadable", "truncated_video")
    assert found == {
        "late": "wrong_fps", "empty": "truncated_video", "cut": "truncated_video", "strange": "unreadable",
        "link": "path_traversal",
    }  # fmt: skip


def test_frame_times_are_those_of_decoding(tmp_path: Path) -> None:
    write_video(tmp_path / "one.mp4", pictures(3, 21))
    with av.open(str(tmp_path / "one.mp4")) as container:
        decoded = [frame.time for frame in container.decode(video=0)]
    assert np.allclose(frame_times(tmp_path / "one.mp4"), np.asarray(decoded) - decoded[0], atol=1e-9)


def test_a_state_without_columns_is_none_and_only_that() -> None:
    for width, kind in ((0, "joints"), (1, "none")):
        values = np.zeros((9, width), np.float32)
        with pytest.raises(DataError, match="State has"):
            make_sample(state=values, action=values, state_names=None, state_kind=kind)


def test_from_a_folder_of_videos_to_the_clips_of_stage_1(tmp_path: Path, project_root: Path) -> None:
    """Together with a robot's recording: Stage I takes both, Stage II and the action tracks the robot's alone."""
    import torch

    from worldline_core.training.clip_config import EncodeLatentsConfig
    from worldline_core.training.clip_source import LatentStore, training_rows
    from worldline_core.training.encode_latents import encode_latents

    torch.set_num_threads(1)
    root, robot = tmp_path / "raw", tmp_path / "robot"
    write_video(root / "moving.mp4", pictures(1))
    (root / "moving.txt").write_text("push the red block")
    write_video(root / "still.mp4", pictures(2, moving=False))
    record(robot, [make_sample(0, num_frames=FRAMES, height=HEIGHT, width=WIDTH)])
    counts, episodes = run(tmp_path, settings(root), {"kind": "episode_set", "path": str(robot)})
    assert counts["kept"] == 3

    counts = filter_episodes(FilterConfig(), {"episodes": episodes.root}, tmp_path / "filtered")
    assert counts["reasons"].get("static") == 1
    rows = {row.episode_id: row for row in EpisodeSet.open(tmp_path / "filtered").rows}
    assert (rows["web-moving"].stage1_ok, rows["web-moving"].stage2_reason) == (True, "missing_actions")

    rendered = render_actions(RenderActionsConfig(previews=0), {"episodes": episodes.root}, tmp_path / "tracks")
    assert (rendered["found"], rendered["kept"]) == (3, 1)
    assert rendered["quarantine_reasons"] == {"missing_actions": 2}

    tokenizer = project_root / "artifacts" / "shipped" / "models" / "tokenizer"
    inputs = {"episodes": episodes.root, "tokenizer": tokenizer}
    encode_latents(EncodeLatentsConfig(), inputs, tmp_path / "latents")
    store = LatentStore.open(tmp_path / "latents")
    assert store.row("web-moving").views == ("head",)
    assert len(store.row("episode-000").views) == 3
    assert {row.episode_id for row in training_rows(store, episodes, stage=2, views=("head",))} == {"episode-000"}
    assert len(training_rows(store, episodes, stage=1)) == 3
