"""Zenoh's configuration from several places that may contradict each other, and who could reach what it opens.

A setting comes from a file of Zenoh's own, from flags and settings, or from a folder of keys. Where two of them
say different things of one setting that is an error, never a silent choice.
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from trueflight.models.errors import InputError, shown

ENCRYPTED = ("tls", "quic")
_LOCAL = ("unixsock-stream", "unixpipe")
LISTEN, CONNECT = "listen/endpoints", "connect/endpoints"
PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "serial", "unixsock-stream", "unixpipe", "vsock")
"""What an endpoint may begin with."""


@dataclass(frozen=True)
class Claim:
    """One setting: its path in Zenoh's configuration, its value in JSON5, and who says so, for people."""

    path: str
    value: str
    who: str


def claims_of(pairs: Iterable[str]) -> list[Claim]:
    """`--cfg` pairs KEY:VALUE as claims. Raises `InputError` for another form."""
    claims = []
    for pair in pairs:
        key, colon, value = pair.partition(":")
        if not colon:
            raise InputError(f"--cfg '{pair}': write KEY:VALUE, such as transport/link/tx/queue/size/data:4")
        claims.append(Claim(key.strip().strip("/"), value.strip(), f"--cfg '{pair}'"))
    return claims


def claims_of_settings(
    told: str, mode: str, connect: Iterable[str], listen: Iterable[str], cfg: Iterable[str]
) -> list[Claim]:
    """What the flags `-m`, `-e`, `-l`, `--cfg`, or the settings of the same meaning, say; `told` names the latter."""
    given = [
        claim(path, value, f"{flag} or {told} {name} = {value}")
        for path, value, flag, name in (
            ("mode", mode, "-m", "mode"),
            (CONNECT, list(connect), "-e", "connect"),
            (LISTEN, list(listen), "-l", "listen"),
        )
        if value
    ]
    return given + claims_of(cfg)


def claim(path: str, value: Any, who: str) -> Claim:
    """A claim of a plain value."""
    return Claim(path, json.dumps(value), who)


def configuration(file: str, given: Sequence[Claim], otherwise: Sequence[Claim] = ()) -> zenoh.Config:
    """The file's configuration (none for ''), what is `given`, and, where nobody says anything, `otherwise`.

    Raises `InputError` for a file or value that Zenoh does not take, and where two say different things.
    """
    config = zenoh.Config()
    if file:
        try:
            config = zenoh.Config.from_file(Path(file))
        except zenoh.ZError as error:
            raise InputError(f"{file}: not a Zenoh configuration ({short(error)})") from None
    for one in given:
        value = _normal(one)
        if file and _says(config, one.path) and _read(config, one.path) != value:
            there = _brief(_read(config, one.path))
            raise InputError(
                f"{one.who} contradicts {file}, where {one.path} = {there}; leave one of them out"
            )
        for other in given:
            if other is one:
                break
            if _overlap(one.path, other.path) and (one.path != other.path or _normal(other) != value):
                raise InputError(
                    f"{one.who} contradicts {other.who}: both set {_outer(one, other)}; leave one of them out"
                )
    said = [one.path for one in given]
    for one in given:
        _insert(config, one)
    for one in otherwise:
        if not any(_overlap(one.path, path) for path in said) and not (file and _says(config, one.path)):
            _insert(config, one)
    return config


def endpoints(config: zenoh.Config, path: str) -> list[str]:
    """The endpoints to listen on or connect to (`LISTEN`, `CONNECT`), for the configured mode."""
    found = _read(config, path)
    if isinstance(found, dict):
        found = found.get(mode_of(config), [])
    listed = found if isinstance(found, list) else [found] if found else []
    return [end if isinstance(end, str) else json.dumps(end) for end in listed]


def mode_of(config: zenoh.Config) -> str:
    """Zenoh's mode: peer, client or router."""
    return str(_read(config, "mode") or "peer")


def mutual(config: zenoh.Config) -> bool:
    """Whether TLS asks the other end for a certificate too, and there is an authority to judge it by."""
    return bool(
        _read(config, "transport/link/tls/enable_mtls")
        and _read(config, "transport/link/tls/root_ca_certificate")
    )


