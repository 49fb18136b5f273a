"""The messages of a ROS 2 bag in SQLite (`.db3`), as `ros2 bag record` wrote them until MCAP became its default.

Tables `topics`, `messages`, and, from Iron on, `message_definitions`: rosbag2_storage_sqlite3. Older bags hold no
definitions; those of ROS' own messages are then taken from rosbags.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ZSTANDARD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class BagTopic:
    """A topic: its number, name and type, and the definition of that type; '' where nothing tells it."""

    number: int
    name: str
    kind: str
    definition: str


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A bag opened to be read, whoever else has it open. Raises `sqlite3.Error` for what is none."""
    changes = path.with_name(f"{path.name}-wal")
    # where nobody has a log of changes open, SQLite would leave an empty one beside the bag
    alone = "" if changes.exists() else "&immutable=1"
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{alone}", uri=True)
    try:
        try:
            connection.execute("SELECT count(*) FROM topics")
        except sqlite3.OperationalError:  # beside a log of changes in a folder that cannot be written to
            connection.close()
            connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        yield connection
    finally:
        connection.close()


def topics(bag: sqlite3.Connection) -> list[BagTopic]:
    """The topics of a bag that are in ROS' own encoding."""
    rows = bag.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    tables = {name for (name,) in bag.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    told: dict[str, str] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        told = {kind: text for kind, encoding, text in bag.execute(query) if encoding == "ros2msg" and text}
    return [
        BagTopic(int(number), str(name), str(kind), told.get(kind) or _standard(str(kind)))
        for number, name, kind, encoding in rows
        if encoding == "cdr"
    ]


def messages(bag: sqlite3.Connection, wanted: list[int]) -> Iterator[tuple[int, int, bytes]]:
    """Number of the topic, time of receipt (us) and bytes of every message of these topics."""
    places = ", ".join("?" * len(wanted))
    query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places})"
    for number, received, data in bag.execute(query, wanted):
        yield number, received // 1000, _unpacked(bytes(data))


def _unpacked(data: bytes) -> bytes:
    """A message as it was before `--compression-mode message`."""
    if not data.startswith(ZSTANDARD):
        return data
    import zstandard

    return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=64 << 20))


def _standard(kind: str) -> str:
    """The definition of one of ROS' own messages; '' for any other."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    return str(store.generate_msgdef(kind, ros_version=2)[0]) if kind in store.types else ""
