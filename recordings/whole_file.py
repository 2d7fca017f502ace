"""Files that are there whole or not at all, and their sha256."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recordings.errors import WriteFailed


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Whole or not at all: written beside, synced, renamed."""
    write_bytes(path, json_bytes(document))


def write_bytes(path: Path, data: bytes) -> None:
    """Whole or not at all: written beside, synced, renamed. Raises WriteFailed."""
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        partial.replace(path)
    except OSError as refused:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise WriteFailed(f"{path} could not be written: {refused.strerror}; nothing was changed there") from refused


def file_sha256(path: Path) -> str:
    """Of a file's bytes, in hexadecimal."""
    with open(path, "rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()


def changed_ns(path: Path) -> int | None:
    """When the file was last written; None where it is not there."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def without_nan(value: Any) -> Any:
    """A JSON value as strict JSON has it: null where a number is NaN or infinite, lists for tuples."""
    if isinstance(value, Mapping):
        return {str(key): without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(inner) for inner in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    return float(value) if math.isfinite(value) else None


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """A JSON document as it stands in files."""
    return (json.dumps(document, indent=1) + "\n").encode()
