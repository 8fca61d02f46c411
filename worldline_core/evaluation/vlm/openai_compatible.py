"""A vision-language model behind an OpenAI-compatible chat server (vLLM, SGLang, a hosted service)."""

from __future__ import annotations

import base64
import json
import os
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.evaluation.vlm.message import MAX_NEW_TOKENS, Image, Part, Text

_TRANSIENT_STATUS = frozenset({408, 429, 500, 502, 503, 504})


class OpenAICompatibleModel:
    """Greedy chat completions; videos are sent as their frames, in order.

    Args:
        base_url: up to and with ``/v1``.
        api_key_variable: name of the environment variable that holds the key; the key itself is never stored.
        attempts: tries for requests that fail on the way (connection, time-out, 429, 5xx). An answer is never asked
            for a second time because it is badly formed.
    """

    def __init__(
        self,
        base_url: str,
        model: str,
        *,
        api_key_variable: str = "OPENAI_API_KEY",
        timeout_s: float = 120.0,
        attempts: int = 3,
        backoff_s: float = 1.0,
    ) -> None:
        if urlsplit(base_url).scheme not in ("http", "https"):
            raise ConfigError("Not the address of a server", expected="http://... or https://...", got=base_url)
        self.url = base_url.rstrip("/") + "/chat/completions"
        self.model = model
        self.api_key_variable = api_key_variable
        self.timeout_s = timeout_s
        self.attempts = attempts
        self.backoff_s = backoff_s

    @property
    def name(self) -> str:
        return self.model

    def answer(self, parts: Sequence[Part]) -> str:
        """The model's text.

        Raises: UnavailableError when the server cannot be reached, refuses, or answers with something else.
        """
        body = {
            "model": self.model,
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
        headers = {"Content-Type": "application/json"}
        key = os.environ.get(self.api_key_variable)
        if key:
            headers["Authorization"] = f"Bearer {key}"
        reason = ""
        for attempt in range(self.attempts):
            if attempt:
                time.sleep(self.backoff_s * 2 ** (attempt - 1))
            request = urllib.request.Request(self.url, data=body, headers=headers, method="POST")  # noqa: S310 (scheme checked)
            try:
                with urllib.request.urlopen(request, timeout=self.timeout_s) as response:  # noqa: S310
                    return json.loads(response.read())
            except urllib.error.HTTPError as error:
                reason = f"HTTP {error.code}: {error.read(500).decode(errors='replace')}"
                if error.code not in _TRANSIENT_STATUS:
                    break
            except (OSError, TimeoutError) as error:
                reason = str(error)
            except json.JSONDecodeError as error:
                raise UnavailableError(
                    "The judge's server did not answer with JSON", where=self.url, got=str(error)
                ) from error
        raise UnavailableError(
            "The judge's server cannot be used",
            where=self.url,
            got=reason,
            next_step="start the server, check the address and the model's name, or choose judge: measured",
        )


def _content(part: Part) -> list[dict[str, Any]]:
    if isinstance(part, Text):
        return [{"type": "text", "text": part.text}]
    if isinstance(part, Image):
        return [_image_url(part.pixels)]
    return [_image_url(frame) for frame in part.frames]


def _image_url(pixels: np.ndarray) -> dict[str, Any]:
    encoded, png = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
    if not encoded:
        raise UnavailableError("A frame cannot be encoded as PNG", got=str(pixels.shape))
    return {
        "type": "image_url",
        "image_url": {"url": "data:image/png;base64," + base64.b64encode(png.tobytes()).decode()},
    }
