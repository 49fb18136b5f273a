"""Who may do what over Zenoh, and a folder of keys: what `groundstation keys` makes and both ends are given.

A folder holds `ca.pem` (the authority's certificate), `cert.pem` and `key.pem` (one's own), `access.toml` (who is let
in), and, for an engineer, `signing-key.pem` (Ed25519, for models). The names in certificates are
`NAME.ROLE`, from the second one of the same name on `NAME.ROLE.NUMBER`; Zenoh's access control compares them whole.
"""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trueflight.models.errors import InputError
from trueflight.models.outside import read_toml

ROLES = OBSERVER, OPERATOR, ENGINEER = ("observer", "operator", "engineer")
"""What a person may be, each with the rights of those before."""
VEHICLE = "vehicle"

NEEDS = {"tick": OBSERVER, "event": OBSERVER, "status": OBSERVER, "record": OBSERVER, "mission": OPERATOR,
         "pose": OPERATOR, "model": ENGINEER}  # fmt: skip
"""The least role for each key of a vehicle (`models.contract.key`); what is not named here nobody may."""
_PUBLISHED = ("tick", "event")
_TAKEN = ("pose",)

AUTHORITY, CERTIFICATE, PRIVATE_KEY = "ca.pem", "cert.pem", "key.pem"
SIGNING_KEY, ACCESS = "signing-key.pem", "access.toml"

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,39}")
"""What a vehicle or a person with keys may be called: it stands in certificates, folders and Zenoh keys."""


@dataclass(frozen=True)
class Person:
    """Somebody with keys; `signing_key` is the public Ed25519 key, 64 hexadecimal digits, of engineers alone."""

    name: str
    role: str
    certificate: str
    signing_key: str = ""


@dataclass(frozen=True)
class Keys:
    """A folder of keys as read: whose it is, and whom its owner lets in.

    `vehicles` maps the names of vehicles to the names in their certificates.
    """

    folder: Path
    name: str
    role: str
    certificate: str
    vehicles: dict[str, str]
    people: tuple[Person, ...]

    def path(self, file: str) -> Path:
        """One of the folder's files."""
        return self.folder / file

    def may(self, leaf: str) -> bool:
        """Whether the owner's role is enough for this key of a vehicle."""
        return may(self.role, leaf)


def may(role: str, leaf: str) -> bool:
    """Whether a role is enough for a key of a vehicle; a vehicle has no rights at another one."""
    return role in ROLES and leaf in NEEDS and ROLES.index(role) >= ROLES.index(NEEDS[leaf])


def read_keys(folder: str | Path) -> Keys:
    """The keys in a folder. Raises `InputError` where something is missing, readable by others, or does not fit."""
    folder = Path(folder)
    for name in (AUTHORITY, CERTIFICATE, PRIVATE_KEY, ACCESS):
        path = folder / name
        try:
            mode = path.stat().st_mode
            with path.open("rb"):
                pass
        except OSError as error:
            raise InputError(
                f"keys '{folder}': cannot read {name} ({error.strerror}); pass a folder of `groundstation keys`"
            ) from None
        if name == PRIVATE_KEY:
            _check_private(path, mode)
    signing = folder / SIGNING_KEY
    if signing.exists():
        _check_private(signing, signing.stat().st_mode)
    path = folder / ACCESS
    return _keys(folder, read_toml(path, "the list of who is let in"), str(path))


def _check_private(path: Path, mode: int) -> None:
    if stat.S_IMODE(mode) & 0o077:
        raise InputError(f"{path}: others may read this private key; chmod 600 {path}")


def _keys(folder: Path, table: dict[str, Any], where: str) -> Keys:
    own = table.get("own")
    if not isinstance(own, dict):
        raise InputError(f"{where}: no section [own]; `groundstation keys` writes it")
    name, role, certificate = (_text(own, key, f"{where}: [own]") for key in ("name", "role", "certificate"))
    if role not in (*ROLES, VEHICLE):
        raise InputError(f"{where}: [own] role '{role}' is none of {', '.join((*ROLES, VEHICLE))}")
    vehicles = table.get("vehicles", {})
    people = table.get("people", {})
    if not isinstance(vehicles, dict) or not isinstance(people, dict):
        raise InputError(f"{where}: [vehicles] and [people] must be sections")
    for vehicle in vehicles:
        _text(vehicles, vehicle, f"{where}: [vehicles]")
        checked_name(vehicle, f"{where}: vehicle")
    found = []
    for person, about in people.items():
        place = f"{where}: [people] {person}"
        if not isinstance(about, dict):
            raise InputError(f'{place}: write {{ role = "operator", certificate = "{person}.operator" }}')
        one = Person(
            person,
            _text(about, "role", place),
            _text(about, "certificate", place),
            str(about.get("signing_key", "")),
        )
        if one.role not in ROLES:
            raise InputError(f"{place}: role '{one.role}' is none of {', '.join(ROLES)}")
        if one.signing_key and not re.fullmatch(r"[0-9a-f]{64}", one.signing_key):
            raise InputError(f"{place}: signing_key must be 64 hexadecimal digits")
        found.append(one)
    return Keys(folder, name, role, certificate, dict(vehicles), tuple(found))


