"""Vision-language models behind one small protocol: a local Qwen3-VL, or any OpenAI-compatible server.

A model is shown one user message of text, images and videos. Reading its JSON answer is tolerant of what surrounds the
object and strict about what it says.
"""

from __future__ import annotations

import base64
import http.client
import json
import os
import queue
import threading
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, cast
from urllib.parse import urlsplit

import cv2
import numpy as np
import torch
from einops import rearrange
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.untrusted_text import HIDDEN, carries_credentials

MAX_NEW_TOKENS = 256
MAX_ANSWER_BYTES, MAX_ANSWER_CHARACTERS = 1 << 20, 20_000
"""A server's reply, and what of its text is looked through: 256 tokens take some kilobytes."""
PROMPTS: dict[str, str] = tomllib.loads(Path(__file__).with_name("prompts.toml").read_text(encoding="utf-8"))
"""The paper's prompts by name, to be filled by `str.format`."""
_TRANSIENT_STATUS = frozenset({408, 429, 500, 502, 503, 504})


@dataclass(frozen=True)
class Text:
    """Words."""

    text: str


@dataclass(frozen=True)
class Image:
    """One picture, uint8 (h, w, 3) RGB."""

    pixels: np.ndarray


@dataclass(frozen=True)
class Video:
    """Chosen frames (n, h, w, 3) of a clip; ``indices`` are their numbers in it, recorded at ``fps`` [1/s]."""

    frames: np.ndarray
    indices: tuple[int, ...]
    fps: float
    total_frames: int


Part = Text | Image | Video


class VisionLanguageModel(Protocol):
    """Answers one message, deterministically, with at most MAX_NEW_TOKENS tokens."""

    @property
    def name(self) -> str: ...

    def answer(self, parts: Sequence[Part]) -> str: ...


