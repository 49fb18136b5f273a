"""The sealed answer: what was hidden, unreadable by accident, opened by `sim-bridge reveal` only.

Not a secret from somebody who reads this file, but from eyes, logs and searches: compressed, masked and
encoded, with a checksum so that a damaged file is told from an empty answer.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import zlib
from itertools import cycle
from pathlib import Path

from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole
from trueflight.sim_bridge.settings import Settings
from trueflight.sim_bridge.truth.hidden import Hidden

_HEADER = "trueflight sealed answer 1: open it with `sim-bridge reveal`"
_MASK = hashlib.sha256(b"look at the residual first").digest()


def seal(hidden: tuple[Hidden, ...], vehicle: str, seed: int, path: Path) -> None:
    """Write the answer to `path`. Raises `InputError` where it cannot be written."""
    answer = {"vehicle": vehicle, "seed": seed, "effects": [one.answer() for one in hidden]}
    packed = zlib.compress(json.dumps(answer).encode(), 9)
    # A constant length tells nothing of how many effects there are.
    packed = len(packed).to_bytes(4, "big") + packed.ljust(1020, b"\0")
    masked = hashlib.sha256(packed).digest() + _mask(packed)
    text = _HEADER + "\n" + base64.b85encode(masked).decode() + "\n"
    write_whole(path, text, "the sealed answer", "choose --sealed FILE")


def seal_where_asked(
    settings: Settings, hidden: tuple[Hidden, ...], vehicle: str, default: Path
) -> Path | None:
    """Seal the answer and return where; None where nobody asked for a seal and the user knows what is hidden.

    To be called last of all, when nothing else can fail: the answer to an earlier flight must not be lost to a mistyped
    one.
    """
    if not settings.sealed and not {"random", "any", "rich"} & set(settings.hidden):
        return None
    path = Path(settings.sealed) if settings.sealed else default
    seal(hidden, vehicle, settings.seed, path)
    return path


def hidden_text(settings: Settings, sealed: Path | None) -> str:
    """What is hidden, as asked for, and where its answer is."""
    names = ", ".join(settings.hidden)
    return f"hidden: {names}" + (f" (the answer is sealed in {sealed})" if sealed else "")


def reveal(path: Path) -> dict[str, object]:
    """The answer in a sealed file: vehicle, seed, and the effects with their parameters.

    Raises `InputError` for a file that cannot be read, is no sealed answer, or is damaged.
    """
    try:
        header, _, body = path.read_text(encoding="ascii").partition("\n")
    except OSError as error:
        raise InputError(f"{path}: cannot read the sealed answer ({error.strerror})") from None
    except UnicodeDecodeError:
        header = body = ""
    if header != _HEADER:
        raise InputError(f"{path}: not a sealed answer; give the file that `sim-bridge run` or `fly` wrote")
    try:
        masked = base64.b85decode(body.strip())
        packed = _mask(masked[32:])
        if hashlib.sha256(packed).digest() != masked[:32]:
            raise ValueError("checksum")
        size = int.from_bytes(packed[:4], "big")
        answer: dict[str, object] = json.loads(zlib.decompress(packed[4 : 4 + size]))
    except (ValueError, binascii.Error, zlib.error, RecursionError):
        raise InputError(f"{path}: the sealed answer is damaged (its checksum does not match)") from None
    return answer


def _mask(data: bytes) -> bytes:
    return bytes(a ^ b for a, b in zip(data, cycle(_MASK), strict=False))
