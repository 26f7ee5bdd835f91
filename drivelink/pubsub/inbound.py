"""Validates all input from the network.

Everything from the network passes here before a client, view or recorder uses it. Binary messages have the
length of their layout. JSON documents are limited in bytes, depth, elements and text; their numbers are
finite, and their texts contain no control or direction characters and no half surrogates.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from drivelink.errors import ZenohError
from drivelink.plaintext import clean_text
from drivelink.pubsub.wire import decode_estimate, decode_external, decode_sample

MAX_BYTES = 1 << 20  # of a document; a status has some 3 kB, a model with its nodes some 10 kB
MAX_DEPTH = 16
MAX_ELEMENTS = 20_000  # numbers, texts and containers of a document
MAX_KEY = 256  # characters of a name
_LARGEST_INTEGER = 1 << 64
_TOO_DEEP = f"document: expected at most {MAX_DEPTH} levels"


def decode_document(payload: bytes) -> dict[str, Any]:
    """Read a JSON document: `status`, `model`, `finding`.

    Non-finite numbers and integers beyond 64 bits become None.

    Raises:
        ZenohError: it is too large, too deep, or not a JSON object.
    """
    if len(payload) > MAX_BYTES:
        raise ZenohError(f"document: expected at most {MAX_BYTES} bytes, got {len(payload)}")
    try:
        document = json.loads(payload.decode("utf-8"))
    except RecursionError:
        raise ZenohError(_TOO_DEEP) from None
    except ValueError as error:
        raise ZenohError("document: expected JSON in UTF-8") from error
    if not isinstance(document, dict):
        raise ZenohError("document: expected a JSON object")
    cleaned: dict[str, Any] = _Cleaner().clean(document, 0)
    return cleaned


class _Cleaner:
    """Makes a parsed document safe, counting its elements."""

    def __init__(self) -> None:
        self._left = MAX_ELEMENTS

    def clean(self, value: Any, depth: int) -> Any:
        """Return the value made safe.

        Raises:
            ZenohError: it has too many elements or levels.
        """
        self._left -= 1
        if self._left < 0:
            raise ZenohError(f"document: expected at most {MAX_ELEMENTS} elements")
        if isinstance(value, str):
            return clean_text(value)
        if isinstance(value, bool) or value is None:
            return value
        if isinstance(value, int):
            return value if abs(value) <= _LARGEST_INTEGER else None
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if depth == MAX_DEPTH:
            raise ZenohError(_TOO_DEEP)
        if isinstance(value, list):
            return [self.clean(item, depth + 1) for item in value]
        return {clean_text(key, MAX_KEY): self.clean(item, depth + 1) for key, item in value.items()}


# The payloads of a joint's keys, by the last part of the key.
DECODERS: Mapping[str, Callable[[bytes], Any]] = MappingProxyType(
    {
        "estimate": decode_estimate,
        "external": decode_external,
        "sample": decode_sample,
        "status": decode_document,
        "model": decode_document,
        "finding": decode_document,
    }
)