class Answer(BaseModel):
    """Base of answer schemas. Unlike configuration, keys that a model adds (a forbidden "verdict") carry no weight."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    REQUIRED: ClassVar[tuple[str, ...]] = ()


AnswerText = Annotated[str, BeforeValidator(lambda value: "" if value is None else value)]


def parse_answer[T: Answer](schema: type[T], answer: str) -> tuple[T, bool]:
    """The first JSON object in ``answer`` that fits ``schema``, and whether there was one.

    Prose and code fences around the object are tolerated. Wrong types are not ("true" in quotes is no fact), nor is an
    object that lacks one of the schema's REQUIRED keys.

    Returns:
        (parsed, True), or (the schema's defaults, False) when no object fits.
    """
    for candidate in _objects(answer[:MAX_ANSWER_CHARACTERS]):
        if all(name in candidate for name in schema.REQUIRED):
            try:
                return schema.model_validate(candidate), True
            except ValidationError:
                continue
    return schema(), False


def _objects(text: str) -> Iterator[dict[str, Any]]:
    """Every JSON object that starts somewhere in ``text``, outermost first."""
    decoder = json.JSONDecoder()
    start = text.find("{")
    while start >= 0:
        try:
            value, end = decoder.raw_decode(text, start)
        except RecursionError:
            return
        except ValueError:  # no JSON, or a number of thousands of digits
            start = text.find("{", start + 1)
            continue
        yield value
        start = text.find("{", end)


class VLMConfig(StrictModel):
    """A local Qwen3-VL folder, or a server. A key is never configured: only the variable that holds it."""

    weights: Path | None = Field(default=None, description="local Qwen3-VL folder")
    url: str | None = Field(default=None, description="OpenAI-compatible server, up to and with /v1")
    model: str = Field(default="Qwen/Qwen3-VL-8B-Instruct", description="the server's name of the model")
    api_key_variable: str = "OPENAI_API_KEY"
    timeout_s: float = Field(default=120.0, gt=0, description="for a whole answer")
    attempts: int = Field(default=3, ge=1)

    @field_validator("url")
    @classmethod
    def _no_credentials(cls, url: str | None) -> str | None:
        if url is not None and carries_credentials(url):
            raise ValueError("the address carries a password or a key, which would be written into manifests")
        return url


def open_vlm(kind: Literal["qwen3_vl", "openai"], config: VLMConfig) -> VisionLanguageModel:
    """The vision-language model that the config names.

    Raises:
        ConfigError: its weights or its address are not configured.
        UnavailableError: the folder has no Qwen3-VL.
    """
    if kind == "qwen3_vl":
        if config.weights is None:
            raise ConfigError("No Qwen3-VL weights configured", next_step="set vlm.weights to a local folder")
        return Qwen3VLModel.load(config.weights)
    if config.url is None:
        raise ConfigError("No server configured", next_step="set vlm.url to an OpenAI-compatible server, up to /v1")
    if urlsplit(config.url).scheme not in ("http", "https"):
        raise ConfigError("Not the address of a server", expected="http://... or https://...", got=config.url)
    return OpenAICompatibleModel(config)


class OpenAICompatibleModel:
    """Greedy chat completions of a server (vLLM, SGLang, a hosted service); videos are sent as their frames, in order.

    Requests that fail on the way (connection, time-out, 429, 5xx) are repeated after `backoff_s`, then twice that, and
    so on. An answer is never asked for a second time because it is badly formed.
    """

    def __init__(self, config: VLMConfig, backoff_s: float = 1.0) -> None:
        self.config = config
        self.name = config.model
        self.url = f"{config.url}".rstrip("/") + "/chat/completions"
        self.backoff_s = backoff_s

    def answer(self, parts: Sequence[Part]) -> str:
        """The model's text.

        Raises: UnavailableError when the server cannot be reached, refuses, or answers with something else.
        """
        body = {
            "model": self.name,
            "messages": [{"role": "user", "content": [item for part in parts for item in _content(part)]}],
            "temperature": 0.0,
            "max_tokens": MAX_NEW_TOKENS,
            "chat_template_kwargs": {"enable_thinking": False},
        }
        reply = self._post(json.dumps(body).encode())
        try:
            text = reply["choices"][0]["message"]["content"]
        except (KeyError, IndexError, TypeError) as error:
            raise UnavailableError(
                "The judge's server answered in another form", where=self.url, expected="choices[0].message.content"
            ) from error
        return text if isinstance(text, str) else ""

    def _post(self, body: bytes) -> Any:
        key = os.environ.get(self.config.api_key_variable)
        headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {key}"} if key else {})
        request = urllib.request.Request(self.url, data=body, headers=headers, method="POST")  # noqa: S310 (scheme checked)
        reason = ""
        for attempt in range(self.config.attempts):
            if attempt:
                time.sleep(self.backoff_s * 2 ** (attempt - 1))
            try:
                status, answer = _within(self.config.timeout_s, lambda: _exchange(request, self.config.timeout_s))
            except (OSError, http.client.HTTPException) as error:
                reason = f"{type(error).__name__}: {error}"
                continue
            if status == 200:
                return self._json(answer)
            reason = f"HTTP {status}: {answer[:500].decode(errors='replace')}"
            if status not in _TRANSIENT_STATUS:
                break
        raise UnavailableError(
            "The judge's server cannot be used",
            where=self.url,
            got=reason.replace(key, HIDDEN) if key else reason,  # servers quote the key that they refuse
            next_step="start the server, check the address and the model's name, or choose judge: measured",
        )

    def _json(self, answer: bytes) -> Any:
        try:
            if len(answer) > MAX_ANSWER_BYTES:
                raise ValueError(f"more than {MAX_ANSWER_BYTES:,} bytes")
            return json.loads(answer)
        except (ValueError, RecursionError) as error:
            raise UnavailableError(
                "The judge's server did not answer with JSON", where=self.url, got=str(error)
            ) from error


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Another address would be sent the key, and the pictures, that this one was trusted with."""

    def redirect_request(self, req: Any, fp: Any, code: Any, msg: Any, headers: Any, newurl: Any) -> None:
        """No request."""


def _exchange(request: urllib.request.Request, timeout_s: float) -> tuple[int, bytes]:
    """Status and body, of which one byte more than allowed is read at most."""
    try:
        with urllib.request.build_opener(_NoRedirect).open(request, timeout=timeout_s) as response:
            return response.status, response.read(MAX_ANSWER_BYTES + 1)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read(500)


def _within[T](seconds: float, action: Callable[[], T]) -> T:
    """What an action gives; a server that sends a byte now and then never reaches a socket's time-out.

    Raises: TimeoutError; the action is left to itself. What the action raises.
    """
    done: queue.SimpleQueue[T | Exception] = queue.SimpleQueue()

    def work() -> None:
        try:
            done.put(action())
        except Exception as error:  # noqa: BLE001  # raised by the caller's thread
            done.put(error)

    threading.Thread(target=work, daemon=True, name="request").start()
    try:
        found = done.get(timeout=seconds)
    except queue.Empty:
        raise TimeoutError(f"no whole answer within {seconds:g} s") from None
    if isinstance(found, Exception):
        raise found
    return found


def _content(part: Part) -> list[dict[str, Any]]:
    """A part as a server is sent it: pictures as PNG."""
    if isinstance(part, Text):
        return [{"type": "text", "text": part.text}]
    found = []
    for pixels in [part.pixels] if isinstance(part, Image) else part.frames:
        png = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1]
        url = "data:image/png;base64," + base64.b64encode(png.tobytes()).decode()
        found.append({"type": "image_url", "image_url": {"url": url}})
    return found


