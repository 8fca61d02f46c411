"""`worldline play`: the page in a headless browser, and its protocol without one."""

import asyncio
import json
import shutil
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from tests.policies.test_openpi import policy_server
from worldline_core import WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import UnavailableError
from worldline_core.pictures import jpeg_bytes
from worldline_core.rollout.simulation import Simulation
from worldline_core.serving import play_session
from worldline_core.serving.client import SimulatorClient
from worldline_core.serving.play_session import PlaySession
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.serving.session_host import SessionHost

EPISODE = "ur5e_silver-test-s1-00000"


class Page:
    """A page of a browser, over the DevTools protocol."""

    def __init__(self, connection):
        self._connection, self._count = connection, 0
        self.messages = []
        self.call("Runtime.enable")
        self.call("Log.enable")

    def call(self, method, **parameters):
        self._count += 1
        self._connection.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            reply = json.loads(self._connection.recv(timeout=60))
            if reply.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.messages.append(json.dumps(reply["params"]))
            if reply.get("id") == self._count:
                assert "error" not in reply, reply
                return reply["result"]

    def value(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, expression, seconds=60):
        deadline = time.monotonic() + seconds
        while not (found := self.value(expression)):
            assert time.monotonic() < deadline, (expression, self.value("document.getElementById('said').textContent"))
            time.sleep(0.05)
        return found

    def key(self, kind, key):
        self.call("Input.dispatchKeyEvent", type=kind, key=key)

    def mouse(self, kind, view, at):
        """An event of the left button at a place in the picture of a view, in shares of its width and height."""
        canvas = f"document.querySelector('canvas[data-view={view}]').getBoundingClientRect()"
        left, top, width, height = self.value(f"(({{x, y, width, height}}) => [x, y, width, height])({canvas})")
        place = {"x": left + at[0] * width, "y": top + at[1] * height}
        self.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **place)


