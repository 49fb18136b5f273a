"""Reading and starting, beside what does the same without us, in the same run: processor time, the least of several.

    python benchmarks/reading.py RECORD.mcap [--ulog LOG.ulg] [--repeat 3] [--json]

* A flight record as a checked flight, against `mcap` that hands every tick to protobuf and keeps nothing.
* A ULog's topics, against pyulog reading the same topics.
* `groundstation --help`, and the refusal of a file that is not there, against `python -c "import numpy, scipy"`.

Every figure is of a process of its own, which is what the peak of memory is of. A record to read: `sim-bridge fly
--trajectory excitation --vehicle models/vehicles/quad5/vehicle.toml -o RECORD.mcap`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

BARE_RECORD = """
import sys
from mcap.reader import make_reader
from trueflight.models.record_pb2 import Tick
with open(sys.argv[1], "rb") as stream:
    for _, _, message in make_reader(stream).iter_messages(topics=["/tick"], log_time_order=False):
        Tick.FromString(message.data)
"""
OUR_RECORD = """
import sys
from trueflight.groundstation.reading import read_flight
read_flight(sys.argv[1])
"""
BARE_ULOG = """
import sys
from pyulog import ULog
from trueflight.groundstation.reading.px4_log import TOPICS
ULog(sys.argv[1], message_name_filter_list=list(TOPICS))
"""
OUR_ULOG = """
import sys
from pathlib import Path
from trueflight.groundstation.reading.px4_log import load_ulog
load_ulog(Path(sys.argv[1]))
"""
PROGRAM = "from trueflight.groundstation.commands.app import main; main()"


class Cost(NamedTuple):
    """Processor time in s and peak of memory in MB of a process."""

    seconds: float
    megabytes: float


def cost(repeat: int, code: str, *arguments: str) -> Cost:
    """The least that a Python process with this `code` takes."""
    costs = []
    for _ in range(repeat):
        child = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        said = child.stderr.read() if child.stderr else b""
        _, _, used = os.wait4(child.pid, 0)
        if b"Traceback" in said:
            raise SystemExit(f"{code}\n{said.decode()}")
        costs.append(Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3))
    return Cost(min(c.seconds for c in costs), min(c.megabytes for c in costs))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("record", type=Path)
    parser.add_argument(
        "--ulog", type=Path, default=Path(__file__).parents[1] / "samples/px4/sih_lemniscate.ulg"
    )
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    record, ulog = str(given.record), str(given.ulog)
    libraries = ("import numpy, scipy",)
    pairs = {
        "record, as a flight / mcap and protobuf": ((OUR_RECORD, record), (BARE_RECORD, record)),
        "ULog, its topics / pyulog": ((OUR_ULOG, ulog), (BARE_ULOG, ulog)),
        "groundstation --help / numpy and scipy": ((PROGRAM, "--help"), libraries),
        "groundstation diagnose, refused / numpy and scipy": (
            (PROGRAM, "diagnose", "nothing.csv"),
            libraries,
        ),
    }
    table = {}
    for name, (ours, theirs) in pairs.items():
        a, b = cost(given.repeat, *ours), cost(given.repeat, *theirs)
        table[name] = {"ours": a._asdict(), "beside": b._asdict(), "time_ratio": a.seconds / b.seconds}
        if not given.json:
            print(
                f"{name:50} {a.seconds:6.2f} s {a.megabytes:5.0f} MB   beside {b.seconds:6.2f} s "
                f"{b.megabytes:5.0f} MB   {a.seconds / b.seconds:5.2f} times"
            )
    if given.json:
        print(json.dumps(table))


if __name__ == "__main__":
    main()
