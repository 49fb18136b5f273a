"""A model's signature: who, when, which bytes, for which vehicle; Ed25519.

It travels beside the model as JSON (`Signature.to_json`), as attachment of the query, and stays beside it on board.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from trueflight.models.errors import InputError

LIMIT = 4096
"""Bytes of a signature at most; nothing longer is parsed."""
_FIRST_LINE = b"trueflight model signature 1\n"
_FIELDS = ("signer", "time_ns", "hash", "vehicle", "signature")


@dataclass(frozen=True)
class Signature:
    """`signer` by name, `time_ns` since 1970 by the signer's clock, SHA-256 of the model in hexadecimal digits,
    name of the vehicle, and the signature of all that in hexadecimal digits."""

    signer: str
    time_ns: int
    hash: str
    vehicle: str
    signature: str = ""

    @property
    def signed(self) -> bytes:
        """What is signed."""
        about = {key: value for key, value in asdict(self).items() if key != "signature"}
        return _FIRST_LINE + json.dumps(about, sort_keys=True, separators=(",", ":")).encode()

    def to_json(self) -> bytes:
        """As it travels."""
        return json.dumps(asdict(self)).encode()


def read_signature(data: bytes) -> Signature:
    """The signature that was sent. Raises `InputError` for anything else, whatever it is."""
    if len(data) > LIMIT:
        raise InputError(f"its signature has {len(data)} bytes; at most {LIMIT} are read")
    try:
        table = json.loads(data)
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict) or sorted(table) != sorted(_FIELDS):
        raise InputError("its signature is no JSON object with " + ", ".join(_FIELDS))
    texts = all(isinstance(table[key], str) for key in _FIELDS if key != "time_ns")
    if not texts or type(table["time_ns"]) is not int or not 0 < table["time_ns"] < 2**62:
        raise InputError("its signature holds values of another type")
    if not re.fullmatch(r"[0-9a-f]{64}", table["hash"]) or not re.fullmatch(
        r"[0-9a-f]{128}", table["signature"]
    ):
        raise InputError("its signature holds no SHA-256 or no Ed25519 signature in hexadecimal digits")
    return Signature(**table)


def sign(onnx: bytes, vehicle: str, signer: str, key: Path) -> Signature:
    """Sign a model for one vehicle with an engineer's private key (`signing-key.pem`).

    Raises `InputError` where the key cannot be read.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        private = load_pem_private_key(key.read_bytes(), None)
    except OSError as error:
        raise InputError(f"{key}: cannot read the signing key ({error.strerror})") from None
    except (ValueError, TypeError):
        private = None
    if not isinstance(private, Ed25519PrivateKey):
        raise InputError(
            f"{key}: no Ed25519 key without a password; `groundstation keys` makes one for an engineer"
        )
    bare = Signature(signer, time.time_ns(), hashlib.sha256(onnx).hexdigest(), vehicle)
    return Signature(bare.signer, bare.time_ns, bare.hash, bare.vehicle, private.sign(bare.signed).hex())


def verify(signature: Signature, onnx: bytes, vehicle: str, engineers: Mapping[str, str]) -> None:
    """Raise `InputError` with the reason where a signature does not hold for these bytes and this vehicle.

    `engineers` maps names to public keys (64 hexadecimal digits).
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    who = signature.signer[:60]
    public = engineers.get(signature.signer)
    if public is None:
        raise InputError(f"it is signed by '{who}', who is no engineer of this vehicle")
    try:
        Ed25519PublicKey.from_public_bytes(bytes.fromhex(public)).verify(
            bytes.fromhex(signature.signature), signature.signed
        )
    except (InvalidSignature, ValueError):
        raise InputError(f"its signature is not that of '{who}'") from None
    if signature.vehicle != vehicle:
        raise InputError(f"it is signed for vehicle '{signature.vehicle[:60]}', this is '{vehicle}'")
    if signature.hash != hashlib.sha256(onnx).hexdigest():
        raise InputError(f"its bytes are not those that '{who}' signed")