def _text(table: dict[str, Any], key: str, where: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(f"{where}: '{key}' must be a text, not {value!r}")
    return value


def certificate_period(path: Path) -> tuple[float, float]:
    """End and begin of a certificate's validity, s since 1970. Raises `ValueError` for a file that is none."""
    from cryptography import x509

    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise ValueError(str(error)) from None
    return certificate.not_valid_after_utc.timestamp(), certificate.not_valid_before_utc.timestamp()


def checked_name(name: str, what: str) -> str:
    """The same, or `InputError` for a name that cannot stand in a certificate, a folder and a Zenoh key."""
    if not NAME.fullmatch(name):
        raise InputError(
            f"{what} '{name}': letters, digits, - _ . + only, at most 40, a letter or digit first"
        )
    return name


def vehicle_rules(keys: Keys) -> dict[str, Any]:
    """Zenoh's `access_control` for the companion: who may read, fly and deploy, by certificate name.

    Everything that is not named is denied, also for whoever has no certificate.
    """
    own = f"trueflight/{keys.name}"
    rules, subjects, policies = [], [], []
    for role in ROLES:
        names = [person.certificate for person in keys.people if person.role == role]
        if not names:
            continue
        leaves = [leaf for leaf in NEEDS if may(role, leaf)]
        asked = [leaf for leaf in leaves if leaf not in (*_PUBLISHED, *_TAKEN)]
        told = [f"{own}/{leaf}" for leaf in _PUBLISHED]
        kept = [f"{key}/@adv/**" for key in told]  # cache, recovery and detection of advanced publishers
        put = [f"{own}/{leaf}" for leaf in _TAKEN if leaf in leaves]
        ask = [f"{own}/{leaf}" for leaf in asked]
        anybody = ["trueflight/*/status"]
        mine = [
            _rule(role, "subscribe", "ingress", ["declare_subscriber"], [*told, *kept, *put]),
            _rule(role, "ask", "ingress", ["query"], [*ask, *anybody, *kept]),
            _rule(
                role,
                "look",
                "ingress",
                ["liveliness_query", "declare_liveliness_subscriber"],
                [*anybody, *kept],
            ),
            _rule(role, "data", "egress", ["put"], [*told, *kept]),
            _rule(role, "answer", "egress", ["reply"], [*ask, *told, *kept]),
            _rule(role, "exist", "egress", ["liveliness_token"], [f"{own}/status", *kept]),
            _rule(role, "serve", "egress", ["declare_queryable"], [*ask, *kept]),
        ]
        if put:
            mine += [
                _rule(role, "send", "ingress", ["put"], put),
                _rule(role, "want", "egress", ["declare_subscriber"], put),
            ]
        rules += mine
        subjects.append({"id": role, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in mine], "subjects": [role]})
    return _access_control(rules, subjects, policies)


def ground_rules(keys: Keys) -> dict[str, Any]:
    """Zenoh's `access_control` for the ground: a vehicle may speak for itself alone, and nobody else at all."""
    rules, subjects, policies = [], [], []
    for vehicle, certificate in keys.vehicles.items():
        own = f"trueflight/{vehicle}"
        spoken = [f"{own}/**", f"{own}/tick/@adv/**", f"{own}/event/@adv/**"]
        mine = [
            _rule(vehicle, "hears", "ingress",
                  ["put", "reply", "liveliness_token", "declare_queryable", "declare_subscriber"], spoken),
            _rule(vehicle, "says", "egress",
                  ["put", "query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"],
                  [*spoken, "trueflight/*/status"]),
        ]  # fmt: skip
        rules += mine
        subjects.append({"id": vehicle, "cert_common_names": [certificate]})
        policies.append({"rules": [rule["id"] for rule in mine], "subjects": [vehicle]})
    return _access_control(rules, subjects, policies)


def _rule(who: str, what: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {
        "id": f"{who}-{what}",
        "permission": "allow",
        "flows": [flow],
        "messages": messages,
        "key_exprs": sorted(set(keys)),
    }


def _access_control(rules: list[Any], subjects: list[Any], policies: list[Any]) -> dict[str, Any]:
    if not rules:  # nobody is let in; Zenoh wants no empty lists, and an empty policy denies everything
        return {"enabled": True, "default_permission": "deny"}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def transport(keys: Keys) -> dict[str, Any]:
    """Zenoh's settings that keys decide, path to value: TLS both ways, nothing but TLS, no looking for others.

    Names and addresses are not compared with the certificate: a vehicle's address changes with every network. What is
    compared is who it is: only a vehicle's certificate may serve, and only under its own name (`ground_rules`).
    """
    own = {
        "root_ca_certificate": str(keys.path(AUTHORITY).absolute()),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }
    for side in ("listen", "connect"):
        own[f"{side}_certificate"] = str(keys.path(CERTIFICATE).absolute())
        own[f"{side}_private_key"] = str(keys.path(PRIVATE_KEY).absolute())
    rules = vehicle_rules(keys) if keys.role == VEHICLE else ground_rules(keys)
    return {
        **{f"transport/link/tls/{name}": value for name, value in own.items()},
        "transport/link/protocols": ["tls"],
        "access_control": rules,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }
