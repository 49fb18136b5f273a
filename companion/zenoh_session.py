"""Zenoh's session, from a configuration file and the usual flags."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import zenoh

from models.errors import InputError


@dataclass(frozen=True)
class ZenohSettings:
    """How to reach the ground: as Zenoh's own `-m -e -l -c --cfg`.

    `cfg` holds `KEY:VALUE` pairs, VALUE in JSON5. No router is needed and none is looked for: multicast
    scouting is off unless the file or `cfg` turns it on.
    """

    mode: str = ""
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    config: str = ""
    cfg: tuple[str, ...] = ()


def open_session(settings: ZenohSettings) -> zenoh.Session:
    """Open the session; raises `InputError` for a setting that Zenoh does not take and for a port in use."""
    if settings.config:
        try:
            config = zenoh.Config.from_file(Path(settings.config))
        except zenoh.ZError as error:
            raise InputError(f"{settings.config}: not a Zenoh configuration ({_short(error)})") from None
    else:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
    # Cached ticks and events are asked for by age.
    config.insert_json5("timestamping/enabled", "true")
    pairs = [
        (name, json.dumps(list(ends)))
        for name, ends in (("connect", settings.connect), ("listen", settings.listen))
        if ends
    ]
    inserts = [(f"{name}/endpoints", value) for name, value in pairs]
    if settings.mode:
        inserts.append(("mode", json.dumps(settings.mode)))
    for pair in settings.cfg:
        key, colon, value = pair.partition(":")
        if not colon:
            raise InputError(f"--cfg '{pair}': write KEY:VALUE, such as transport/link/tx/queue/size/data:4")
        inserts.append((key.strip(), value.strip()))
    for key, value in inserts:
        try:
            config.insert_json5(key, value)
        except zenoh.ZError as error:
            raise InputError(f"Zenoh does not take {key} = {value} ({_short(error)})") from None
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        ends = ", ".join(settings.listen) or "its endpoints"
        raise InputError(
            f"cannot open the Zenoh session on {ends} ({_short(error)}); is another companion running? "
            "Choose another port with -l"
        ) from None


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
