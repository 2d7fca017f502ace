"""XML of a stranger (URDF, Collada): no document type, so no entities; as many elements as a robot's model has."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from recordings.bounded.limits import DEEPEST, MOST_NODES, MOST_XML_BYTES
from recordings.errors import BadInput


class _Builder(ET.TreeBuilder):
    """Builds the tree, and refuses before it grows beyond measure."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = self._count = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(f"it declares the document type {name[:40]!r}, which may multiply entities; wanted none")

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        self._depth += 1
        self._count += 1
        if self._depth > DEEPEST or self._count > MOST_NODES:
            raise ValueError(f"more than {DEEPEST} levels or {MOST_NODES} elements")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        self._depth -= 1
        return super().end(tag)


def read_xml(path: Path, what: str) -> ET.Element:
    """The root element. Raises BadInput, naming `what` it should have been."""
    try:
        if path.stat().st_size > MOST_XML_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes; wanted at most {MOST_XML_BYTES}")
        return ET.parse(path, ET.XMLParser(target=_Builder())).getroot()
    except (OSError, ET.ParseError, ValueError, LookupError) as wrong:
        raise BadInput(f"{path}: cannot be read as {what} ({wrong})") from wrong
