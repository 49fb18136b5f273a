"""A model on its way to the vehicle: its file, and what becomes of it in flight."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from trueflight.groundstation.operate.link import Link
from trueflight.models.contract import too_large
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Event


def read_onnx(model: Path | None) -> bytes:
    """The bytes of a model file; raises `InputError` for none, and for one that no companion would take."""
    if model is None:
        raise InputError("which model? Pass the file that `groundstation model export` wrote, or --roll-back")
    try:
        reason = too_large("model", model.stat().st_size)
        if reason:
            raise InputError(f"{model}: {reason}; pass the one that `groundstation model export` wrote")
        onnx = model.read_bytes()
    except OSError as error:
        raise InputError(
            f"{model}: cannot read the model ({error.strerror}); `groundstation model export` makes one"
        ) from None
    if not onnx or onnx[:1] == b"{":
        raise InputError(f"{model}: not an ONNX file; pass the one that `groundstation model export` wrote")
    return onnx


def follow_candidate(
    link: Link,
    model: str,
    events: queue.SimpleQueue[Event],
    on_event: Callable[[Event], None],
    on_wait: Callable[[float], None],
) -> dict[str, Any]:
    """Follow a model (its hash) from the shadow to its end: the `state` it came to. `on_event` is told what the
    companion tells, `on_wait` the seconds that the shadow still lasts. Raises `InputError` where it is refused."""
    told: list[Event] = []
    missed = 0
    while True:
        time.sleep(0.1)
        try:
            status = link.status()
            missed = 0
        except InputError:  # a link may drop for a while in flight; the flight goes on without it
            missed += 1
            if missed > 5:
                raise
            continue
        while not events.empty():
            told.append(events.get())
            on_event(told[-1])
        about = status.get("shadow") or {}
        if about.get("hash") == model:
            on_wait(float(about["remaining"]))
            continue
        own = [event for event in told if model in event.text]
        if (ended := _outcome(link.vehicle, model, status, own)) is not None:
            return ended


def _outcome(vehicle: str, model: str, status: dict[str, Any], own: list[Event]) -> dict[str, Any] | None:
    """What became of a model that is in the shadow no more; None where that is not told yet."""
    outcome = next((e for e in own if e.kind in ("model_live", "model_refused")), None)
    if outcome is not None and outcome.kind == "model_refused":
        raise InputError(f"companion '{vehicle}' refused: {outcome.text}")
    if status["live"] == model:
        return {"state": "live", "reason": outcome.text if outcome is not None else ""}
    if status["phase"] == "idle":
        if (status.get("staged") or {}).get("hash") != model:
            raise InputError(f"companion '{vehicle}' does not have {model} any more; see its events")
        return {"state": "staged", "reason": own[-1].text if own else ""}
    return None
