"""Deployed models on board: kept as files named by their hash, one of them live, the earlier ones to go back
to.
"""

from __future__ import annotations

import json
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.inference import Model, Verdict, check_model
from models.vehicle import Vehicle

_HISTORY = "history.json"


@dataclass(frozen=True)
class Stored:
    """An accepted model."""

    model: Model
    verdict: Verdict


class ModelStore:
    """Accepted models in a folder; safe to use from several threads.

    A model becomes live only after `check_model` accepted it, and every one is checked again when the
    companion starts: the runtime or the vehicle file may have changed in between.
    """

    def __init__(self, folder: Path, vehicle: Vehicle, deadline: float) -> None:
        self._folder, self._vehicle, self._deadline = folder, vehicle, deadline
        self._lock = threading.Lock()
        self._history: list[str] = []
        self._models: dict[str, Stored] = {}
        self.refused_at_start: list[str] = []
        folder.mkdir(parents=True, exist_ok=True)
        try:
            names = [str(name) for name in json.loads((folder / _HISTORY).read_text(encoding="utf-8"))]
        except (OSError, ValueError, TypeError):
            names = []
        for name in names:
            self._restore(name)

    @property
    def live(self) -> Model | None:
        """The model that `corrected` flights use."""
        with self._lock:
            return self._models[self._history[-1]].model if self._history else None

    def deploy(self, onnx: bytes) -> dict[str, Any]:
        """Check a model and make it live where it is accepted; the answer for the ground."""
        verdict = check_model(onnx, self._vehicle, self._deadline)
        if verdict.model is None:
            return {"accepted": False, "reason": verdict.reason}
        name = verdict.model.info.hash
        path = self._folder / f"{name}.onnx"
        staged = path.with_suffix(".staged")
        try:
            with staged.open("wb") as file:
                file.write(onnx)
                file.flush()
                os.fsync(file.fileno())
            staged.replace(path)
            with self._lock:
                self._models[name] = Stored(verdict.model, verdict)
                self._history = [other for other in self._history if other != name] + [name]
                self._save()
        except OSError as error:
            return {"accepted": False, "reason": f"cannot keep it on board ({error.strerror})"}
        return {"accepted": True, "reason": verdict.reason, **self.describe()}

    def roll_back(self) -> dict[str, Any]:
        """Make the previous model live; with none left, only `lqr` can be flown."""
        with self._lock:
            if not self._history:
                return {"accepted": False, "reason": "no model is live"}
            gone = self._history.pop()
            self._save()
        answer = self.describe()
        return {
            "accepted": True,
            "reason": f"{gone} is no longer live, {answer['live'] or 'none'} is",
            **answer,
        }

    def describe(self) -> dict[str, Any]:
        """The live model's hash and all known models, oldest first, for JSON."""
        with self._lock:
            models = [self._describe(name) for name in self._history]
            return {"live": self._history[-1] if self._history else "", "models": models}

    def _describe(self, name: str) -> dict[str, Any]:
        stored = self._models[name]
        info = stored.model.info
        return {
            "hash": info.hash,
            "name": info.name,
            "version": info.version,
            "effects": [str(entry.get("effect")) for entry in info.chain],
            "data_hash": info.data_hash,
            "inference_us": round(1e6 * stored.verdict.median, 1),
        }

    def _restore(self, name: str) -> None:
        try:
            verdict = check_model((self._folder / f"{name}.onnx").read_bytes(), self._vehicle, self._deadline)
        except OSError as error:
            self.refused_at_start.append(f"{name}: {error.strerror}")
            return
        if verdict.model is None or verdict.model.info.hash != name:
            self.refused_at_start.append(f"{name}: {verdict.reason}")
            return
        self._models[name] = Stored(verdict.model, verdict)
        self._history.append(name)

    def _save(self) -> None:
        staged = self._folder / (_HISTORY + ".staged")
        staged.write_text(json.dumps(self._history), encoding="utf-8")
        staged.replace(self._folder / _HISTORY)
