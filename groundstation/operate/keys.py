"""A small certificate authority: one folder of keys a vehicle and a person, made whole or not at all.

    FOLDER/ca/                 the authority: whoever has it lets anybody in; it stays on this machine
    FOLDER/vehicle-NAME/       for the vehicle
    FOLDER/NAME/               for a person

What a folder holds is told in `models.access`. Private keys have mode 0600, the folders 0700.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from trueflight.models import access
from trueflight.models.errors import InputError

DAYS = 365
"""Days that the certificates of vehicles and people hold."""
_AUTHORITY_DAYS = 3650
_EARLY = dt.timedelta(days=2)
"""By how much certificates begin in the past: a vehicle without a clock of its own is behind."""
_ISSUED = "issued.json"
_PAGE = "workbench.page"
_PAGE_LASTS = dt.timedelta(days=7)


@dataclass(frozen=True)
class Made:
    """What one call did: folders made, `access.toml` files written anew, the certificates' end."""

    root: Path
    new_authority: bool
    made: tuple[Path, ...]
    changed: tuple[Path, ...]
    removed: tuple[str, ...]
    until: dt.datetime


def make_keys(
    root: Path,
    vehicles: Sequence[str] = (),
    people: Sequence[tuple[str, str]] = (),
    removed: Sequence[str] = (),
    days: float = DAYS,
) -> Made:
    """Make the authority where there is none, and keys for these vehicles and people (name, role).

    `removed` are people and vehicles that are let in no longer; a name given there and as new gets new keys.
    Raises `InputError` before anything is written where a name is taken or unknown.
    """
    if not 0 < days <= _AUTHORITY_DAYS:
        raise InputError(f"--days {days:g} is outside 0 to {_AUTHORITY_DAYS}")
    if not vehicles and not people and not removed:
        raise InputError("keys for whom? --vehicle NAME, --observer NAME, --operator NAME, --engineer NAME")
    issued = _issued(root)
    wanted = [(name, access.VEHICLE) for name in vehicles] + list(people)
    _check(root, issued, wanted, removed)
    now = dt.datetime.now(dt.UTC)
    until = now + dt.timedelta(days=days)
    new_authority = not (root / "ca").exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
        if new_authority:
            with _folder(root / "ca") as folder:
                _make_authority(folder, now)
        authority = _Authority(root / "ca")
        for name in removed:
            _remove(root, issued, name)
        made = []
        for name, role in wanted:
            entry = _next(issued, name, role)
            with _folder(_place(root, name, role)) as folder:
                authority.issue(folder, entry, now, until)
            issued[name] = entry
            made.append(_place(root, name, role))
        # Who is let in: written last, into every folder.
        changed = [path for path in _write_access(root, issued) if path.parent not in made]
        _write(root / "ca" / _ISSUED, json.dumps(issued, indent=1))
    except OSError as error:
        raise InputError(f"{error.filename or root}: cannot write it ({error.strerror})") from None
    return Made(root, new_authority, tuple(made), tuple(changed), tuple(removed), until)


def make_page_keys(root: Path, names: Sequence[str], folder: Path) -> frozenset[str]:
    """Certificate and key, for a week, of a page that this machine serves under `names` (host names or addresses), in
    the new folder `folder`. Returns the names in the certificates of the people who are let in.

    Raises `InputError` where `root` is no folder of `groundstation keys` with its authority.
    """
    authority = _Authority(root / "ca")
    issued = _issued(root)
    now = dt.datetime.now(dt.UTC)
    with _folder(folder) as place:
        authority.serve_as(place, names, now, now + _PAGE_LASTS)
    return frozenset(
        about["certificate"] for about in issued.values() if about["in"] and about["role"] in access.ROLES
    )


