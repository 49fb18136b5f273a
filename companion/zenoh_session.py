"""Zenoh's session, from keys, a configuration file and the usual flags."""

from __future__ import annotations

from dataclasses import dataclass

import zenoh

from trueflight.models import access
from trueflight.models.access import Keys
from trueflight.models.errors import InputError
from trueflight.models.session import (
    CONNECT,
    ENCRYPTED,
    LISTEN,
    Claim,
    claim,
    claims_of_settings,
    configuration,
    controlled,
    endpoints,
    exposed,
    mode_of,
    protocol,
    short,
)

LOCAL, WITH_KEYS = "tcp/127.0.0.1:7447", "tls/0.0.0.0:7447"
"""Where the companion listens when nobody says where: without keys this machine alone, with keys everywhere."""

INSECURE = "insecure: anybody on the network can read, fly and deploy"

MOST_BYTES = 8 << 20
"""The longest message that Zenoh puts together for us; a longer one falls there, before it takes memory here."""


@dataclass(frozen=True)
class ZenohSettings:
    """How to reach the ground: as Zenoh's own `-m -e -l -c --cfg`.

    `cfg` holds `KEY:VALUE` pairs, VALUE in JSON5. No router is needed and none is looked for: multicast
    scouting is off unless the file or `cfg` turns it on. Without keys, what another machine could reach needs
    `insecure`.
    """

    mode: str = ""
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str = ""
    cfg: tuple[str, ...] = ()
    insecure: bool = False


@dataclass(frozen=True)
class Plan:
    """What will be opened: Zenoh's configuration, where it listens and connects to, what is open to anybody.

    `loose` is what a person should know who believes it closed: TLS of one's own without access control.
    """

    config: zenoh.Config
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    exposed: tuple[str, ...]
    loose: str = ""

    @property
    def ends(self) -> str:
        """The endpoints, for people."""
        return ", ".join((*self.listen, *self.connect)) or "no endpoint"


def plan_session(settings: ZenohSettings, keys: Keys | None = None, vehicle: str = "") -> Plan:
    """What `open_session` would open; opens nothing.

    Raises `InputError` where settings contradict each other or the keys, and where another machine could get in
    without keys and `insecure` is not set.
    """
    given = claims_of_settings(
        "the setting [zenoh]", settings.mode, settings.connect, settings.listen, settings.cfg
    )
    otherwise = [
        claim(LISTEN, [WITH_KEYS if keys else LOCAL], ""),
        claim("scouting/multicast/enabled", False, ""),
        # Cached ticks and events are asked for by age.
        claim("timestamping/enabled", True, ""),
        claim("transport/link/rx/max_message_size", MOST_BYTES, ""),
    ]
    if keys is not None:
        given += _with_keys(settings, keys, vehicle)
    config = configuration(settings.config, given, otherwise)
    listen, connect = endpoints(config, LISTEN), endpoints(config, CONNECT)
    if keys is not None:
        mode = mode_of(config)
        if mode != "peer" or connect:
            what = f"connecting to {connect[0]}" if connect else f"mode {mode}"
            raise InputError(
                f"{what} contradicts the keys in {keys.folder}: with keys the companion is a peer that "
                "listens, and the ground connects; leave it out"
            )
        for end in (*listen, *connect):
            if protocol(end) not in ENCRYPTED:
                raise InputError(
                    f"{end} is not encrypted, which contradicts the keys in {keys.folder}: write "
                    f"tls/{end.partition('/')[2]}, or leave the keys out"
                )
    ways = () if keys is not None else tuple(exposed(config))
    if ways and not settings.insecure:
        raise InputError(
            f"without keys the companion {' and '.join(ways)}, where anybody on the network could fly the vehicle: "
            "make keys (`groundstation keys`) and pass --keys FOLDER, or say --insecure if you mean it"
        )
    reachable = any(protocol(end) in ENCRYPTED for end in (*listen, *connect))
    loose = ""
    if keys is None and reachable and not controlled(config):
        loose = "whoever has a certificate may do everything: the configuration has no access control"
    return Plan(config, tuple(listen), tuple(connect), ways, loose)


def open_session(settings: ZenohSettings, keys: Keys | None = None, vehicle: str = "") -> zenoh.Session:
    """Open the session; raises `InputError` as `plan_session`, and for a port in use."""
    return open_planned(plan_session(settings, keys, vehicle))


def open_planned(plan: Plan) -> zenoh.Session:
    """Open what was planned; raises `InputError` with the endpoints that were tried."""
    try:
        return zenoh.open(plan.config)
    except zenoh.ZError as error:
        raise InputError(
            f"cannot open the Zenoh session on {plan.ends} ({short(error)}); is another companion running? "
            "Choose another port with -l"
        ) from None


def _with_keys(settings: ZenohSettings, keys: Keys, vehicle: str) -> list[Claim]:
    if keys.role != access.VEHICLE:
        raise InputError(
            f"{keys.folder}: keys of {keys.name}, {keys.role}; a companion needs the folder vehicle-NAME of "
            "`groundstation keys`"
        )
    if vehicle and vehicle != keys.name:
        raise InputError(
            f"{keys.folder}: keys of the vehicle '{keys.name}', but the vehicle file says '{vehicle}'; make keys for "
            f"it: groundstation keys FOLDER --vehicle {vehicle}"
        )
    if settings.insecure:
        raise InputError(f"--insecure contradicts the keys in {keys.folder}; leave one of them out")
    return [claim(path, value, f"keys '{keys.folder}'") for path, value in access.transport(keys).items()]
