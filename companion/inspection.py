"""The check of a model file, in a process of its own.

ONNX Runtime is a large program that reads what the ground sent: a hostile or damaged file may crash it, keep
it busy for ever or make it eat the memory. So the contract and the golden vectors are checked in a child that
runs when nothing else wants the processor, may use little memory and time, reaches neither files nor network,
and answers with JSON. It gets the file's bytes through a pipe. The companion opens a model only after its child
accepted it. In flight and on the ground the way is the same.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING, Any

from trueflight.companion.child import ask_child, begin_child
from trueflight.companion.confined import confine, leave_network
from trueflight.models.vehicle import Vehicle

if TYPE_CHECKING:
    from trueflight.companion.law.inference import ModelInfo
    from trueflight.companion.law.model_check import Verdict

CHILD = (sys.executable, "-m", "trueflight.companion.inspection")
PATIENCE = 30.0
"""Seconds of the wall's clock for one file; on a busy machine the child gets what others leave."""
PROCESSOR_TIME = 10
"""Seconds of the processor for one file."""
MEMORY = 96 << 20
"""Bytes that a model may take while it is checked, beside what the empty child has."""
_ANSWER_LIMIT = 1 << 20


@dataclass(frozen=True)
class Finding:
    """What the check of one file found; `info` only where it was accepted, `median` and `worst` s an inference.

    `straight` where its straight line gives what ONNX Runtime does, so that it flies without that. `open` tells which
    of the fences around the check this machine's kernel does not offer.
    """

    accepted: bool
    reason: str
    info: ModelInfo | None = None
    median: float = 0.0
    worst: float = 0.0
    open: tuple[str, ...] = ()
    straight: bool = False


def inspect(files: Sequence[bytes], vehicle: Vehicle, deadline: float) -> list[Finding]:
    """Check files as `companion.law.inference.check_model` does, in a child; never raises, whatever they hold.

    Blocks while the child runs. A file that takes the child down with it is refused; the others get another.
    """
    findings: list[Finding] = []
    while len(findings) < len(files):
        rest = files[len(findings) :]
        answers, end = _ask_child(rest, vehicle, deadline)
        findings += answers[: len(rest)]
        if len(answers) < len(rest):
            findings.append(Finding(False, end))
    return findings


def _ask_child(files: Sequence[bytes], vehicle: Vehicle, deadline: float) -> tuple[list[Finding], str]:
    """Findings of one child, in order as far as it came, and how it ended."""
    request = {
        "sizes": [len(file) for file in files],
        "vehicle": {key: getattr(vehicle, key) for key in ("name", "mass", "hover_thrust")},
        "deadline": deadline,
        "processor_time": PROCESSOR_TIME,
        "memory": MEMORY,
    }
    whole = json.dumps(request).encode() + b"\n" + b"".join(files)
    out, end = ask_child(CHILD, whole, PATIENCE * len(files), PROCESSOR_TIME)
    findings = []
    for line in out.splitlines():
        try:
            findings.append(_finding(json.loads(line)))
        except (KeyError, TypeError, ValueError, RecursionError):
            break
    return findings, end


def _finding(answer: dict[str, Any]) -> Finding:
    from trueflight.companion.law.actuation import Actuation
    from trueflight.companion.law.inference import ModelInfo, Range
    from trueflight.models.learnable import Learnable

    info = answer["info"]
    if info is not None:
        x, y, z = info["noise"]
        info = ModelInfo(
            str(info["hash"]),
            str(info["name"]),
            str(info["version"]),
            tuple(Range(name, unit, low, high) for name, unit, low, high in info["features"]),
            tuple(info["chain"]),
            str(info["data_hash"]),
            Actuation(*(float(number) for number in info["actuation"])),
            tuple(Learnable(**one) for one in info["learnables"]),
            (float(x), float(y), float(z)),
        )
    return Finding(
        bool(answer["accepted"]) and info is not None,
        str(answer["reason"]),
        info,
        float(answer["median"]),
        float(answer["worst"]),
        tuple(str(one) for one in answer["open"]),
        bool(answer["straight"]),
    )


def _main() -> None:
    """The child: a request on standard input, one line of JSON a file on standard output."""
    network = leave_network()
    descriptor, whole = begin_child()
    answers = os.fdopen(descriptor, "w")
    from trueflight.companion.law.model_check import check_model, warm_up

    warm_up()
    line, _, rest = whole.partition(b"\n")
    request = json.loads(line)
    vehicle = Vehicle(**request["vehicle"])
    missing = confine(request["memory"] + len(whole), request["processor_time"] * len(request["sizes"]))
    if network:
        missing.append(network)
    begin = 0
    for size in request["sizes"]:
        onnx, begin = rest[begin : begin + size], begin + size
        try:
            verdict = check_model(onnx, vehicle, request["deadline"])
            answer = _answer(verdict)
        except MemoryError:
            answer = _refusal("its check needs too much memory")
        text = json.dumps({**answer, "open": missing})
        if len(text) > _ANSWER_LIMIT:
            reason = f"its metadata have {len(text)} characters; at most {_ANSWER_LIMIT} are accepted"
            text = json.dumps({**_refusal(reason), "open": missing})
        answers.write(text + "\n")
        answers.flush()


def _refusal(reason: str) -> dict[str, Any]:
    nothing = {"median": 0.0, "worst": 0.0, "straight": False, "info": None}
    return {"accepted": False, "reason": reason, **nothing}


def _answer(verdict: Verdict) -> dict[str, Any]:
    """A verdict as JSON can carry it."""
    if verdict.model is None:
        return _refusal(verdict.reason)
    info = verdict.model.info
    return {
        "accepted": verdict.accepted,
        "reason": verdict.reason,
        "median": verdict.median,
        "worst": verdict.worst,
        "straight": verdict.model.straight,
        "info": {
            "hash": info.hash,
            "name": info.name,
            "version": info.version,
            "features": [(one.name, one.unit, one.low, one.high) for one in info.features],
            "chain": info.chain,
            "data_hash": info.data_hash,
            "actuation": astuple(info.actuation),
            "learnables": [one.table() for one in info.learnables],
            "noise": info.noise,
        },
    }


if __name__ == "__main__":
    _main()
