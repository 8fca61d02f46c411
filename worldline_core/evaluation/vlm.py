"""Vision-language models: the messages that they are shown, how their answers are read, and the models that there are (a local Qwen3-VL,
or any OpenAI-compatible server).

A model is shown one user message of text, images and videos. Reading its JSON answer is tolerant of what surrounds the object and
strict about its content.
"""

from __future__ import annotations

import base64
import json
import logging
import os
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, cast
from urllib.parse import urlsplit

import cv2
import numpy as np
import torch
from einops import rearrange
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.http_exchange import IncompleteResponseError, UnreachableError, exchange
from worldline_core.processor import bfloat16_by_default
from worldline_core.untrusted_text import cut, visible, without_secret

logger = logging.getLogger(__name__)

MAX_NEW_TOKENS = 256
MAX_ANSWER_CHARACTERS = 20_000
"""Part of an answer that is searched; 256 tokens take some kilobytes."""
PROMPTS: dict[str, str] = tomllib.loads(Path(__file__).with_name("prompts.toml").read_text(encoding="utf-8"))
"""The paper's prompts by name, to be filled by `str.format`."""


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


def _text(value: Any) -> Any:
    # Half characters can be neither stored as UTF-8 nor shown to a tokenizer again.
    return visible(value) if isinstance(value, str) else "" if value is None else value


AnswerText = Annotated[str, BeforeValidator(_text)]


class UnansweredMessageError(UnavailableError):
    """A model gave no answer to this one message; it may answer the next."""


def ask[T: Answer](model: VisionLanguageModel, parts: Sequence[Part], schema: type[T]) -> tuple[T, bool]:
    """Ask a model and read its answer by `parse_answer`; an unanswered message counts as a malformed answer.

    Raises: UnavailableError when the model cannot be used at all.
    """
    try:
        answer = model.answer(parts)
    except UnansweredMessageError as error:
        logger.warning("counted as no evidence: %s", error)
        return schema(), False
    return parse_answer(schema, answer)


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


MAX_ANSWER_BYTES = 1 << 20
"""Limit of a server's whole reply."""
_TRANSIENT_STATUS = frozenset({408, 429, 500, 502, 503, 504})
_REFUSED_STATUS = frozenset({301, 302, 303, 307, 308, 401, 403, 404, 405})
"""Statuses that every message would get: the key, the address or the model's name is wrong."""
_PATIENCE = 3
"""Messages in a row without an answer, after which a server cannot be used."""


def open_vlm(kind: Literal["qwen3_vl", "openai"], config: VLMConfig) -> VisionLanguageModel:
    """The configured model.

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

    Raises: ConfigError for a key that no request can carry.
    """

    def __init__(self, config: VLMConfig, backoff_s: float = 1.0) -> None:
        self.config = config
        self.name = config.model
        self.url = f"{config.url}".rstrip("/") + "/chat/completions"
        self.backoff_s = backoff_s
        self._key = _key(config.api_key_variable)
        self._unanswered_count = 0

    def answer(self, parts: Sequence[Part]) -> str:
        """The model's text.

        Raises:
            UnansweredMessageError: the server has none to this message: it did not answer in time, or with something else.
            UnavailableError: it cannot be reached, refuses the key or the address, or had no answer to several messages
                in a row.
        """
        body = {
            "model": self.name,
            "messages": [{"role": "user", "content": [item for part in parts for item in _content(part)]}],
            "temperature": 0.0,
            "max_tokens": MAX_NEW_TOKENS,
            "chat_template_kwargs": {"enable_thinking": False},
        }
        try:
            text = self._text(self._post(json.dumps(body).encode()))
        except UnansweredMessageError as error:
            self._unanswered_count += 1
            if self._unanswered_count < _PATIENCE:
                raise
            raise self._unusable(f"{error.got}, and no answer to the {_PATIENCE - 1} messages before") from None
        self._unanswered_count = 0
        return text

    def _post(self, body: bytes) -> bytes:
        """The body of a reply of status 200."""
        headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
        headers |= {"Authorization": f"Bearer {self._key}"} if self._key else {}
        reason, there = "", True
        for attempt in range(self.config.attempts):
            if attempt:
                time.sleep(self.backoff_s * 2 ** (attempt - 1))
            try:
                status, answer = exchange(
                    self.url, body, headers=headers, timeout_s=self.config.timeout_s, max_bytes=MAX_ANSWER_BYTES
                )
            except (UnreachableError, IncompleteResponseError) as error:
                reason, there = str(error), isinstance(error, IncompleteResponseError)
                continue
            if status == 200:
                return answer
            reason, there = f"HTTP {status}: {answer.decode(errors='replace')}", status not in _REFUSED_STATUS
            if status not in _TRANSIENT_STATUS:
                break
        raise self._unanswered(reason) if there else self._unusable(reason)

    def _text(self, answer: bytes) -> str:
        try:
            if len(answer) > MAX_ANSWER_BYTES:
                raise ValueError(f"more than {MAX_ANSWER_BYTES:,} bytes")
            text = json.loads(answer)["choices"][0]["message"]["content"]
        except (ValueError, RecursionError, LookupError, TypeError) as error:
            raise self._unanswered(f"no JSON with choices[0].message.content: {error}") from error
        return text if isinstance(text, str) else ""

    def _unanswered(self, reason: str) -> UnansweredMessageError:
        return UnansweredMessageError("The judge's server gave no answer", where=self.url, got=self._hidden(reason))

    def _unusable(self, reason: str) -> UnavailableError:
        return UnavailableError(
            "The judge's server cannot be used",
            where=self.url,
            got=self._hidden(reason),
            next_step="start the server, check the address and the model's name, or choose judge: measured",
        )

    def _hidden(self, reason: str) -> str:
        """Without the key: hidden first, and cut then."""
        return cut(without_secret(reason, self._key), 500)


def _key(variable: str) -> str:
    """The key in a variable, without the white space around it; empty where there is none.

    Raises: ConfigError, which does not show it.
    """
    key = os.environ.get(variable, "").strip()
    if not all("!" <= character <= "~" for character in key):
        raise ConfigError(
            "The judge's key cannot be sent", where=f"the environment variable {variable}",
            expected="letters, digits and signs of ASCII on one line", got=f"{len(key)} characters, some others among them",
        )  # fmt: skip
    return key


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
    """One user message in, greedy text out of a Qwen3VLForConditionalGeneration (transformers), without system prompt and thinking."""

    def __init__(self, model: Any, processor: Any, name: str = "qwen3-vl") -> None:
        self.model = model.eval()
        self.processor = processor
        self.name = name

    @classmethod
    def load(cls, folder: Path) -> Qwen3VLModel:
        """Open weights from a local folder, in float32 on a processor without native bfloat16; nothing is downloaded.

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

        device = "cuda" if torch.cuda.is_available() else "cpu"
        dtype = torch.bfloat16 if bfloat16_by_default({"device": device}) else torch.float32
        try:
            model = Qwen3VLForConditionalGeneration.from_pretrained(folder, dtype=dtype, local_files_only=True)
            processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError) as error:
            raise UnavailableError("Qwen3-VL weights cannot be opened", where=folder, got=str(error)) from error
        return cls(cast(Any, model).to(device), processor, folder.name)

    @torch.inference_mode()
    def answer(self, parts: Sequence[Part]) -> str:
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
