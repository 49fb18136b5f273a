"""The check of a model file, in a process of its own.

ONNX Runtime is a large program that reads what the ground sent: a hostile or damaged file may crash it, keep
it busy for ever or make it eat the memory. So the contract and the golden vectors are checked in a child that
runs when nothing else wants the processor, may use little memory and time, and answers with JSON. The
companion opens a model only after its child accepted it. In flight and on the ground the way is the same.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from models.vehicle import Vehicle

if TYPE_CHECKING:
    from companion.inference import ModelInfo

CHILD = (sys.executable, "-m", "companion.inspection")
PATIENCE = 30.0
"""Seconds of the wall's clock for one file; on a busy machine the child gets what others leave."""
PROCESSOR_TIME = 10
"""Seconds of the processor for one file."""
MEMORY = 96 << 20
"""Bytes that a model may take while it is checked, beside what the empty child has."""
_ANSWER_LIMIT = 1 << 20


@dataclass(frozen=True)
class Finding:
    """What the check of one file found; `info` only where it was accepted, `median` and `worst` s an inference."""

    accepted: bool
    reason: str
    info: ModelInfo | None = None
    median: float = 0.0
    worst: float = 0.0


def inspect(paths: Sequence[Path], vehicle: Vehicle, deadline: float) -> list[Finding]:
    """Check files as `companion.inference.check_model` does, in a child; never raises, whatever they hold.

    Blocks while the child runs. A file that takes the child down with it is refused; the others get another.
    """
    findings: list[Finding] = []
    while len(findings) < len(paths):
        rest = [str(path) for path in paths[len(findings) :]]
        answers, end = _ask_child(rest, vehicle, deadline)
        findings += answers[: len(rest)]
        if len(answers) < len(rest):
            findings.append(Finding(False, end))
    return findings


def _ask_child(paths: list[str], vehicle: Vehicle, deadline: float) -> tuple[list[Finding], str]:
    """Findings of one child, in order as far as it came, and how it ended."""
    request = {
        "files": paths,
        "vehicle": {key: getattr(vehicle, key) for key in ("name", "mass", "hover_thrust")},
        "deadline": deadline,
        "processor_time": PROCESSOR_TIME,
        "memory": MEMORY,
    }
    # One thread for the linear algebra: every other would ask for memory of its own.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    child = subprocess.Popen(
        CHILD,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
    )
    try:
        out, _ = child.communicate(json.dumps(request).encode(), PATIENCE * len(paths))
        end = _how_it_ended(child.returncode)
    except subprocess.TimeoutExpired:
        child.kill()
        out, _ = child.communicate()
        end = f"its check did not end within {PATIENCE:g} s"
    findings = []
    for line in out.splitlines():
        try:
            findings.append(_finding(json.loads(line)))
        except (KeyError, TypeError, ValueError):
            break
    return findings, end


def _finding(answer: dict[str, Any]) -> Finding:
    from companion.actuation import Actuation
    from companion.inference import ModelInfo, Range

    info = answer["info"]
    if info is not None:
        info = ModelInfo(
            str(info["hash"]),
            str(info["name"]),
            str(info["version"]),
            tuple(Range(name, unit, low, high) for name, unit, low, high in info["features"]),
            tuple(info["chain"]),
            str(info["data_hash"]),
            Actuation(*(float(number) for number in info["actuation"])),
        )
    return Finding(
        bool(answer["accepted"]) and info is not None,
        str(answer["reason"]),
        info,
        float(answer["median"]),
        float(answer["worst"]),
    )


def _how_it_ended(code: int) -> str:
    if code == -signal.SIGXCPU or code == -signal.SIGKILL:
        return f"its check took more than {PROCESSOR_TIME} s of the processor, or was killed"
    if code < 0:
        return f"its check crashed ({signal.Signals(-code).name}): the file is hostile or damaged"
    return f"its check ended with code {code}: the file is hostile or damaged"


def _main() -> None:
    """The child: a request on standard input, one line of JSON a file on standard output."""
    os.nice(19)
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    answers = os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)  # what ONNX Runtime prints is no answer
    request = json.loads(sys.stdin.read())
    from companion.inference import check_model

    _limit(request["memory"], request["processor_time"] * len(request["files"]))
    vehicle = Vehicle(**request["vehicle"])
    for path in request["files"]:
        try:
            verdict = check_model(Path(path).read_bytes(), vehicle, request["deadline"])
            info = verdict.model.info if verdict.model is not None else None
            answer: dict[str, Any] = {
                "accepted": verdict.accepted,
                "reason": verdict.reason,
                "median": verdict.median if verdict.accepted else 0.0,
                "worst": verdict.worst if verdict.accepted else 0.0,
                "info": None,
            }
            if info is not None:
                answer["info"] = {
                    "hash": info.hash,
                    "name": info.name,
                    "version": info.version,
                    "features": [(one.name, one.unit, one.low, one.high) for one in info.features],
                    "chain": info.chain,
                    "data_hash": info.data_hash,
                    "actuation": astuple(info.actuation),
                }
        except (OSError, MemoryError) as error:
            answer = {"accepted": False, "reason": str(error) or "its check needs too much memory"}
            answer |= {"median": 0.0, "worst": 0.0, "info": None}
        text = json.dumps(answer)
        if len(text) > _ANSWER_LIMIT:
            reason = f"its metadata have {len(text)} characters; at most {_ANSWER_LIMIT} are accepted"
            text = json.dumps({"accepted": False, "reason": reason, "median": 0, "worst": 0, "info": None})
        answers.write(text + "\n")
        answers.flush()


def _limit(memory: int, seconds: int) -> None:
    """From here on `memory` more bytes and `seconds` of the processor at most, no files and no core dump."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        memory += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    _main()
