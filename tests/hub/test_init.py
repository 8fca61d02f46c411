"""`worldline init` on a dataset of the hub, through its client: `meta` and some episodes, one clear error where it does not answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.command_line import main
from tests.discovery.recorded_sets import so101_states, write_so101
from tests.hub.conftest import Hub, Repository, files_of
from worldline_core.data.curation.curate import curate
from worldline_core.discovery.look import fetch_sample, hub_id
from worldline_core.errors import DataError, UnavailableError
from worldline_core.pipeline.pipeline_config import PipelineConfig


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_meta_and_some_episodes_are_fetched_and_the_others_come_to_the_same_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hub: Hub, version: str
) -> None:
    monkeypatch.chdir(tmp_path)
    raw = write_so101(tmp_path / "raw", version=version, states=so101_states(episodes=5))
    hub.repositories["me/arm"] = Repository(private=False, files=files_of(raw))
    main(["init", "me/arm"])
    *_, download, curation = capsys.readouterr().out.splitlines()
    command, repository, *rest = download.removeprefix("next: hf ").split()
    assert (command, repository, rest[:2]) == ("download", "me/arm", ["--repo-type", "dataset"])
    assert curation == "next: worldline task curate --config my.yaml"
    config = PipelineConfig.load(None, Path("my.yaml"), [])
    folder = config.curate.sources[0].path
    assert len(list(folder.rglob("*.mp4"))) == (6 if version == "v2.1" else 2)
    from huggingface_hub import snapshot_download

    assert snapshot_download("me/arm", repo_type="dataset", revision=rest[-1], endpoint=hub.url) == str(folder)
    assert curate(config.curate, {}, tmp_path / "curated")["found"] == 5


def test_what_the_hub_does_not_give(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hub: Hub) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/data.csv").write_text("x")
    hub.repositories["me/arm"] = Repository(private=False, files=files_of(tmp_path / "raw"))
    with pytest.raises(DataError, match=r"(?s)Not a LeRobotDataset.*me/arm.*hf download me/arm"):
        fetch_sample("me/arm")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    for name in ("me/arm", "me/gone"):
        with pytest.raises((UnavailableError, DataError), match=r"(?s)hub does not give.*offline|Not a LeRobotDataset"):
            fetch_sample(name)
    assert hub_id("me/arm") == hub_id("hf://datasets/me/arm") == "me/arm"
    assert hub_id("./arm") is hub_id("/a/b") is None
    (tmp_path / "me/arm").mkdir(parents=True)
    assert hub_id("me/arm") is None
