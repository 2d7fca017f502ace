"""The JSON documents of a session: read with every doubt, whatever is wrong with them a plain message."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recordings.errors import BadInput, DamagedFile

FORMAT_VERSION = 1


def as_dict(value: object) -> dict[str, Any]:
    """A JSON object as it is, anything else as an empty one: for reports about files that may be damaged."""
    return dict(value) if isinstance(value, Mapping) else {}


def json_object(text: str | bytes) -> dict[str, Any]:
    """A text that should be a JSON object; an empty one where it is not."""
    try:
        return as_dict(json.loads(text))
    except (ValueError, RecursionError):
        return {}


def read_document(path: Path) -> Mapping[str, Any]:
    """session.json, checked for its version. Raises BadInput."""
    try:
        data = path.read_bytes()
    except OSError as refused:
        raise BadInput(f"{path} cannot be read: {refused.strerror}") from refused
    return parse_document(data, str(path))


def parse_document(data: bytes, name: str) -> Mapping[str, Any]:
    """A document whose version this tosslab reads. Raises BadInput."""
    document = parse_json(data, name)
    if not isinstance(document, dict) or document.get("format_version") != FORMAT_VERSION:
        found = document.get("format_version") if isinstance(document, dict) else type(document).__name__
        raise BadInput(f"{name}: format_version {found!r}; this tosslab reads {FORMAT_VERSION}")
    return document


def parse_json(data: bytes | str, name: str) -> Any:
    """Raises DamagedFile."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as wrong:
        raise DamagedFile(f"{name} is no readable JSON ({wrong})") from wrong


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
