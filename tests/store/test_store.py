"""The store: content keys, atomic finish, continuation after a kill, verification."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from safetensors import safe_open

from tasks.execution.artifact_task import find_task
from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.store import store as store_module
from worldline_core.store.artifact_files import digest_file, digest_folder, digest_value, find_damage
from worldline_core.store.atomic import atomic_path, write_arrays_atomic, write_bytes_atomic, write_json_atomic
from worldline_core.store.store import ArtifactStore, folder_lock


class CountConfig(StrictModel):
    upto: int = 5
    seed: int = 7


def count(config: CountConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Writes one file a number and skips those that are there: a step that continues."""
    written = 0
    for number in range(config.upto):
        path = output / f"{number}.txt"
        if not path.exists():
            write_bytes_atomic(path, str(number).encode())
            written += 1
    (output / "run").mkdir(exist_ok=True)
    (output / "run" / "timing.txt").write_text(str(time.time()))
    return {"written": written}


def test_a_finished_artifact_is_found_again_until_its_manifest_is_gone_or_damaged(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    first, second = (store.run("count", 1, count, CountConfig(), {}) for _ in range(2))
    assert (first.cached, second.cached) == (False, True)
    assert (second.path, second.digest) == (first.path, first.digest)
    assert digest_folder(second.path) == second.digest
    (first.path / "manifest.json").unlink()
    again = store.run("count", 1, count, CountConfig(), {})
    assert (again.cached, again.digest) == (False, first.digest)
    (again.path / "manifest.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"JSON file is damaged[\s\S]*manifest.json"):
        store.find("count", again.key)
    with pytest.raises(ArtifactError, match="does not exist"):
        store.run("count", 1, count, CountConfig(), {"episodes": tmp_path / "none"})


def test_the_last_artifact_of_a_call_has_a_link_by_name(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    made = [store.linked("count.a", store.run("count", 1, count, CountConfig(upto=n), {})) for n in (1, 2)]
    assert (tmp_path / "latest" / "count.a").resolve() == made[1].path
    assert not (tmp_path / "latest" / "count.a").readlink().is_absolute()  # a store may be moved
    (tmp_path / "latest" / "count.b").mkdir()
    store.linked("count.b", made[0])  # in the way: the artifact counts, not the link
    assert sorted(path.name for path in (tmp_path / "latest").iterdir()) == ["count.a", "count.b"]


def test_key_depends_on_everything_that_matters(tmp_path: Path) -> None:
    key = ArtifactStore(tmp_path).key
    base = "count", 1, CountConfig(), {"a": "x"}
    others = (
        ("recount", *base[1:]),
        ("count", 2, *base[2:]),
        (*base[:2], CountConfig(upto=6), base[3]),
        (*base[:3], {"a": "y"}),
    )
    assert len({key(*each) for each in (base, *others)}) == 5
    assert key(*base) == key("count", 1, CountConfig(), {"a": "x"})


class JudgedConfig(CountConfig):
    weights: Path | None = None

    def weights_read(self) -> Mapping[str, Path | None]:
        return {"judge": self.weights}


def test_weights_count_with_their_content_and_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    digest = store_module.digest_file
    monkeypatch.setattr(store_module, "digest_file", lambda path: read.append(path.name) or digest(path))
    store, blobs, folder = ArtifactStore(tmp_path / "store"), tmp_path / "blobs", tmp_path / "weights"
    config = JudgedConfig(weights=folder)
    absent = store.key("judge", 1, config, {})
    # As the hub's cache lays them out: links to files, and notes that change with every download.
    for path in (blobs, folder / ".cache"):
        path.mkdir(parents=True)
    (blobs / "1f").write_bytes(b"one")
    (folder / "model.safetensors").symlink_to(blobs / "1f")
    (folder / "config.json").write_text("{}")
    first = store.key("judge", 1, config, {})
    (folder / ".cache" / "note").write_text("now")
    assert store.key("judge", 1, config, {}) == first != absent
    assert ArtifactStore(store.root).key("judge", 1, config, {}) == first
    assert sorted(read) == ["config.json", "model.safetensors"]
    (blobs / "1f").write_bytes(b"two")
    assert store.key("judge", 1, config, {}) not in (first, absent)
    (folder / "model.safetensors").rename(folder / "other.safetensors")
    (blobs / "1f").write_bytes(b"one")
    assert store.key("judge", 1, config, {}) not in (first, absent)
    file = JudgedConfig(weights=blobs / "1f")
    alone = store.key("judge", 1, file, {})
    (blobs / "1f").write_bytes(b"three")
    assert store.key("judge", 1, file, {}) != alone


def test_steps_name_the_weights_and_tokenizers_that_they_read(tmp_path: Path) -> None:
    named = {"sam3_weights": "sam3", "vlm": {"weights": "qwen"}}

    def read(step: str, values: dict[str, Any]) -> dict[str, Path]:
        config = find_task(step).load_config().model_validate(values)
        return {name: path for name, path in config.weights_read().items() if path is not None}

    sam3, vlm = {"sam3": Path("sam3")}, {"vlm": Path("qwen")}
    for step, judge in (("evaluate_policy", "judge"), ("evaluate_planning", "selector")):
        assert read(step, named) == read(step, {**named, judge: "openai"}) == {}
        assert read(step, {**named, "segmenter": "sam3"}) == sam3
        assert read(step, {**named, "segmenter": "sam3", judge: "qwen3_vl"}) == vlm
    assert read("evaluate_video", {"sam3_weights": "sam3"}) == {}
    both = {"sam3_weights": "sam3", "lpips_weights": "alex", "segmenters": ["learned", "sam3"]}
    assert read("evaluate_video", both) == sam3 | {"lpips": Path("alex")}
    assert read("distill", {"lpips_weights": "alex", "clips": {"lengths": [17]}}) == {"lpips": Path("alex")}
    trainer = {"trainer": {"steps": 1}}
    assert read("train_stage1", trainer) == {}
    assert read("train_stage1", {**trainer, "text": {"kind": "cosmos3", "path": "qwen"}}) == {"text": Path("qwen")}
    baseline = {"method": "backbone", "sampler": {"kind": "text_to_video"}, "num_frames": 17}
    assert read("rollout", {"sampler": {"kind": "text_to_video", "text": {"kind": "cosmos3", "path": "qwen"}}}) == {
        "text": Path("qwen")
    }
    assert read("rollout", baseline) == {}


@pytest.mark.parametrize("killed", [False, True])
def test_an_interrupted_step_leaves_no_artifact_and_continues_to_the_same_digest(tmp_path: Path, killed: bool) -> None:
    store = ArtifactStore(tmp_path)

    def begin(config: CountConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
        count(CountConfig(upto=2), inputs, output)
        (output / "videos").mkdir()
        (output / "videos" / ".head.123.tmp.mp4").write_bytes(b"half")  # does not reach the artifact
        if killed:
            os.kill(os.getpid(), signal.SIGKILL)
        raise DataError("stopped", where="halfway")

    arguments: Any = ("count", 1, begin, CountConfig(), {})
    if killed:
        process = multiprocessing.get_context("fork").Process(target=store.run, args=arguments)
        process.start()
        process.join()
    else:
        with pytest.raises(DataError, match="stopped"):
            store.run(*arguments)
    assert store.find("count", store.key("count", 1, CountConfig(), {})) is None
    assert len(list(tmp_path.glob("count/*.partial/1.txt"))) == 1
    artifact = store.run("count", 1, count, CountConfig(), {})
    manifest = json.loads((artifact.path / "manifest.json").read_text())
    facts = [manifest[name] for name in ("resumed", "metrics", "seeds")]
    assert facts == [True, {"written": 3}, {"seed": 7}]
    undisturbed = ArtifactStore(tmp_path / "other").run("count", 1, count, CountConfig(), {})
    assert undisturbed.digest == artifact.digest
    assert not list(tmp_path.glob("count/*.partial"))


@pytest.mark.parametrize(
    "changes",
    [{"files": ["a"]}, {"files": {"a": 7}}, {"digest": 7}, {"metrics": []}, {"inputs": {"a": "b"}}, {"config": None}],
)
def test_a_manifest_of_another_form_is_one_message(tmp_path: Path, changes: dict[str, Any]) -> None:
    """As an earlier version, or somebody else, may have written it; its own digest fits."""
    store = ArtifactStore(tmp_path)
    artifact = store.run("count", 1, count, CountConfig(), {})
    path = artifact.path / "manifest.json"
    content = {**json.loads(path.read_text()), **changes}
    del content["manifest_sha256"]
    path.write_text(json.dumps({**content, "manifest_sha256": digest_value(content)}))
    with pytest.raises(ArtifactError, match=rf"another form[\s\S]*{next(iter(changes))}[\s\S]*next step"):
        store.run("count", 1, count, CountConfig(), {})
    assert len(find_damage(artifact.path)) == 1


def test_a_clock_that_is_set_back_gives_no_negative_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10**9, 0, -1000))
    monkeypatch.setattr(time, "time", lambda: next(clock))
    artifact = ArtifactStore(tmp_path).run("count", 1, count, CountConfig(), {})
    assert json.loads((artifact.path / "manifest.json").read_text())["wall_seconds"] >= 0


def test_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "secret").write_text("s")
    (folder / "link").symlink_to(tmp_path / "secret")
    with pytest.raises(ArtifactError, match="leads out of the folder"):
        digest_folder(folder)


def test_arrays_come_back_as_they_were_however_their_memory_lies(tmp_path: Path) -> None:
    array = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    arrays = {"transposed": array.transpose(2, 0, 1), "every second": array[:, :, ::2], "one": np.array(7, np.float32)}
    write_arrays_atomic(tmp_path / "x.safetensors", arrays)
    with safe_open(tmp_path / "x.safetensors", framework="numpy") as file:
        for name, expected in arrays.items():
            np.testing.assert_array_equal(file.get_tensor(name), expected)


def test_atomic_write_leaves_nothing_behind_on_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no space"), atomic_path(tmp_path / "x.txt") as temporary:
        temporary.write_text("half")
        raise ConfigError("no space")
    assert list(tmp_path.iterdir()) == []


def test_json_is_canonical(tmp_path: Path) -> None:
    write_json_atomic(tmp_path / "a.json", {"b": 1, "a": [2.5, None]})
    write_json_atomic(tmp_path / "b.json", {"a": [2.5, None], "b": 1})
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert digest_value({"b": 1, "a": 2}) == digest_value({"a": 2, "b": 1})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json_atomic(tmp_path / "c.json", {"a": float("nan")})


def test_two_commands_do_not_write_into_one_folder(tmp_path: Path) -> None:
    from worldline_core.exports.export import export
    from worldline_core.shipped import shipped_folder

    with folder_lock(tmp_path / "out"), pytest.raises(ArtifactError, match="Another command writes into this folder"):
        export(shipped_folder() / "recordings", tmp_path / "out", ["mcap"])
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["run"]


def put(path: Path) -> None:
    path.parent.mkdir(parents=True)
    path.write_text("")


def link(path: Path, target: Path) -> None:
    path.parent.mkdir(parents=True)
    path.symlink_to(target, target_is_directory=True)


ODD: dict[str, Callable[[Path, str], object]] = {
    "a lock that is a folder": lambda step, key: (step / f".{key}.lock").mkdir(parents=True),
    "unfinished work that is a file": lambda step, key: put(step / f"{key}.partial"),
    "an artifact that is a file": lambda step, key: put(step / key),
    "a link to itself": lambda step, key: link(step / key, step / key),
    "a step that is a file": lambda step, key: put(step),
    "a step that is a link": lambda step, key: link(step, step.parents[1]),
}


@pytest.mark.parametrize("make", ODD.values(), ids=ODD)
def test_an_odd_store_ends_in_one_message(tmp_path: Path, make: Callable[[Path, str], None]) -> None:
    store = ArtifactStore(tmp_path / "store")
    make(store.root / "count", store.key("count", 1, CountConfig(), {}))
    with pytest.raises(ArtifactError, match=r"cannot be used|link out of the store") as caught:
        store.run("count", 1, count, CountConfig(), {})
    assert str(caught.value.where).startswith(str(store.root / "count"))
    assert caught.value.next_step


def test_missing_rights_of_a_store_end_in_one_message_but_those_of_a_source_do_not_name_it(tmp_path: Path) -> None:
    def refuse(path: Path) -> NoReturn:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    store = ArtifactStore(tmp_path / "store")
    with pytest.raises(ArtifactError, match=r"0\.txt[\s\S]*Permission denied"):
        store.run("count", 1, lambda _config, _inputs, output: refuse(output / "0.txt"), CountConfig(), {})
    with pytest.raises(PermissionError):
        store.run("count", 1, lambda *_: refuse(tmp_path / "recording.mp4"), CountConfig(), {})


def test_digests_that_another_process_notes_meanwhile_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    configs = {name: JudgedConfig(weights=tmp_path / name) for name in ("one", "two")}
    for name in configs:
        (tmp_path / name).write_text(name)
    store = ArtifactStore(tmp_path / "store")

    def digest(path: Path) -> str:
        if path.name == "one":
            store.key("count", 1, configs["two"], {})
        return digest_file(path)

    monkeypatch.setattr(store_module, "digest_file", digest)
    store.key("count", 1, configs["one"], {})
    assert len(json.loads((tmp_path / "store/.weights.json").read_text())) == 2


def test_a_read_only_store_serves_finished_artifacts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "weights").write_bytes(b"one")
    config = JudgedConfig(weights=tmp_path / "weights")
    first = ArtifactStore(tmp_path / "store").run("count", 1, count, config, {})
    (tmp_path / "store" / ".weights.json").unlink()

    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(store_module, "write_json_atomic", refuse)
    store = ArtifactStore(tmp_path / "store")
    assert store.run("count", 1, count, config, {}).path == first.path
    with pytest.raises(ArtifactError, match=r"cannot be used[\s\S]*Read-only file system"):
        store.run("count", 2, count, config, {})