def next_steps(made: Made) -> list[str]:
    """The commands that bring each folder to where it is used."""
    steps = []
    for folder in made.made:
        if folder.name.startswith("vehicle-"):
            steps += [
                f"scp -r {folder} VEHICLE:keys                               # then, on the vehicle:",
                "sudo companion install-service --vehicle vehicle.toml --keys keys     # or: companion run --keys keys",
            ]
        else:
            steps += [
                f"scp -r {folder} COMPUTER-OF-{folder.name.upper()}:keys",
                "groundstation status --keys keys -e tls/VEHICLE:7447",
            ]
    for path in made.changed:
        if path.parent.name.startswith("vehicle-"):
            steps += [
                f"scp {path} VEHICLE:                           # who is let in has changed; then, on the vehicle:",
                f"sudo install -o trueflight -m 600 {access.ACCESS} /etc/trueflight/keys/ && sudo systemctl restart "
                "trueflight-companion",
            ]
        elif any(folder.name.startswith("vehicle-") for folder in made.made):
            steps.append(f"scp {path} COMPUTER-OF-{path.parent.name.upper()}:keys/{access.ACCESS}")
    return steps


def _check(root: Path, issued: dict[str, Any], wanted: list[tuple[str, str]], removed: Sequence[str]) -> None:
    names = [name for name, _ in wanted]
    for name, role in wanted:
        access.checked_name(name, f"--{role}")
        if names.count(name) > 1:
            raise InputError(f"'{name}' is given twice; a name is one vehicle or one person")
        if name in ("ca",) or name.startswith("vehicle-"):
            raise InputError(f"--{role} '{name}': this name is the folder of something else; choose another")
        there = issued.get(name)
        taken = there is not None and there["in"] and name not in removed
        if taken or (_place(root, name, role).exists() and name not in removed):
            raise InputError(
                f"{_place(root, name, role)}: there are keys for '{name}' already, and they are not overwritten; for "
                f"new ones add --remove {name}, which locks the old ones out"
            )
    for name in removed:
        if name not in issued or not issued[name]["in"]:
            there = ", ".join(other for other in issued if issued[other]["in"]) or "nobody"
            raise InputError(f"--remove '{name}': has no keys here; there are: {there}")


def _issued(root: Path) -> dict[str, Any]:
    path = root / "ca" / _ISSUED
    if not (root / "ca").exists():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        entries = {str(name): dict(about) for name, about in table.items()}
        for about in entries.values():
            _ = about["role"], about["certificate"], about["number"], about["in"], about["signing_key"]
        return entries
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: no list of what was issued ({type(error).__name__}); is {root} a folder of `groundstation keys`?"
        ) from None


def _next(issued: dict[str, Any], name: str, role: str) -> dict[str, Any]:
    number = issued[name]["number"] + 1 if name in issued else 1
    certificate = f"{name}.{role}" + (f".{number}" if number > 1 else "")
    return {
        "name": name,
        "role": role,
        "number": number,
        "certificate": certificate,
        "in": True,
        "signing_key": "",
    }


def _remove(root: Path, issued: dict[str, Any], name: str) -> None:
    entry = issued[name]
    entry["in"] = False
    place = _place(root, name, entry["role"])
    if place.exists():
        place.rename(root / "ca" / f"removed-{name}-{entry['number']}")


def _place(root: Path, name: str, role: str) -> Path:
    return root / (f"vehicle-{name}" if role == access.VEHICLE else name)


