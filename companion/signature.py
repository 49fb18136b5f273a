"""Whose models fly: each is checked for an engineer's signature before anything opens it, and at every start again.

The signature lies beside the model, `HASH.sig` beside `HASH.onnx`. A signature counts once: one that is not newer than
the last one of its signer is a replay, and refused.
"""

from __future__ import annotations

import json
import os
import threading
from datetime import UTC, datetime
from pathlib import Path

from trueflight.models.access import ENGINEER, Keys
from trueflight.models.contract import model_hash
from trueflight.models.errors import InputError
from trueflight.models.signature import read_signature, verify

UNSIGNED = LOCAL, ALLOWED, REFUSED = ("local", "allowed", "refused")
"""What `unsigned_models` may be: accepted while no other machine can send one, accepted, refused."""
_NEWEST = "signed.json"


class Signatures:
    """The signatures of the models in one folder.

    `required` by the setting `unsigned`, by whether there are keys and whether another machine can reach the
    companion without any (`exposed`). Safe to use from several threads.
    """

    def __init__(self, folder: Path, vehicle: str, keys: Keys | None, unsigned: str, exposed: bool) -> None:
        self._folder, self._vehicle = folder, vehicle
        people = keys.people if keys is not None else ()
        self._engineers = {
            one.name: one.signing_key for one in people if one.role == ENGINEER and one.signing_key
        }
        self.required = unsigned == REFUSED or (unsigned == LOCAL and (keys is not None or exposed))
        self._how = (
            "deploy it with an engineer's keys (groundstation deploy --keys FOLDER)"
            if keys is not None
            else 'the companion has no keys (groundstation keys); unsigned_models = "allowed" would accept it'
        )
        self._lock = threading.Lock()

    def admit(self, onnx: bytes, signature: bytes) -> str:
        """'' where a model that was sent may be looked at, otherwise why not; keeps its signature on board."""
        with self._lock:
            if not signature:
                return f"it is not signed; {self._how}" if self.required else ""
            if not self._engineers:
                # Nobody could be believed; without a duty to sign it is as if there was no signature.
                return f"nobody's signature is known here; {self._how}" if self.required else ""
            try:
                told = read_signature(signature)
                verify(told, onnx, self._vehicle, self._engineers)
                newest = self._newest()
                if told.time_ns <= newest.get(told.signer, 0):
                    return (
                        f"its signature is not newer than the last one of '{told.signer}': sent before; sign it again "
                        "(groundstation deploy does)"
                    )
                self._write(_NEWEST, json.dumps({**newest, told.signer: told.time_ns}).encode())
                self._write(f"{model_hash(onnx)}.sig", signature)
            except InputError as error:
                return str(error)
            except OSError as error:
                return f"cannot keep its signature on board ({error.strerror})"
        return ""

    def stored(self, path: Path) -> str:
        """'' where a model on board may be opened, otherwise why not."""
        if not self.required:
            return ""
        try:
            onnx = path.read_bytes()
            signature = (path.with_suffix(".sig")).read_bytes()
        except FileNotFoundError:
            return f"it is not signed; {self._how}"
        except OSError as error:
            return f"cannot read it or its signature ({error.strerror})"
        try:
            verify(read_signature(signature), onnx, self._vehicle, self._engineers)
        except InputError as error:
            return str(error)
        return ""

    def signer(self, name: str) -> str:
        """Who signed the model of this hash; '' where nobody did."""
        try:
            return read_signature((self._folder / f"{name}.sig").read_bytes()).signer
        except (OSError, InputError):
            return ""

    def told(self, name: str) -> str:
        """Who signed the model of this hash and when by their clock, for people."""
        try:
            signature = read_signature((self._folder / f"{name}.sig").read_bytes())
        except (OSError, InputError):
            return "its signature is of nobody known here"
        when = datetime.fromtimestamp(1e-9 * signature.time_ns, UTC)
        return f"signed by {signature.signer} at {when:%Y-%m-%d %H:%M:%S} UTC for '{signature.vehicle}'"

    def sweep(self) -> None:
        """Forget the signatures of models that are gone."""
        for path in self._folder.glob("*.sig"):
            if not any(path.with_suffix(end).exists() for end in (".onnx", ".staged")):
                path.unlink(missing_ok=True)

    def _newest(self) -> dict[str, int]:
        try:
            table = json.loads((self._folder / _NEWEST).read_text(encoding="utf-8"))
            return {str(name): int(stamp) for name, stamp in table.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError):
            raise InputError(
                f"{self._folder / _NEWEST}: damaged, so that a replay could not be told; remove it on board"
            ) from None

    def _write(self, name: str, data: bytes) -> None:
        part = self._folder / f".{name}.part"
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(self._folder / name)
