"""The licence that a folder of recordings states."""

from __future__ import annotations

import re

from worldline_core.data.guards.source_paths import AnyPath, is_file, regular_file
from worldline_core.untrusted_text import cut, printable, visible

_SPDX = {
    "apache-2.0": "Apache-2.0", "mit": "MIT", "bsd-3-clause": "BSD-3-Clause", "cc0-1.0": "CC0-1.0", "cc-by-4.0": "CC-BY-4.0",
    "cc-by-sa-4.0": "CC-BY-SA-4.0", "cc-by-nc-4.0": "CC-BY-NC-4.0", "cc-by-nc-sa-4.0": "CC-BY-NC-SA-4.0",
}  # fmt: skip
_TEXTS = {
    "apache license": "Apache-2.0", "mit license": "MIT", "attribution-noncommercial-sharealike 4.0": "CC-BY-NC-SA-4.0",
    "attribution-noncommercial 4.0": "CC-BY-NC-4.0", "attribution-sharealike 4.0": "CC-BY-SA-4.0",
    "attribution 4.0": "CC-BY-4.0", "cc0 1.0": "CC0-1.0",
}  # fmt: skip
_IN_CARD = re.compile(r"^licen[cs]e:[ \t]*[\"']?([\w.+-]{2,40})[\"']?[ \t]*$", re.MULTILINE)
_MOST_BYTES = 1 << 16


def stated_licence(root: AnyPath) -> tuple[str, str] | None:
    """(identifier, evidence) by the head of the dataset's card, or by the text of its licence file; None where nothing says."""
    for name in ("README.md", "LICENSE", "LICENSE.md", "LICENSE.txt", "LICENCE"):
        if not is_file(root / name):
            continue
        with regular_file(root / name).open("rb") as file:
            text = file.read(_MOST_BYTES).decode("utf-8", errors="replace")
        if name == "README.md":
            head = text.split("---", 2)[1] if text.startswith("---") and text.count("---") > 1 else ""
            if (found := _IN_CARD.search(head)) is not None:
                said = found[1]
                return _SPDX.get(said.lower(), cut(printable(visible(said)), 40)), "README.md says so"
            continue
        first = " ".join(text[:400].lower().split())
        if (known := next((spdx for words, spdx in _TEXTS.items() if words in first), None)) is not None:
            return known, f"by the text of {name}"
    return None
