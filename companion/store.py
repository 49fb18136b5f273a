"""Deployed models on board: files named by their hash. One is live, the earlier ones are there to go back to,
and one may be staged: accepted by its check, but not live before it has proved itself in flight.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trueflight.companion.inspection import Finding, inspect
from trueflight.companion.law.inference import Model, ModelInfo
from trueflight.companion.law.model_check import MAX_BYTES, open_model
from trueflight.models.contract import model_hash
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

KEPT = 8
"""Models of the past that stay on board; each is checked again when the companion starts."""
_HISTORY = "history.json"
_HASH = re.compile("[0-9a-f]{12}")


@dataclass
class Stored:
    """An accepted model; opened when it is first needed."""

    finding: Finding
    info: ModelInfo
    model: Model | None = None


def live_file(folder: Path) -> Path | None:
    """The live model's file of a folder that perhaps somebody else is using; None without one."""
    names = _names_of(folder)
    return folder / f"{names[-1]}.onnx" if names else None


def _names_of(folder: Path) -> list[str]:
    try:
        names = json.loads((folder / _HISTORY).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return []
    known = [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return [name for name in known if _HASH.fullmatch(name)]


class ModelStore:
    """Accepted models in a folder; safe to use from several threads.

    A model is staged after `companion.inspection` accepted it, and becomes live once it has proved itself in flight;
    so the history holds those that have. Every one is checked again when the companion starts: the runtime or the
    vehicle file may have changed in between. What is live or staged is on the disk before it is told, so that a power
    cut leaves either the one before or this one. `unsigned` says of a file why it must not be opened ('' where it may):
    asked before anything reads it as a model. Raises `InputError` where the folder cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        vehicle: Vehicle,
        deadline: float,
        unsigned: Callable[[Path], str] = lambda path: "",
    ) -> None:
        self._folder, self._vehicle, self._deadline = folder, vehicle, deadline
        self._unsigned = unsigned
        self._lock = threading.RLock()
        self._history: list[str] = []
        self._models: dict[str, Stored] = {}
        self._staged = ""
        self.refused_at_start: list[str] = []
        self.unfenced: tuple[str, ...] = ()
        """Fences around the check of models that this machine's kernel does not offer, as seen by the last check."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            staged = self._left_staged()
        except OSError as error:
            raise InputError(
                f"{folder}: cannot keep models there ({error.strerror}); pass --models"
            ) from None
        self._restore(_names_of(folder)[-KEPT:], staged)

    @property
    def live(self) -> Model | None:
        """The model that `corrected` flights use."""
        with self._lock:
            return self.open(self._history[-1]) if self._history else None

    @property
    def live_name(self) -> str:
        """Hash of the live model; empty without one."""
        with self._lock:
            return self._history[-1] if self._history else ""

    @property
    def previous_name(self) -> str:
        """Hash of the model that a roll back makes live; empty without one."""
        with self._lock:
            return self._history[-2] if len(self._history) > 1 else ""

    @property
    def staged_name(self) -> str:
        """Hash of the model that was accepted by its check and is not live yet; empty without one."""
        with self._lock:
            return self._staged

    def title(self, name: str) -> str:
        """What people call a model: hash, name and version."""
        with self._lock:
            stored = self._models.get(name)
        return f"{name} ({stored.info.name} {stored.info.version})" if stored is not None else name

    def open(self, name: str) -> Model:
        """A live, earlier or staged model, ready to run. Raises `InputError` where its file is gone."""
        with self._lock:
            stored = self._models[name]
            if stored.model is None:
                path = self._path(name, name == self._staged)
                reason = self._unsigned(path)
                if reason:
                    raise InputError(f"model {name}: {reason}")
                try:
                    stored.model = open_model(path.read_bytes(), stored.info, stored.finding.straight)
                except OSError as error:
                    raise InputError(f"model {name}: cannot read it ({error.strerror})") from None
            return stored.model

    def proved(self, name: str) -> bool:
        """Whether a model has proved itself in flight, and was neither withdrawn nor forgotten since."""
        with self._lock:
            return name in self._history

    def stage(self, onnx: bytes) -> Finding:
        """Check a model, in a process of its own, and keep it beside the live one where it is accepted."""
        if len(onnx) > MAX_BYTES:
            return Finding(False, f"the file has {len(onnx)} bytes; at most {MAX_BYTES} are accepted")
        name = model_hash(onnx)
        (finding,) = inspect([onnx], self._vehicle, self._deadline)
        self.unfenced = finding.open
        if finding.info is None or finding.info.hash != name:
            return Finding(False, finding.reason)
        path = self._path(name, staged=True)
        part = path.with_suffix(".part")
        try:
            with part.open("wb") as file:
                file.write(onnx)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        except OSError as error:
            _remove(part)
            return Finding(False, f"cannot keep it on board ({error.strerror})")
        with self._lock:
            if self._staged != name:
                self._forget_staged()
            self._staged = name
            self._models.setdefault(name, Stored(finding, finding.info))
        return finding

    def commit(self, name: str) -> str:
        """Make the staged model live; '' or why it could not be kept."""
        with self._lock:
            if name != self._staged:
                return "" if name == self.live_name else f"{name} is not staged"
            history = [other for other in self._history if other != name] + [name]
            known = name in self._history
            try:
                self._path(name, staged=True).replace(self._path(name))
                self._save(history[-KEPT:])
            except OSError as error:
                if not known:  # as it was: staged, and not in the history
                    with contextlib.suppress(OSError):
                        self._path(name).replace(self._path(name, staged=True))
                return f"cannot keep it on board ({error.strerror})"
            self._staged = ""
            for gone in set(self._models) - set(self._history):
                self._forget(gone)
            return ""

    def discard(self, name: str) -> None:
        """Forget the staged model `name`; what is live stays."""
        with self._lock:
            if name == self._staged:
                self._forget_staged()

    def roll_back(self) -> dict[str, Any]:
        """Make the previous model live; with none left, only `lqr` can be flown."""
        with self._lock:
            if not self._history:
                return {"accepted": False, "reason": "no model is live"}
            gone = self._history[-1]
            reason = self.withdraw(gone)
            if reason:
                return {"accepted": False, "reason": reason}
            answer = self.describe()
        return {
            "accepted": True,
            "reason": f"{gone} is no longer live, {answer['live'] or 'none'} is",
            **answer,
        }

    def withdraw(self, name: str) -> str:
        """Take a model out of the history, live or not; '' or why that could not be kept."""
        with self._lock:
            try:
                self._save([other for other in self._history if other != name])
            except OSError as error:
                return f"cannot keep it on board ({error.strerror})"
            if name in self._models and name != self._staged:
                self._forget(name)
            return ""

    def describe(self) -> dict[str, Any]:
        """The live model's hash, the staged one's, and all known models, oldest first, for JSON."""
        with self._lock:
            models = [self._describe(name) for name in self._history]
            staged = self._describe(self._staged) if self._staged else {}
            return {
                "live": self.live_name,
                "last_good": self.previous_name,
                "staged": staged,
                "models": models,
            }

    def _describe(self, name: str) -> dict[str, Any]:
        stored = self._models[name]
        info = stored.info
        return {
            "hash": info.hash,
            "name": info.name,
            "version": info.version,
            "effects": [str(entry.get("effect")) for entry in info.chain],
            "data_hash": info.data_hash,
            "inference_us": round(1e6 * stored.finding.median, 1),
        }

    def _path(self, name: str, staged: bool = False) -> Path:
        return self._folder / f"{name}.{'staged' if staged else 'onnx'}"

    def _forget_staged(self) -> None:
        name, self._staged = self._staged, ""
        if name:
            _remove(self._path(name, staged=True))
            if name not in self._history:
                self._models.pop(name, None)

    def _forget(self, name: str) -> None:
        self._models.pop(name, None)
        _remove(self._path(name))

    def _left_staged(self) -> str:
        """The model that waited for its flight when the companion ended; '' without one. What else was left goes."""
        for left in self._folder.glob("*.part"):
            _remove(left)
        there = sorted(self._folder.glob("*.staged"), key=lambda path: path.stat().st_mtime)
        named = [path for path in there if _HASH.fullmatch(path.stem)]
        for left in set(there) - set(named[-1:]):
            _remove(left)
        return named[-1].stem if named else ""

    def _restore(self, names: list[str], staged: str) -> None:
        there: list[tuple[str, bool, bytes]] = []
        for name, waits in [*((name, False) for name in names), *([(staged, True)] if staged else [])]:
            try:
                path = self._path(name, waits)
                if path.stat().st_size > MAX_BYTES:
                    self.refused_at_start.append(f"{name}: its file has more than {MAX_BYTES} bytes")
                    continue
                reason = self._unsigned(path)
                if reason:
                    self.refused_at_start.append(f"{name}: {reason}")
                    continue
                there.append((name, waits, path.read_bytes()))
            except OSError as error:
                gone = isinstance(error, FileNotFoundError)
                self.refused_at_start.append(f"{name}: its file {'is gone' if gone else 'cannot be read'}")
        findings = inspect([onnx for _, _, onnx in there], self._vehicle, self._deadline)
        for (name, waits, _), finding in zip(there, findings, strict=True):
            self.unfenced = finding.open
            if finding.info is None or finding.info.hash != name:
                reason = finding.reason if finding.info is None else "its file is another one"
                self.refused_at_start.append(f"{name}: {reason}")
                continue
            self._models.setdefault(name, Stored(finding, finding.info))
            if waits:
                self._staged = name
            elif name not in self._history:
                self._history.append(name)

    def _save(self, history: list[str]) -> None:
        """Take a history over, once it is on the disk."""
        _write_names(self._folder, history)
        self._history = history


def _write_names(folder: Path, names: list[str]) -> None:
    part = folder / (_HISTORY + ".part")
    try:
        with part.open("w", encoding="utf-8") as file:
            json.dump(names, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(folder / _HISTORY)
    except OSError:
        _remove(part)
        raise
    place = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(place)
    finally:
        os.close(place)


def _remove(path: Path) -> None:
    """Take a file away; a disk that does not let us is told where it matters, when something is to be kept."""
    with contextlib.suppress(OSError):
        path.unlink()
