"""Checks of `worldline doctor`: cores, memory, accelerators, codecs, GL, weights, Prefect; licences of what is installed."""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from worldline_core.config import CONFIG_ROOT
from worldline_core.errors import WorldLineError, installing
from worldline_core.processor import processor_has_bfloat16, processor_name
from worldline_core.shipped import SHIPPED, project_path

EXTRAS = {
    "mujoco": "sim (worldline record)",
    "h5py": "hdf5 (HDF5 sources)",
    "s3fs": "s3 (S3 object stores)",
    "gymnasium": "gym (Gymnasium environments)",
    "stable_baselines3": "rl (Stable-Baselines3)",
    "msgpack": "serve (worldline serve, play)",
}
SHIPPED_MODELS = ("tokenizer", "teacher", "base", "stage2", "causal", "segmenter")
PUBLISHED_MODELS = (
    "nvidia/Cosmos3-Nano",
    "facebook/vjepa2-vitg-fpc64-384",
    "facebook/sam3",
    "Qwen/Qwen3-VL-8B-Instruct",
)

_BUNDLED = re.compile(r"^[^/,]+\.libs/(?:[^/,]+/)*([^-./,]+)", re.MULTILINE)
"""Names of libraries in the RECORD of a wheel."""
_BUNDLED_GPL = ("libx264", "libx265")


@dataclass(frozen=True)
class MachineCheck:
    """One property of the machine, checked; ``next_step`` is empty where nothing need be done."""

    name: str
    status: Literal["ok", "missing", "optional"]
    found: str
    next_step: str = ""


def _check(name: str, good: bool, found: str, next_step: str = "", *, optional: bool = False) -> MachineCheck:
    status = "ok" if good else "optional" if optional else "missing"
    return MachineCheck(name, status, found, "" if good else next_step)


def examine_machine(project: Path) -> list[MachineCheck]:
    """The project's requirements, in the order of a report."""
    return [*_hardware(project), *_libraries(), *_weights(project), _prefect_api()]


def format_findings(findings: list[MachineCheck]) -> str:
    """The checks as a table, and below it what can be done."""
    marks = {"ok": "ok      ", "missing": "MISSING ", "optional": "optional"}
    width = max(len(finding.name) for finding in findings)
    lines = [f"{marks[finding.status]} {finding.name:<{width}}  {finding.found}" for finding in findings]
    advice = [f"  {finding.name}: {finding.next_step}" for finding in findings if finding.next_step]
    return "\n".join(lines + (["", "What you can do:", *advice] if advice else []))


def third_party_licences(project: Path) -> list[str]:
    """A line for each installed package with the licence that it states and the libraries in its wheel, and for each licence
    file beside shipped files."""
    lines = []
    # Each access parses a package's metadata anew.
    packages = [(found.metadata, found.read_text("RECORD") or "") for found in importlib.metadata.distributions()]
    for facts, record in sorted(packages, key=lambda package: package[0]["Name"].lower()):
        listed = facts.get_all("Classifier") or []
        classifiers = [text.rsplit(" :: ", 1)[-1] for text in listed if text.startswith("License ::")]
        stated = facts.get("License-Expression") or ", ".join(classifiers) or (facts.get("License") or "").strip()
        bundled = sorted(set(_BUNDLED.findall(record)))
        gpl = [name for name in bundled if name in _BUNDLED_GPL]
        lines.append(
            f"{facts['Name']} {facts['Version']}: {stated.splitlines()[0][:80] if stated else 'not stated'}"
            + (f"; in its wheel: {', '.join(bundled)}" if bundled else "")
            + (f" ({' and '.join(gpl)}: GPL-2.0-or-later)" if gpl else "")
        )
    beside = [*project_path(project, SHIPPED).rglob("LICENSE"), *(CONFIG_ROOT / "embodiments" / "licenses").iterdir()]
    for path in sorted(beside):
        text = [
            line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()
        ]
        lines.append(f"{path}: {next((line for line in text if 'license' in line.lower()), text[0])[:80]}")
    return lines


def _hardware(project: Path) -> Iterator[MachineCheck]:
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {cores} cores"
    yield MachineCheck("system", "ok", system)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    advice = "the tiny preset needs about 6 GiB; lower batch sizes with --set"
    yield _check("memory", memory >= 6, f"{memory:.1f} GiB", advice)
    free = shutil.disk_usage(project).free / 2**30
    yield _check("disk", free >= 10, f"{free:.0f} GiB free", "free some space")
    found, present = f"none; torch {torch.__version__} on the CPU", torch.cuda.is_available()
    if present:
        card = torch.cuda.get_device_properties(0)
        found = f"{card.name}, {card.total_memory / 2**30:.0f} GiB, torch {torch.__version__}"
    advice = "the tiny preset needs none; cosmos3-nano wants a CUDA GPU with 80 GiB or more"
    yield _check("accelerator", present, found, advice, optional=True)
    fast = processor_has_bfloat16()
    found = f"{processor_name()}: {'yes' if fast else 'no, it computes in float32 unless told otherwise'}"
    yield _check("CPU bfloat16", fast, found, optional=True)


def _libraries() -> Iterator[MachineCheck]:
    import av

    from worldline_core.data.video.encoder import video_codec

    try:
        found, advice = f"PyAV {av.__version__}: writes {video_codec()}", "reinstall av from PyPI"
    except WorldLineError as error:
        found, advice = error.what, error.next_step or f"expected {error.expected}"
    readable = "libdav1d" in av.codecs_available
    found += "" if readable else ", reads no AV1"
    yield _check("video codecs", readable and ": writes" in found, found, advice)
    for package, purpose in EXTRAS.items():
        present = importlib.util.find_spec(package) is not None
        advice = installing(purpose.split()[0])
        yield _check(f"extra {purpose}", present, "installed" if present else "absent", advice, optional=True)
    libraries = [name for name in ("EGL", "OSMesa") if ctypes.util.find_library(name)]
    advice = "only `worldline record` needs it: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
    yield _check("headless GL", bool(libraries), ", ".join(libraries) or "none", advice, optional=True)


def _weights(project: Path) -> Iterator[MachineCheck]:
    for name in SHIPPED_MODELS:
        folder = project_path(project, SHIPPED / "models" / name)
        present = any(folder.glob("*.safetensors"))
        place = folder.relative_to(project) if folder.is_relative_to(project) else folder
        advice = "they come with a checkout, and with pip install 'worldline[assets]'"
        yield _check(f"weights {name}", present, str(place) if present else "absent", advice)
    hub = Path(os.environ.get("HF_HOME", Path.home() / ".cache" / "huggingface")) / "hub"
    for repository in PUBLISHED_MODELS:
        present = (hub / f"models--{repository.replace('/', '--')}").is_dir()
        found = "in the local hub cache" if present else "absent"
        advice = "only the full-size preset needs it; download it where a hub is reachable"
        yield _check(f"weights {repository}", present, found, advice, optional=True)


def _prefect_api() -> MachineCheck:
    name, url = "Prefect API", os.environ.get("PREFECT_API_URL")
    if not url:
        return MachineCheck(name, "ok", "none set: flows start a temporary server")
    if not url.startswith(("http://", "https://")):
        return MachineCheck(name, "missing", url, "PREFECT_API_URL must start with http:// or https://")
    try:
        with urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=3) as answer:  # noqa: S310 - scheme checked above
            return MachineCheck(name, "ok", f"{url} answers {answer.status}")
    except (urllib.error.URLError, TimeoutError) as error:
        advice = "start it with `prefect server start`, or unset PREFECT_API_URL"
        return MachineCheck(name, "missing", f"{url}: {error}", advice)
