"""The check of a model file reaches nothing beside the file, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from onnx_models import drag_model

from trueflight.companion import inspection
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")


FENCES = """
import json, os, socket
from trueflight.companion.confined import confine, leave_network
leave_network()
missing = confine(64 << 20, 5)
def tried(act):
    try:
        act()
        return "done"
    except OSError as error:
        return error.strerror
out = {"open": tried(lambda: os.open("/etc/passwd", 0)), "write": tried(lambda: os.open("/tmp/x", 65)),
       "list": tried(lambda: os.listdir("/")), "socket": tried(lambda: socket.socket()),
       "fork": tried(os.fork), "exec": tried(lambda: os.execv("/bin/true", ["true"])),
       "kill": tried(lambda: os.kill(os.getppid(), 0)), "remove": tried(lambda: os.unlink("/tmp/nothing"))}
print(json.dumps({"missing": missing, "tried": out}))
"""


def test_the_check_reaches_no_file_no_network_and_no_other_process() -> None:
    done = subprocess.run([sys.executable, "-c", FENCES], capture_output=True, text=True, timeout=60.0)
    answer = json.loads(done.stdout)
    tried = answer["tried"]
    opens = ("open", "write", "list", "socket") if answer["missing"] else tuple(tried)
    assert {name: tried[name] for name in opens if tried[name] == "done"} == {}, answer


def test_a_model_is_still_accepted_behind_all_fences() -> None:
    (finding,) = inspection.inspect([drag_model(0.1)], VEHICLE, 0.1)
    assert finding.accepted, finding.reason
