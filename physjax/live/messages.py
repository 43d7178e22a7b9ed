"""Messages between a live view and its page: JSON, and the arrays in it as bytes behind it."""

import json
import struct
from typing import Any

import numpy as np

from physjax.live.pictures import list_arrays

ALIGNMENT_BYTES = 8
"""Arrays begin at multiples of this, so that a page can look at them where they are."""


def split_message(message: dict[str, Any]) -> tuple[dict[str, Any], list[bytes]]:
    """A message without its arrays, and their bytes in the order of their numbers."""
    content, arrays = list_arrays(message)
    return content, [array.tobytes() for array in arrays]


def pack_message(message: dict[str, Any]) -> bytes:
    """A message as bytes: the length of the whole, of the text, the text, and the arrays; each padded to 8 bytes.

    The header of the text, `{"message": ..., "spans": [[start, bytes], ...]}`, says where the arrays are behind it.
    """
    content, parts = split_message(message)
    ends = np.cumsum([0] + [_pad(len(part)) for part in parts])
    spans = [[int(start), len(part)] for start, part in zip(ends[:-1], parts, strict=True)]
    text = json.dumps({"message": content, "spans": spans}, separators=(",", ":")).encode()
    text += b" " * (_pad(len(text)) - len(text))
    body = b"".join(part + bytes(_pad(len(part)) - len(part)) for part in parts)
    return struct.pack("<II", 8 + len(text) + len(body), len(text)) + text + body


def _pad(length: int) -> int:
    return -(-length // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


__all__ = ["pack_message", "split_message"]
