"""YAML of a stranger: of a size and depth that configurations have, its aliases counted as if they were written out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from recordings.bounded.limits import DEEPEST, MOST_CONFIG_BYTES, MOST_NODES
from recordings.errors import BadInput

Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def parse_yaml(data: bytes, name: str, prepare: Callable[[str], str] = str) -> Any:
    """A YAML document as plain values; `prepare` may change its text first. Raises BadInput."""
    if len(data) > MOST_CONFIG_BYTES:
        raise BadInput(f"{name} is a YAML file of {len(data)} bytes; wanted at most {MOST_CONFIG_BYTES}")
    try:
        text = prepare(data.decode())
        _check(text, name)
        return yaml.load(text, Loader=Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as wrong:
        raise BadInput(f"{name} is no readable YAML ({' '.join(str(wrong).split())[:300]})") from wrong


def _check(text: str, name: str) -> None:
    """Walk the events, which build nothing. Raises BadInput for what is nested or multiplied beyond measure."""
    open_sizes, anchors, sizes, total = [0], [""], {"": 0}, 0
    for event in yaml.parse(text, Loader=Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            open_sizes.append(1)
            anchors.append(event.anchor or "")
        elif isinstance(event, yaml.CollectionEndEvent):
            size, anchor = open_sizes.pop(), anchors.pop()
            sizes[anchor] = size
            open_sizes[-1] += size
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise BadInput(f"{name}: the alias *{event.anchor} stands within itself, or for nothing")
            open_sizes[-1] += sizes[event.anchor]
            total += sizes[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            sizes[event.anchor or ""] = 1
            open_sizes[-1] += 1
        total += 1
        if len(open_sizes) > DEEPEST:
            raise BadInput(f"{name} is nested deeper than {DEEPEST} levels")
        if total > MOST_NODES:
            raise BadInput(f"{name}: its aliases written out hold more than {MOST_NODES} values")