@contextmanager
def _folder(place: Path) -> Iterator[Path]:
    """A folder that appears under its name only when it is whole."""
    part = place.with_name(f".{place.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(mode=0o700)
    try:
        yield part
        part.rename(place)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write(path: Path, text: str | bytes, mode: int = 0o600) -> None:
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(text.encode() if isinstance(text, str) else text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def _write_access(root: Path, issued: dict[str, Any]) -> list[Path]:
    """`access.toml` in every folder of somebody who is let in; those that changed."""
    there = [entry for entry in issued.values() if entry["in"]]
    vehicles = [entry for entry in there if entry["role"] == access.VEHICLE]
    people = [entry for entry in there if entry["role"] != access.VEHICLE]
    changed = []
    for entry in there:
        lines = [
            "# Written by groundstation keys. Whose keys these are, and who is let in: delete a line to lock somebody",
            "# out, then start anew what uses this folder.",
            "[own]",
            *(f"{key} = {json.dumps(entry[key])}" for key in ("name", "role", "certificate")),
            "",
            "[vehicles]",
            *(f"{json.dumps(one['name'])} = {json.dumps(one['certificate'])}" for one in vehicles),
        ]
        if entry["role"] == access.VEHICLE:
            lines += ["", "[people]"]
            for one in people:
                about = [
                    f"{key} = {json.dumps(one[key])}"
                    for key in ("role", "certificate", "signing_key")
                    if one[key]
                ]
                lines.append(f"{json.dumps(one['name'])} = {{ {', '.join(about)} }}")
        text = "\n".join(lines) + "\n"
        path = _place(root, entry["name"], entry["role"]) / access.ACCESS
        if path.parent.exists() and (not path.exists() or path.read_text(encoding="utf-8") != text):
            _write(path, text)
            changed.append(path)
    return changed


def _private(key: Any) -> bytes:
    return bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _make_authority(folder: Path, now: dt.datetime) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _named(f"trueflight authority {os.urandom(4).hex()}")
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(now + dt.timedelta(days=_AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    _write(folder / "ca-key.pem", _private(key))
    _write(folder / access.AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    _write(folder / _ISSUED, "{}")


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=signs, crl_sign=signs, encipher_only=False, decipher_only=False,
    )  # fmt: skip


class _Authority:
    """The key that signs certificates."""

    def __init__(self, folder: Path) -> None:
        try:
            self._pem = (folder / access.AUTHORITY).read_bytes()
            self._certificate = x509.load_pem_x509_certificate(self._pem)
            self._key: Any = serialization.load_pem_private_key((folder / "ca-key.pem").read_bytes(), None)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"{folder}: no authority of `groundstation keys` ({type(error).__name__})"
            ) from None

    def issue(self, folder: Path, entry: dict[str, Any], now: dt.datetime, until: dt.datetime) -> None:
        """Write one's certificate and keys into `folder`; an engineer's public signing key into `entry`."""
        vehicle = entry["role"] == access.VEHICLE
        key = ec.generate_private_key(ec.SECP256R1())
        # Only a vehicle may serve: an operator's certificate cannot stand in for one.
        use = ExtendedKeyUsageOID.SERVER_AUTH if vehicle else ExtendedKeyUsageOID.CLIENT_AUTH
        certificate = self._certified(key, entry["certificate"], use, now, until).sign(
            self._key, hashes.SHA256()
        )
        _write(folder / access.AUTHORITY, self._pem, 0o644)
        _write(folder / access.CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        _write(folder / access.PRIVATE_KEY, _private(key))
        if entry["role"] == access.ENGINEER:
            signing = Ed25519PrivateKey.generate()
            _write(folder / access.SIGNING_KEY, _private(signing))
            entry["signing_key"] = signing.public_key().public_bytes_raw().hex()

    def serve_as(self, folder: Path, names: Sequence[str], now: dt.datetime, until: dt.datetime) -> None:
        """Write the certificate and key of a page that is served under `names` into `folder`."""
        key = ec.generate_private_key(ec.SECP256R1())
        builder = self._certified(key, _PAGE, ExtendedKeyUsageOID.SERVER_AUTH, now, until)
        alternatives = x509.SubjectAlternativeName([_alternative(name) for name in names])
        certificate = builder.add_extension(alternatives, critical=False).sign(self._key, hashes.SHA256())
        _write(folder / access.AUTHORITY, self._pem, 0o644)
        _write(folder / access.CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        _write(folder / access.PRIVATE_KEY, _private(key))

    def _certified(
        self,
        key: ec.EllipticCurvePrivateKey,
        name: str,
        use: x509.ObjectIdentifier,
        now: dt.datetime,
        until: dt.datetime,
    ) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(_named(name))
            .issuer_name(self._certificate.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(min(now - _EARLY, until - _EARLY))
            .not_valid_after(min(until, self._certificate.not_valid_after_utc))
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage([use]), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False
            )
        )


def _alternative(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