@contextmanager
def browser(folder, url):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium is here (apt-get install chromium)")
    folder.mkdir()
    options = (
        "--headless=new --no-sandbox --disable-gpu --disable-background-timer-throttling --remote-debugging-port=0"
    )
    command = [chromium, *options.split(), "--window-size=1280,900", f"--user-data-dir={folder}", "about:blank"]
    with (folder / "chromium.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        told = folder / "DevToolsActivePort"
        deadline = time.monotonic() + 60
        while not (told.is_file() and len(told.read_text().splitlines()) == 2):
            assert time.monotonic() < deadline and process.poll() is None, (folder / "chromium.log").read_text()
            time.sleep(0.05)
        port = told.read_text().splitlines()[0]
        target = httpx.put(f"http://127.0.0.1:{port}/json/new?{url}", trust_env=False, timeout=60).json()
        with connect(target["webSocketDebuggerUrl"], max_size=None, proxy=None, compression=None) as connection:
            yield Page(connection)
    finally:
        process.terminate()
        process.wait(20)


def drag_and_steer(page, begin):
    """From the start on: one tool by the mouse, the other by a gamepad, each taking over from a policy that was chosen."""
    page.value("go(0)")
    page.value("document.getElementById('driver').add(new Option('by a policy', 'policy'))")
    page.until(f"Math.abs(window.play.position[1][2] - {begin[1, 2]}) < 1e-6")
    page.value("document.getElementById('driver').value = 'policy'")
    at = page.value("window.play.marks.head[0].at")
    goal = [at[0] + 0.04, at[1] - 0.05]
    page.mouse("mousePressed", "head", at)
    page.mouse("mouseMoved", "head", goal)
    away = f"Math.hypot(window.play.marks.head[0].at[0] - {goal[0]}, window.play.marks.head[0].at[1] - {goal[1]})"
    page.until(f"{away} < 0.01")
    assert page.value("[document.getElementById('driver').value, document.getElementById('arm').value]") == ["", "0"]
    page.mouse("mouseReleased", "head", goal)
    assert page.value("goal === null")
    assert np.abs(np.array(page.value("window.play.position"))[1] - begin[1]).max() < 1e-3

    idle = "{mapping: 'standard', axes: [0.1, -0.1, 0, 0.1], buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))}"
    page.value(f"window.pad = {idle}; navigator.getGamepads = () => [null, window.pad]; 0")
    assert page.value("wish()") == {"move": [0, 0, 0], "turn": [0, 0, 0], "grip": 0, "goal": None}  # sticks at rest
    page.value("window.pad.buttons[5].pressed = true")
    page.until("document.getElementById('arm').value === '1'")
    page.value(
        "window.pad.buttons[5].pressed = false; document.getElementById('driver').value = 'policy'; window.pad.axes[3] = -1"
    )
    page.until(f"window.play.position[1][2] > {begin[1, 2] + 0.03}")
    assert page.value("document.getElementById('driver').value") == ""
    left = np.array(page.value("window.play.position"))[0]
    page.value("window.pad.axes[3] = 0; window.pad.buttons[6].value = 1")
    page.until("window.play.marks.head[1].open < 0.3")
    page.value("window.pad.buttons[6].value = 0; window.pad.buttons[7].value = 1")
    page.until("window.play.marks.head[1].open > 0.7")
    assert np.abs(np.array(page.value("window.play.position"))[0] - left).max() < 1e-3
    page.value("window.pad.buttons[7].value = 0; window.pad.buttons[9].pressed = true")
    page.until("document.getElementById('run').getAttribute('aria-pressed') === 'false'")
    # Where a browser has no gamepads for the page, keys go on working.
    page.value("navigator.getGamepads = undefined")
    assert page.value("wish().grip") == 0


def hold_buttons_of_a_phone(page, begin):
    """A finger on a button moves the arm, all buttons are there without scrolling sideways and large enough for a finger."""
    page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
    buttons = "[...document.querySelectorAll('#pad button')]"
    assert page.value("document.documentElement.scrollWidth") <= 390
    assert page.value(f"Math.min(...{buttons}.map((x) => x.offsetHeight))") >= 44
    assert page.value(f"Math.max(...{buttons}.map((x) => x.getBoundingClientRect().right))") <= 390
    page.value("go(0); choose(1); 0")
    page.until(f"Math.abs(window.play.position[1][2] - {begin[1, 2]}) < 1e-6")
    up = "document.querySelector('[data-key=e]')"
    page.value(f"{up}.scrollIntoView({{block: 'center'}})")
    middle = "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
    left, top = page.value(f"{middle}({up}.getBoundingClientRect())")
    finger = {"x": left, "y": top, "button": "left", "buttons": 1, "clickCount": 1}
    page.call("Input.dispatchMouseEvent", type="mousePressed", **finger)
    page.until(f"window.play.position[1][2] > {begin[1, 2] + 0.02}")
    page.call("Input.dispatchMouseEvent", type="mouseReleased", **finger)
    assert page.value("wish().move") == [0, 0, 0]
    page.call("Emulation.clearDeviceMetricsOverride")


@pytest.mark.slow
def test_a_script_in_a_browser_drives_to_a_target_and_saves(serving, shipped, tmp_path):
    world = WorldLine.from_pretrained(shipped / "models" / "causal")
    with (
        serving(world=world, output=tmp_path / "saved") as url,
        browser(tmp_path / "profile", f"{url.replace('ws', 'http')}/play?episode={EPISODE}") as page,
    ):
        page.until("document.querySelectorAll('#episode option').length > 3")
        page.until("window.play.node === 0 && window.play.position !== null")  # it starts by itself
        assert page.value("document.querySelectorAll('#views canvas').length") == 3
        begin = np.array(page.value("window.play.position"))
        page.key("keyDown", "e")
        page.until(f"window.play.position[1][2] > {begin[1, 2] + 0.075}")  # the right arm, 8 cm up
        page.key("keyUp", "e")
        page.until("window.play.blocks >= 1 && window.play.shown >= 8")
        there = np.array(page.value("window.play.position"))
        assert 0.07 < there[1, 2] - begin[1, 2] < 0.2  # a busy machine sees the key go up late
        assert np.abs(there[0] - begin[0]).max() < 1e-3  # the other arm was left alone
        page.value("document.querySelector('#save').click()")
        saved = page.until("window.play.saved")
        assert np.allclose(page.value("window.play.position"), there, atol=1e-3)  # and then stays
        page.value("document.getElementById('back').click()")
        assert len(page.value("window.play.latency")) >= 1
        page.value("go(0); untaken = 80; run(true)")
        page.until("document.getElementById('said').textContent.includes('The server is busy')")
        page.value("untaken = 1")
        page.until("document.getElementById('said').textContent === ''")
        labels = "[...document.querySelectorAll('.bar label, #tree button')]"
        assert page.value(f"Math.max(...{labels}.map((x) => x.offsetHeight))") < 40  # none breaks into two lines
        drag_and_steer(page, begin)
        hold_buttons_of_a_phone(page, begin)
        assert page.messages == []
    episodes = EpisodeSet.open(Path(saved["path"]))
    episode = episodes.episode(0)
    assert episode.num_frames == saved["frames"] >= 17
    assert episodes.frames(0, "head").shape == (saved["frames"], 64, 96, 3)
    assert set(episode.cameras) == {"head", "left_wrist", "right_wrist"}
    assert episode.conventions["driven_by"] == "by hand"


class Driver:
    """The page's side of the protocol."""

    def __init__(self, connection):
        self.connection = connection
        self.marks = {}

    def tell(self, **message):
        self.connection.send(json.dumps(message))

    def until(self, kind):
        while True:
            found = self.connection.recv(timeout=30)
            if isinstance(found, bytes):
                length = int.from_bytes(found[:4], "little")
                message = json.loads(found[4 : 4 + length])
                assert 4 + length + sum(message["sizes"]) == len(found)
                assert found[4 + length : 6 + length] == b"\xff\xd8"  # JPEG
            else:
                message = json.loads(found)
            if message["type"] == "marks":
                self.marks = message
            if message["type"] == kind:
                return message
            assert message["type"] != "error", message

    def refused(self, **message):
        self.tell(**message)
        return self.until("error")["what"]

    def block(self, **wish):
        for _ in range(4):
            self.tell(type="tick", arms=[{}, wish])
        return self.until("block")


@contextmanager
def driving(url):
    with connect(url + "/play/session", proxy=None, max_size=None) as connection:
        yield Driver(connection)


def test_driving_branches_a_policy_and_saving(serving, tmp_path):
    asked = []

    def act(observation):
        asked.append(observation)
        return {"actions": np.repeat(observation["state"][None], 5, axis=0)[:, : 14 if len(asked) < 2 else 3]}

    with (
        policy_server(act) as policy,
        serving(output=tmp_path, policies={"mine": {"url": policy, "state_key": "state"}}, max_blocks=4) as url,
    ):
        given = httpx.get(url.replace("ws", "http") + "/play")
        assert "Play" in given.text
        assert given.headers["X-Frame-Options"] == "DENY"  # clicks cannot be made by a page around it
        with driving(url) as page:
            assert page.until("hello")["policies"] == ["mine"]
            assert "Nothing is being played" in page.refused(type="tick", arms=[])
            page.tell(type="start", episode=EPISODE, seed=1)
            assert page.until("started")["frames_per_step"] == 4
            assert page.until("block")["node"] == 0
            page.until("marks")
            before = np.array(page.marks["position"])
            first = page.block(move=[0, 0, 1])
            assert (first["node"], first["parent"], first["frames"]) == (1, 0, 4)
            after = np.array(page.marks["position"])
            assert np.allclose(after[1] - before[1], (0, 0, 0.1), atol=2e-3)  # 0.2 m/s for half a second
            assert page.block(grip=-1)["parent"] == 1
            page.tell(type="go", node=1)
            page.until("marks")
            assert np.allclose(page.marks["position"], after)
            assert page.block(move=[1, 0, 0])["parent"] == 1  # a branch
            page.tell(type="go", node=0)
            page.tell(type="advance", policy="mine")
            by_policy = page.until("block")
            assert (by_policy["driver"], by_policy["parent"]) == ("mine", 0)
            assert asked[0]["observation.images.head"].shape == (64, 96, 3)
            assert asked[0]["prompt"]
            page.tell(type="go", node=3)
            page.tell(type="save")
            saved = page.until("saved")
            page.tell(type="go", node=0)
            assert "do not fit the robot" in page.refused(type="advance", policy="mine")
            for wrong in ({"type": "eval"}, {"type": "go", "node": 9}, {"type": "tick", "arms": [{}]}):
                assert page.refused(**wrong), wrong
            page.connection.send(b"no text")
            assert "not understood" in page.until("error")["what"]
            assert "nothing to save" in page.refused(type="save")
    episodes = EpisodeSet.open(Path(saved["path"]))
    episode = episodes.episode(0)
    assert len(episode.state) == len(episode.action) == saved["frames"] == 9
    assert episodes.frames(0, "right_wrist").shape == (9, 64, 96, 3)
    assert {view: camera.moving for view, camera in episode.cameras.items() if view != "left_wrist"} == {
        "head": False, "right_wrist": True,
    }  # fmt: skip
    assert episode.conventions["started_at"] == EPISODE


@contextmanager
def in_this_process(world, shipped, output):
    """A session without a server: itself, a function that tells it a message, and what it sent."""
    host = SessionHost(world, ServeConfig.model_validate({"episodes": shipped / "recordings", "output": output}))
    sent = []
    pictures = []

    async def send(content):
        if isinstance(content, bytes):
            head = content[4 : 4 + int.from_bytes(content[:4], "little")]
            pictures.append(content[4 + len(head) :])
            content = head.decode()
        sent.append(json.loads(content))

    session = PlaySession(host, send)

    async def tell(**message):
        await session.receive(json.dumps(message))

    yield session, tell, sent, pictures
    host.shut_down()
    assert not [message for message in sent if message["type"] == "error"]


@pytest.mark.slow
def test_a_long_session_keeps_few_simulations_and_goes_back_all_the_same(small_world, shipped, tmp_path, monkeypatch):
    monkeypatch.setattr(play_session, "KEPT_EVERY", 2)
    monkeypatch.setattr(play_session, "KEPT_LAST", 2)
    with in_this_process(small_world, shipped, tmp_path) as (session, tell, sent, pictures):

        async def block():
            for _ in range(4):
                await tell(type="tick", arms=[{}, {"move": [0, 0, 1]}])
            await session._settled()

        async def drive():
            await tell(type="start", episode=EPISODE)
            for _ in range(5):
                await block()
            assert sorted(session._kept) == [0, 2, 3, 4, 5]
            for _ in range(2):  # from a simulation that is computed again, then from the one that is kept now
                await tell(type="go", node=1)
                await block()
            assert pictures[-1] == pictures[-2]
            first = jpeg_bytes(next(iter(session._frames(session._nodes[2], "head"))), 93)
            assert first == pictures[2][: len(first)]
            await tell(type="save")
            await session.close()

        asyncio.run(drive())
        assert sent[-1]["frames"] == 9


@pytest.mark.slow
def test_the_next_block_is_computed_ahead_in_a_session_alone(small_world, shipped, tmp_path, monkeypatch):
    """Wishes that go on, that change at the last tick, and that change after a way back."""
    up, away = [{}, {"move": [0, 0, 1]}], [{}, {"move": [0, 1, 0]}]
    steps = []
    step = Simulation.step
    monkeypatch.setattr(Simulation, "step", lambda self, rows: steps.append(self) or step(self, rows))

    def driven(*, alone):
        counts = []
        with in_this_process(small_world, shipped, tmp_path) as (session, tell, _, pictures):

            async def drive():
                if not alone:
                    session._host.admit("somebody else")
                await tell(type="start", episode=EPISODE)
                for node, wishes in ((None, [up] * 4), (None, [up] * 3 + [away]), (1, [away] * 4)):
                    if node is not None:
                        await tell(type="go", node=node)
                    steps.clear()
                    for arms in wishes:
                        await tell(type="tick", arms=arms)
                        while alone and session._ahead is not None and not session._ahead.made.done():
                            await asyncio.sleep(0.01)
                    await session._settled()
                    counts.append(len(steps))
                await session.close()

            asyncio.run(drive())
        return counts, pictures

    ahead, by_request = driven(alone=True), driven(alone=False)
    assert ahead[0] == [1, 2, 1] and by_request[0] == [1, 1, 1]
    assert ahead[1] == by_request[1]


def test_somebody_at_the_page_takes_the_room_of_a_session(serving):
    with serving(max_sessions=1) as url:
        with driving(url) as page:
            for _ in range(2):  # starting again takes no further room
                page.tell(type="start", episode=EPISODE)
                page.until("started")
            with SimulatorClient(url) as client, pytest.raises(UnavailableError, match="no room"):
                client.start(EPISODE)
        with SimulatorClient(url) as client:
            client.start(EPISODE)
            with driving(url) as page:
                assert "no room" in page.refused(type="start", episode=EPISODE)
