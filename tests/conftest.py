"""Fixtures that several test folders share."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import jaxtyping
import pytest

from tests.runtime_shapes import check_shapes_of

if TYPE_CHECKING:
    from worldline_core.model.world_model import WorldModel
    from worldline_core.model.world_model_config import ActionContract, CausalSpec

CHECKED_PACKAGES = ("geometry", "actions", "model", "training", "distillation", "rollout")
"""Packages of the core whose functions check shapes and types against their annotations, in tests only."""
check_shapes_of([f"worldline_core.{name}" for name in CHECKED_PACKAGES])

IDLE_SERVICES = ("SCHEDULER", "LATE_RUNS", "CANCELLATION_CLEANUP", "PAUSE_EXPIRATIONS", "FOREMAN", "TRIGGERS")
"""Services that only schedules, workers and automations need; tests start the server without them."""

HEAVY_IMPORTS = tuple(
    f"tests/{name}"
    for name in (
        "distillation/", "evaluation/test_judges", "evaluation/test_learned_judge", "evaluation/test_measurements",
        "hub/test_own_models", "model/", "pipeline/test_size_sheet",
        "robustness/test_hostile_weights", "tasks/test_progress", "training/",
    )
)  # fmt: skip
PROJECT_ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The rehearsal takes as long as all other slow tests on one core: begun last, it would keep the second one idle.

    Tests that need diffusers, transformers, peft or an optimizer (which imports torch._dynamo) follow, for the same process:
    each imports them for some seconds.
    """
    items.sort(key=lambda item: ("tests/rehearsal/" not in item.nodeid, not item.nodeid.startswith(HEAVY_IMPORTS)))


