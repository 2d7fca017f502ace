"""The JSON documents of a session: read with every doubt, whatever is wrong with them a plain message."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recordings.bounded.limits import DEEPEST, MOST_DOCUMENT_BYTES, read_bytes
from recordings.errors import BadInput, DamagedFile

FORMAT_VERSION = 1


def as_dict(value: object) -> dict[str, Any]:
    """A JSON object as it is, anything else as an empty one: for reports about files that may be damaged."""
    return dict(value) if isinstance(value, Mapping) else {}


def tuples(value: Any) -> Any:
    """A JSON value as frozen records have it: tuples for lists."""
    return tuple(tuples(x) for x in value) if isinstance(value, list) else value


def json_object(text: str | bytes) -> dict[str, Any]:
    """A text that should be a JSON object; an empty one where it is not."""
    try:
        return as_dict(parse_json(text, ""))
    except DamagedFile:
        return {}


def read_document(path: Path) -> Mapping[str, Any]:
    """session.json, checked for its version. Raises BadInput."""
    return _versioned(read_json(path), str(path))


def parse_document(data: bytes, name: str) -> Mapping[str, Any]:
    """A document whose version this tosslab reads. Raises BadInput."""
    return _versioned(parse_json(data, name), name)


def _versioned(document: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(document, dict) or document.get("format_version") != FORMAT_VERSION:
        found = document.get("format_version") if isinstance(document, dict) else type(document).__name__
        raise BadInput(f"{name}: format_version {found!r}; this tosslab reads {FORMAT_VERSION}")
    return document


def parse_json(data: bytes | str, name: str) -> Any:
    """A JSON text, of a size and depth that documents have. Raises DamagedFile."""
    if len(data) > MOST_DOCUMENT_BYTES:
        raise DamagedFile(f"{name} is a JSON document of {len(data)} bytes; wanted at most {MOST_DOCUMENT_BYTES}")
    too_deep = f"{name} is no readable JSON: it is nested deeper than {DEEPEST} levels"
    try:
        value = json.loads(data)
    except RecursionError as wrong:
        raise DamagedFile(too_deep) from wrong
    except ValueError as wrong:
        raise DamagedFile(f"{name} is no readable JSON ({wrong})") from wrong
    if not _within_depth(value):
        raise DamagedFile(too_deep)
    return value


def read_json(path: Path, next_step: str = "") -> Any:
    """A JSON file. Raises BadInput where it cannot be opened, DamagedFile where it is none; `next_step` ends both."""
    try:
        return parse_json(read_bytes(path, MOST_DOCUMENT_BYTES, "a JSON document"), str(path))
    except OSError as refused:
        raise BadInput(f"{path} cannot be read ({refused.strerror}){next_step}") from refused
    except ValueError as wrong:
        raise DamagedFile(f"{path} is {wrong}{next_step}") from wrong
    except DamagedFile as wrong:
        raise DamagedFile(f"{wrong}{next_step}") from wrong


def _within_depth(value: Any) -> bool:
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(DEEPEST):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return True
    return False


def mapping(value: Any, name: str) -> Mapping[str, Any]:
    """A JSON object; null and nothing are an empty one. Raises DamagedFile."""
    if not isinstance(value or {}, dict):
        raise DamagedFile(f"{name} is {type(value).__name__} {str(value)[:40]!r}; wanted a JSON object")
    return value or {}


def whole_number(value: Any, name: str) -> int:
    """Raises DamagedFile."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise DamagedFile(f"{name} is {str(value)[:40]!r}; wanted a whole number")
    return value


def positive_number(text: str, name: str) -> float:
    """Raises DamagedFile."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise DamagedFile(f"{name} is {text[:40]!r}; wanted a positive number")
    return value
