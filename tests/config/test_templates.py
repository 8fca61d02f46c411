"""Every file in configs loads as it is: presets, recordings, and templates for users, which name robots that exist."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest

from tasks.execution.artifact_task import find_task
from worldline_core.config import CONFIG_ROOT, load_config, read_yaml, validate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.sources.open import SourceConfig
from worldline_core.data.sources.robomind import ROBOMIND_LAYOUTS
from worldline_core.errors import ConfigError
from worldline_core.geometry.embodiment import embodiment_names
from worldline_core.recorder.attempts import RecordBanksConfig, RecordPoliciesConfig
from worldline_core.recorder.record import RecordConfig, plan_jobs

TEMPLATES = sorted([*(CONFIG_ROOT / "sources").glob("*.yaml"), *(CONFIG_ROOT / "filters").glob("*.yaml")])
RECORDINGS = sorted((CONFIG_ROOT / "recording").glob("*.yaml"))
KNOWN = {*embodiment_names(), NO_EMBODIMENT}


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_a_recording_loads_as_it_is(path: Path) -> None:
    sections = read_yaml(path)
    if "groups" in sections:
        assert plan_jobs(load_config(RecordConfig, path=path))
    elif "policies" in sections:
        assert load_config(RecordPoliciesConfig, path=path).starts.specs()
    else:
        assert load_config(RecordBanksConfig, path=path).specs()


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_a_template_loads_as_it_is(path: Path) -> None:
    sections = read_yaml(path)
    assert "curate" in sections or path.parent.name != "sources"
    for section in sections:
        config = load_config(find_task(section).load_config(), path=path, section=section)
        if isinstance(config, CurateConfig):
            assert all(
                getattr(source, "embodiment", None) in {*KNOWN, None, "unspecified"} for source in config.sources
            )


def test_the_robots_that_readers_name_themselves_exist() -> None:
    defaults = {kind.model_fields["embodiment"].default for kind in get_args(get_args(SourceConfig)[0])
                if "embodiment" in kind.model_fields and not kind.model_fields["embodiment"].is_required()}  # fmt: skip
    assert defaults - {None, "unspecified"} <= KNOWN  # of plain videos the robot is not asked for
    assert {layout.embodiment for layout in ROBOMIND_LAYOUTS.values()} <= KNOWN


@pytest.mark.parametrize(("name", "hint"), [("unitree_g1", "did you mean 'unitree_g1_29dof'"), ("zz", "zz.yaml")])
def test_a_robot_that_nobody_describes_is_a_mistake_in_the_configuration(name: str, hint: str) -> None:
    def source(embodiment: str) -> dict[str, Any]:
        views = {"observation.images.top": "head"}
        return {"kind": "lerobot_v3", "path": "x", "embodiment": embodiment, "angle_unit": "rad", "views": views}

    with pytest.raises(ConfigError, match=rf"(?s)embodiment: .*no description of the robot {name} .*{hint}.*none"):
        validate(CurateConfig, {"sources": [source(name)]}, where="my.yaml")
    assert validate(CurateConfig, {"sources": [source("none")]}, where="my.yaml").sources[0].label == "x"
