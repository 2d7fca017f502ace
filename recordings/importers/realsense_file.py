"""What a RealSense recording holds, read from its container: the SDK does not say how many frames there are to come."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from recordings.errors import BadInput

IMAGES = re.compile(r"/device_0/sensor_(\d+)/(Depth|Color)_0/image/data")


@dataclass(frozen=True)
class Recorded:
    """`counts`: images by kind (color, depth). `first_sensor`: the number of the sensor that the first image is of."""

    counts: dict[str, int]
    first_sensor: int


def recorded(path: Path) -> Recorded:
    """Count the colour and depth images of a .bag or .db3. Raises BadInput where there are none or it is damaged."""
    rows = _rows_of_db3(path) if path.suffix == ".db3" else _rows_of_bag(path)
    counts: dict[str, int] = {}
    first: tuple[int, int] | None = None
    for topic, count, order in rows:
        found = IMAGES.match(topic)
        if found is None or count == 0:
            continue
        kind = found[2].lower()
        counts[kind] = counts.get(kind, 0) + count
        first = min(first or (order, int(found[1])), (order, int(found[1])))
    if first is None:
        raise BadInput(f"{path} holds no colour or depth images")
    return Recorded(counts, first[1])


def _rows_of_db3(path: Path) -> list[tuple[str, int, int]]:
    """(topic, count, place of its first message)."""
    from recordings.importers.ros_bounds import check_sqlite

    query = (
        "select t.name, count(*), min(m.timestamp) from messages m join topics t on t.id = m.topic_id group by t.name"
    )
    try:
        check_sqlite(path)
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
            return [(str(name), int(count), int(first)) for name, count, first in database.execute(query)]
    except sqlite3.Error as wrong:
        raise BadInput(f"{path} cannot be read as a recording in SQLite ({wrong}); is it whole?") from wrong


def _rows_of_bag(path: Path) -> Iterable[tuple[str, int, int]]:
    from recordings.importers.ros_bounds import BoundedBag1

    rows: dict[str, tuple[str, int, int]] = {}
    try:
        with BoundedBag1(path) as bag:
            images = [c for c in bag.connections if IMAGES.match(c.topic)]
            for order, (connection, _, _) in enumerate(bag.messages(connections=images)):
                _, count, first = rows.get(connection.topic, ("", 0, order))
                rows[connection.topic] = (connection.topic, count + 1, first)
    except Exception as wrong:  # rosbags raises its own, the decompressors' and struct's errors
        raise BadInput(
            f"{path} cannot be read as a ROS 1 bag ({' '.join(str(wrong).split())[:200]}); is it whole?"
        ) from wrong
    return rows.values()
