"""Deployed models on board: files named by their hash. One is live, the earlier ones are there to go back to,
and one may be staged: accepted by its check, but not live before it has proved itself in flight.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.inference import MAX_BYTES, Model, ModelInfo, open_model
from companion.inspection import Finding, inspect
from models.contract import model_hash
from models.errors import InputError
from models.vehicle import Vehicle

KEPT = 8
"""Models of the past that stay on board; each is checked again when the companion starts."""
_HISTORY = "history.json"


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
        return [str(name) for name in json.loads((folder / _HISTORY).read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError, RecursionError):
        return []


class ModelStore:
    """Accepted models in a folder; safe to use from several threads.

    A model becomes live only after `companion.inspection` accepted it, and every one is checked again when the
    companion starts: the runtime or the vehicle file may have changed in between. What is live is on the disk
    before it is told, so that a power cut leaves either the one before or this one. `unsigned` says of a file why it
    must not be opened ('' where it may): asked before anything reads it as a model.
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
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob("*.staged"):
            left.unlink()
        self._restore(_names_of(folder)[-KEPT:])

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
                    stored.model = open_model(path.read_bytes(), stored.info)
                except OSError as error:
                    raise InputError(f"model {name}: cannot read it ({error.strerror})") from None
            return stored.model

    def stage(self, onnx: bytes) -> Finding:
        """Check a model, in a process of its own, and keep it beside the live one where it is accepted."""
        if len(onnx) > MAX_BYTES:
            return Finding(False, f"the file has {len(onnx)} bytes; at most {MAX_BYTES} are accepted")
        name = model_hash(onnx)
        path = self._path(name, staged=True)
        try:
            with path.open("wb") as file:
                file.write(onnx)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            path.unlink(missing_ok=True)
            return Finding(False, f"cannot keep it on board ({error.strerror})")
        (finding,) = inspect([path], self._vehicle, self._deadline)
        if finding.info is None or finding.info.hash != name:
            path.unlink(missing_ok=True)
            return Finding(False, finding.reason)
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
            try:
                self._path(name, staged=True).replace(self._path(name))
                self._save(history[-KEPT:])
            except OSError as error:
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

    def deploy(self, onnx: bytes) -> dict[str, Any]:
        """Check a model and make it live where it is accepted; the answer for the ground."""
        finding = self.stage(onnx)
        if not finding.accepted:
            return {"accepted": False, "reason": finding.reason}
        reason = self.commit(model_hash(onnx))
        if reason:
            self.discard(model_hash(onnx))
            return {"accepted": False, "reason": reason}
        return {"accepted": True, "reason": finding.reason, **self.describe()}

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
            self._path(name, staged=True).unlink(missing_ok=True)
            if name not in self._history:
                self._models.pop(name, None)

    def _forget(self, name: str) -> None:
        self._models.pop(name, None)
        self._path(name).unlink(missing_ok=True)

    def _restore(self, names: list[str]) -> None:
        there = []
        for name in names:
            gone = "" if self._path(name).is_file() else "its file is gone"
            reason = gone or self._unsigned(self._path(name))
            if reason:
                self.refused_at_start.append(f"{name}: {reason}")
            else:
                there.append(name)
        findings = inspect([self._path(name) for name in there], self._vehicle, self._deadline)
        for name, finding in zip(there, findings, strict=True):
            if finding.info is None or finding.info.hash != name:
                reason = finding.reason if finding.info is None else "its file is another one"
                self.refused_at_start.append(f"{name}: {reason}")
                continue
            self._models[name] = Stored(finding, finding.info)
            self._history.append(name)

    def _save(self, history: list[str]) -> None:
        """Write the history, and take it over once it is on the disk."""
        part = self._folder / (_HISTORY + ".part")
        with part.open("w", encoding="utf-8") as file:
            json.dump(history, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(self._folder / _HISTORY)
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
        self._history = history