@pytest.fixture
def unchecked_shapes() -> Iterator[None]:
    """For tests that hand in wrong shapes on purpose, to see what production code says of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def rendering() -> None:
    """For tests that render: what fails after this is a failure, not a machine without OpenGL."""
    mujoco = pytest.importorskip("mujoco")
    from worldline_core.recorder.rendering import prepare_rendering

    prepare_rendering()
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>")).close()
    except (RuntimeError, AttributeError, ImportError, OSError, mujoco.FatalError) as error:
        pytest.skip(f"no off-screen OpenGL ({error}); on Debian: libegl1 libegl-mesa0 libgl1-mesa-dri")


@pytest.fixture(scope="session")
def project_root() -> Path:
    return PROJECT_ROOT


@pytest.fixture(scope="session")
def uv(project_root: Path) -> str:
    """The uv that builds wheels."""
    for candidate in filter(None, (shutil.which("uv"), str(project_root / ".bootstrap" / "bin" / "uv"))):
        # A version manager may leave a uv that only says that it is not there.
        if (
            Path(candidate).is_file()
            and subprocess.run([candidate, "-V"], capture_output=True, check=False).returncode == 0
        ):
            return candidate
    pytest.skip("uv builds the wheels and is not here")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real samples that may not be copied into the project; they lie beside the checkout."""
    folder = Path(os.environ.get("WORLDLINE_SHARED", PROJECT_ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"the real samples are not here (looked in {folder})")
    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of this run, the same for all of its processes (pytest-xdist)."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture
def forked_loaders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loader processes are forked from one that has torch: a spawned one imports it again, for three seconds of a core.

    That training spawns them is tested with the ones that end with their training process.
    """
    multiprocessing.set_forkserver_preload(["torch", "cv2", "pyarrow.parquet", "pydantic", "scipy.spatial"])
    monkeypatch.setattr("worldline_core.training.clip_loader.START_METHOD", "forkserver")


@pytest.fixture(scope="session")
def prefect_server(shared_folder: Path) -> Iterator[None]:
    """One Prefect server for all tests that need one, in all processes: to start it takes ten seconds of a core.

    It keeps what runs tell it; tests ask for the runs of their own flows. The last process that needs it stops it.
    """
    from prefect.events.worker import EventsWorker
    from prefect.server.api.server import SubprocessASGIServer
    from prefect.settings import PREFECT_API_URL, temporary_settings

    # What sends task states is one for the process: another server's, where tests before this one had one.
    EventsWorker.drain_all(timeout=10)
    told, names = shared_folder / "prefect_server.txt", ("starting", "users")
    starting, users = ((shared_folder / f"prefect_server.{name}").open("w") for name in names)
    # Two locks: with one, the second process would wait for the first to end before it could begin.
    with starting, users:
        fcntl.flock(starting, fcntl.LOCK_EX)
        if not told.exists():
            told.write_text(" ".join(map(str, _start_prefect_server(shared_folder))))
        fcntl.flock(users, fcntl.LOCK_SH)
        fcntl.flock(starting, fcntl.LOCK_UN)
        process, port = map(int, told.read_text().split())
        server = SubprocessASGIServer(port)
        server.running, server.server_process = True, subprocess.Popen(["true"])  # it wants a process to be there
        with pytest.MonkeyPatch.context() as patch, temporary_settings({PREFECT_API_URL: server.api_url}):
            # Threads have settings of their own: those of Prefect would start the server of runs that have none.
            patch.setitem(SubprocessASGIServer._instances, None, server)
            yield
            EventsWorker.drain_all(timeout=10)
        fcntl.flock(starting, fcntl.LOCK_EX)
        try:
            fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        told.unlink()
        os.kill(process, signal.SIGTERM)


def _start_prefect_server(folder: Path) -> tuple[int, int]:
    """Its process and its port, once it answers. Its database and its log lie in the folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {
        "PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{folder / 'prefect.db'}",
        "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_UI_ENABLED": "false",
        # What looks every few seconds for work that no test gives would take a share of a core from all others.
        **{f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in IDLE_SERVICES},
        # A command that a test ran in this process has chosen a temporary server, which keeps no task runs.
        "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_ENABLED": "true",
        "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "true",
    }
    create = "from prefect.server.api.server import create_app; import uvicorn; uvicorn.run"
    with (folder / "prefect_server.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", f"{create}(create_app(), port={port}, log_level='error')"],
            env=os.environ | settings, stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as asking:
            if asking.connect_ex(("127.0.0.1", port)) == 0:  # it listens when it is ready
                return process.pid, port
        time.sleep(0.1)
    process.kill()
    raise RuntimeError(f"the Prefect server did not start:\n{(folder / 'prefect_server.log').read_text()}")


@pytest.fixture(scope="session")
def make_model() -> Callable[..., WorldModel]:
    """Very small world models (4 latent channels, 9 action channels) whose every weight is random: no path is silent."""
    import torch
    from pydantic import TypeAdapter

    from worldline_core.model.networks import build_world_model
    from worldline_core.model.world_model_config import NetworkConfig

    small = {
        "latent_channels": 4, "hidden_size": 24, "num_layers": 2, "num_heads": 2, "head_dim": 12, "intermediate_size": 32,
        "towers": "generation",
    }  # fmt: skip
    own = {
        "mixture": {"num_kv_heads": 1, "rope_sections": (2, 2, 2)},
        "wan": {"text_size": 10, "text_length": 6, "prompt_length": 2},
    }

    def make(seed: int = 0, *, scale: float = 0.2, network: str = "mixture", **changes: object) -> WorldModel:
        generator = torch.Generator().manual_seed(seed)
        values = small | own[network] | changes | {"network": network}
        model = build_world_model(TypeAdapter(NetworkConfig).validate_python(values))
        with torch.no_grad():
            for value in model.state_dict().values():
                value.copy_(torch.randn(value.shape, generator=generator) * scale)
        return model.eval()

    return make


@pytest.fixture(scope="session")
def make_contract() -> Callable[..., ActionContract]:
    """Action contracts of small models."""
    from worldline_core.model.world_model_config import ActionContract

    small = {"controls": "action", "sigma_px_ref": 40.0, "fps": 8.0, "grid_size": (4, 4), "tokenizer": "0123"}
    return lambda **changes: ActionContract.model_validate(small | changes)


@pytest.fixture(scope="session")
def make_spec() -> Callable[..., CausalSpec]:
    """Causal blocks of small models: two latent frames, a window of one and three blocks, the paper's nodes."""
    from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec

    small = {"block_size": 2, "sink_blocks": 1, "recent_blocks": 3, "anchor_blocks": None, "sigmas": CAUSAL_SIGMAS}
    return lambda **changes: CausalSpec.model_validate(small | changes)


@pytest.fixture
def reading_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Curation reads here, where a test can exchange what it calls, and not in a reader process."""
    monkeypatch.setattr(
        "worldline_core.data.curation.curate.read_limited", lambda _limits, function, *arguments: function(*arguments)
    )