class Qwen3VLModel:
    """One user message in, greedy text out; there is no system prompt and no thinking.

    Args:
        model, processor: a Qwen3VLForConditionalGeneration and its Qwen3VLProcessor (transformers).
    """

    def __init__(self, model: Any, processor: Any, name: str = "qwen3-vl") -> None:
        self.model = model.eval()
        self.processor = processor
        self.name = name

    @classmethod
    def load(cls, folder: Path) -> Qwen3VLModel:
        """Open weights from a local folder in BF16; nothing is downloaded.

        Raises: UnavailableError when the folder has no Qwen3-VL.
        """
        if not (folder / "config.json").is_file():
            raise UnavailableError(
                "Qwen3-VL weights not found",
                where=folder,
                expected="a downloaded Qwen/Qwen3-VL-8B-Instruct folder with config.json",
                next_step="download it, use judge: openai with a server, or judge: measured",
            )
        from transformers import AutoProcessor, Qwen3VLForConditionalGeneration

        try:
            model = Qwen3VLForConditionalGeneration.from_pretrained(folder, dtype=torch.bfloat16, local_files_only=True)
            processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError) as error:
            raise UnavailableError("Qwen3-VL weights cannot be opened", where=folder, got=str(error)) from error
        device = "cuda" if torch.cuda.is_available() else "cpu"
        return cls(cast(Any, model).to(device), processor, folder.name)

    @torch.inference_mode()
    def answer(self, parts: Sequence[Part]) -> str:
        """Greedy text of at most MAX_NEW_TOKENS tokens."""
        kinds = {Text: "text", Image: "image", Video: "video"}
        content = [{"type": kinds[type(p)]} | ({"text": p.text} if isinstance(p, Text) else {}) for p in parts]
        images = [rearrange(torch.from_numpy(p.pixels.copy()), "h w c -> c h w") for p in parts if isinstance(p, Image)]
        shown = [part for part in parts if isinstance(part, Video)]
        videos = [rearrange(torch.from_numpy(video.frames.copy()), "n h w c -> n c h w") for video in shown]
        # Times of the chosen frames, from which the processor writes its time stamps.
        metadata = [
            {
                "fps": video.fps,
                "total_num_frames": video.total_frames,
                "frames_indices": list(video.indices),
                "duration": video.total_frames / video.fps,
            }
            for video in shown
        ]
        thinks = "enable_thinking" in str(self.processor.chat_template)  # a template that lacks the word gets a warning
        text = self.processor.apply_chat_template(
            [{"role": "user", "content": content}],
            tokenize=False,
            add_generation_prompt=True,
            **({"enable_thinking": False} if thinks else {}),
        )
        inputs = self.processor(
            text=[text],
            images=images or None,
            videos=videos or None,
            # Frames were chosen already: sampling again would show others, at times that do not fit them.
            **({"video_metadata": metadata, "do_sample_frames": False} if videos else {}),
            return_tensors="pt",
        ).to(self.model.device)
        tokens = self.model.generate(**inputs, do_sample=False, max_new_tokens=MAX_NEW_TOKENS)
        new = tokens[:, inputs["input_ids"].shape[1] :]
        return self.processor.batch_decode(new, skip_special_tokens=True, clean_up_tokenization_spaces=False)[0]