def only_tls(config: zenoh.Config) -> bool:
    """Whether the configuration allows encrypted links alone."""
    protocols = _read(config, "transport/link/protocols")
    return bool(protocols) and all(one in ENCRYPTED for one in protocols)


def controlled(config: zenoh.Config) -> bool:
    """Whether Zenoh's access control denies what it does not name."""
    rules = _read(config, "access_control")
    return bool(rules and rules.get("enabled") and rules.get("default_permission", "deny") == "deny")


def exposed(config: zenoh.Config) -> list[str]:
    """Every way in which somebody without keys could reach this session from another machine, in words."""
    safe = mutual(config)
    ways = []
    for path, what in ((LISTEN, "listens on"), (CONNECT, "connects to")):
        for end in endpoints(config, path):
            if not on_this_machine(end) and not (safe and protocol(end) in ENCRYPTED):
                ways.append(f"{what} {end}")
    if _read(config, "scouting/multicast/enabled") is not False and not (safe and only_tls(config)):
        ways.append("looks for others by multicast and connects to them")
    return ways


def protocol(end: str) -> str:
    """The protocol of an endpoint."""
    return end.partition("/")[0]


def on_this_machine(end: str) -> bool:
    """Whether only this machine can be at the other side of an endpoint."""
    if protocol(end) in _LOCAL:
        return True
    if re.search(r"[?#].*\b(?:bind|iface)=", end):
        return False  # bound to something else than its address says
    host = re.sub(r":\d+$", "", re.split(r"[?#]", end.partition("/")[2])[0]).strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def short(error: Exception) -> str:
    """Zenoh's words for an error, without the names of its types and the places in its source code."""
    text = re.sub(r" at \S*/\S+\.rs:\d+\.?", "", " ".join(str(error).split()))
    if said := re.search(r'(?:Message \{ msg: |^Str\()"((?:[^"\\]|\\.)*)"', text):
        text = re.sub(r"\\(.)", r"\1", said[1])
    return text[:200].rstrip(". ")


def _insert(config: zenoh.Config, one: Claim) -> None:
    if one.path in (LISTEN, CONNECT):
        _check_endpoints(one)
    try:
        config.insert_json5(one.path, one.value)
    except zenoh.ZError as error:
        told = f"{one.who}: " if one.who else ""
        raise InputError(
            f"{told}Zenoh does not take {one.path} = {_brief(one.value)} ({short(error)})"
        ) from None


def _check_endpoints(one: Claim) -> None:
    """Raise `InputError` for an endpoint that is none, before Zenoh says so in words of its own."""
    try:
        said = json.loads(one.value)
    except ValueError:
        return  # JSON5, or nothing: Zenoh judges
    for end in said if isinstance(said, list) else []:
        known = isinstance(end, str) and re.match(r"([a-z0-9-]+)/.", end)
        if isinstance(end, str) and not (known and known[1] in PROTOCOLS):
            raise InputError(
                f"{one.who or one.path}: {shown(end)} is no endpoint; write PROTOCOL/HOST:PORT, such as "
                f"tcp/192.168.1.7:7447 (protocols: {', '.join(PROTOCOLS)})"
            )


def _normal(one: Claim) -> Any:
    """The value as Zenoh reads it."""
    scratch = zenoh.Config()
    _insert(scratch, one)
    value = _read(scratch, one.path)
    return value if value is not None else one.value


def _read(config: zenoh.Config, path: str) -> Any:
    try:
        return json.loads(config.get_json(path))
    except (zenoh.ZError, ValueError):
        return None


_DEFAULTS = zenoh.Config()


def _says(config: zenoh.Config, path: str) -> bool:
    """Whether a file sets `path`: Zenoh leaves nearly everything empty that nobody sets."""
    return bool(_read(config, path) != _read(_DEFAULTS, path))


def _overlap(one: str, other: str) -> bool:
    return f"{one}/".startswith(f"{other}/") or f"{other}/".startswith(f"{one}/")


def _outer(one: Claim, other: Claim) -> str:
    return min(one.path, other.path, key=len)


def _brief(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."
