"""What this machine can do: cores, memory, accelerators, codecs, GL, weights, Prefect."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import platform
import shutil
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from worldline_core.errors import installing
from worldline_core.shipped import SHIPPED, project_path


@dataclass(frozen=True)
class MachineCheck:
    """One property of the machine, checked.

    Attributes:
        next_step: what the user can do about it; empty where nothing need be done.
    """

    name: str
    status: Literal["ok", "missing", "optional"]
    found: str
    next_step: str = ""


def examine_machine(project: Path) -> list[MachineCheck]:
    """What the project needs, in the order of a report."""
    return [
        _system(),
        _memory(),
        _disk(project),
        _accelerator(),
        _bfloat16(),
        _codec(),
        _decoder(),
        *_packages(),
        _software_gl(),
        *_weights(project),
        _prefect_api(),
    ]


def format_findings(findings: list[MachineCheck]) -> str:
    """A table for people."""
    marks = {"ok": "ok      ", "missing": "MISSING ", "optional": "optional"}
    width = max(len(finding.name) for finding in findings)
    lines = [f"{marks[finding.status]} {finding.name:<{width}}  {finding.found}" for finding in findings]
    advice = [f"  {finding.name}: {finding.next_step}" for finding in findings if finding.next_step]
    return "\n".join(lines + (["", "What you can do:", *advice] if advice else []))


def _system() -> MachineCheck:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return MachineCheck(
        "system", "ok", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {cores} cores"
    )


def _memory() -> MachineCheck:
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    advice = "" if total >= 6 else "the tiny preset needs about 6 GiB; lower batch sizes with --set"
    return MachineCheck("memory", "ok" if total >= 6 else "missing", f"{total:.1f} GiB", advice)


def _disk(project: Path) -> MachineCheck:
    free = shutil.disk_usage(project).free / 2**30
    return MachineCheck(
        "disk", "ok" if free >= 10 else "missing", f"{free:.0f} GiB free", "" if free >= 10 else "free some space"
    )


def _accelerator() -> MachineCheck:
    import torch

    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        return MachineCheck(
            "accelerator",
            "ok",
            f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, torch {torch.__version__}",
        )
    return MachineCheck(
        "accelerator", "optional", f"none; torch {torch.__version__} on the CPU",
        "the tiny preset needs none; cosmos3-nano wants a CUDA GPU with 80 GiB or more",
    )  # fmt: skip


def _bfloat16() -> MachineCheck:
    import torch

    fast = (
        bool(torch.backends.cpu.get_cpu_capability().startswith("AVX512"))
        and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    )
    return MachineCheck(
        "CPU bfloat16", "ok" if fast else "optional", "native" if fast else "emulated: training is slower"
    )


def _codec() -> MachineCheck:
    import av

    missing = [name for name in ("libx264", "libdav1d") if name not in av.codecs_available]
    if missing:
        return MachineCheck(
            "video codecs", "missing", f"PyAV {av.__version__} without {', '.join(missing)}", "reinstall av from PyPI"
        )
    return MachineCheck("video codecs", "ok", f"PyAV {av.__version__}: H.264, AV1 decode")


def _decoder() -> MachineCheck:
    from worldline_core.data.video.frame_decoder import describe_decoders

    found = describe_decoders()
    status = "optional" if found["next_step"] else "ok"
    reason = f" (torchcodec: {found['torchcodec']})" if found["next_step"] else ""
    return MachineCheck("clip decoder", status, f"auto takes {found['auto']}{reason}", found["next_step"])


def _packages() -> list[MachineCheck]:
    extras = {
        "mujoco": "sim (worldline record)",
        "h5py": "hdf5 (HDF5 sources)",
        "s3fs": "s3 (S3 object stores)",
        "gymnasium": "gym (Gymnasium environments)",
        "msgpack": "serve (worldline serve, play)",
    }
    findings = []
    for package, purpose in extras.items():
        present = importlib.util.find_spec(package) is not None
        advice = "" if present else installing(purpose.split()[0])
        findings.append(
            MachineCheck(
                f"extra {purpose}", "ok" if present else "optional", "installed" if present else "absent", advice
            )
        )
    return findings


def _software_gl() -> MachineCheck:
    libraries = [name for name in ("EGL", "OSMesa") if ctypes.util.find_library(name)]
    if libraries:
        return MachineCheck("headless GL", "ok", ", ".join(libraries))
    return MachineCheck(
        "headless GL",
        "optional",
        "none",
        "only `worldline record` needs it: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri",
    )


def _weights(project: Path) -> list[MachineCheck]:
    findings = []
    for name in ("tokenizer", "teacher", "base", "stage2", "causal", "segmenter"):
        folder = project_path(project, SHIPPED / "models" / name)
        present = any(folder.glob("*.safetensors"))
        findings.append(
            MachineCheck(
                f"weights {name}",
                "ok" if present else "missing",
                str(folder.relative_to(project) if folder.is_relative_to(project) else folder) if present else "absent",
                "" if present else "they come with a checkout, and with pip install 'worldline[assets]'",
            )
        )
    hub = Path(os.environ.get("HF_HOME", Path.home() / ".cache" / "huggingface")) / "hub"
    for repository in (
        "nvidia/Cosmos3-Nano",
        "facebook/vjepa2-vitg-fpc64-384",
        "facebook/sam3",
        "Qwen/Qwen3-VL-8B-Instruct",
    ):
        present = (hub / f"models--{repository.replace('/', '--')}").is_dir()
        findings.append(
            MachineCheck(f"weights {repository}", "ok" if present else "optional", "in the local hub cache" if present else "absent",
                     "" if present else "only the full-size preset needs it; download it where a hub is reachable")
        )  # fmt: skip
    return findings


def _prefect_api() -> MachineCheck:
    url = os.environ.get("PREFECT_API_URL")
    if not url:
        return MachineCheck("Prefect API", "ok", "none set: flows start a temporary server")
    if not url.startswith(("http://", "https://")):
        return MachineCheck("Prefect API", "missing", url, "PREFECT_API_URL must start with http:// or https://")
    try:
        with urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=3) as answer:  # noqa: S310 - scheme checked above
            return MachineCheck("Prefect API", "ok", f"{url} answers {answer.status}")
    except (urllib.error.URLError, TimeoutError) as error:
        return MachineCheck(
            "Prefect API",
            "missing",
            f"{url}: {error}",
            "start it with `prefect server start`, or unset PREFECT_API_URL",
        )
