"""`companion install-service`: a systemd unit, its user and a commented configuration, as files below a folder.

A file that somebody has changed since is never overwritten: each carries the hash of what was written, and where that
no longer holds, the new one is put beside it as `NAME.new`.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from trueflight.companion.zenoh_session import LOCAL, WITH_KEYS, ZenohSettings, plan_session
from trueflight.models.access import ACCESS, AUTHORITY, CERTIFICATE, PRIVATE_KEY, read_keys
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

UNIT = "etc/systemd/system/trueflight-companion.service"
SYSUSERS = "etc/sysusers.d/trueflight.conf"
FOLDER = "etc/trueflight"
CONFIG = f"{FOLDER}/companion.toml"
STATE = "/var/lib/trueflight"
WATCHDOG = 5
"""Seconds without a control tick after which systemd restarts the companion: on the ground, for in the air the
autopilot has taken over long before."""

_MARK = "# Written by companion install-service; sha256 of what follows: "
_NAME = re.compile(r"[a-z_][a-z0-9_-]{0,30}")

NEW, SAME, UPDATED, KEPT = "new", "unchanged", "updated", "kept, yours has changes; the new one is beside it"


@dataclass(frozen=True)
class Service:
    """What the service is to be: files of the vehicle, address of the autopilot, user, program, priority.

    `listen` empty: with `keys` every network, without this machine alone; `insecure` is for another address without.
    """

    vehicle: Path
    design: Path
    connect: str
    user: str = "trueflight"
    listen: str = ""
    realtime: int = 20
    program: str = ""
    keys: Path | None = None
    insecure: bool = False

    def checked(self) -> Service:
        """The same, or `InputError` for what a unit must not hold."""
        if not _NAME.fullmatch(self.user):
            raise InputError(f"--user '{self.user}' is no name of a user; small letters, digits, - and _")
        if self.user == "root":
            raise InputError(
                "--user root: the companion needs no such rights; leave it, or name another user"
            )
        if not 0 <= self.realtime <= 80:
            raise InputError(f"--realtime {self.realtime} is outside 0 (off) to 80")
        if not re.fullmatch(r"[\x21-\x7e]+", self.connect):
            raise InputError(f"--connect '{self.connect}' holds blanks or control characters")
        vehicle = load_vehicle(self.vehicle)
        keys = read_keys(self.keys) if self.keys is not None else None
        plan_session(ZenohSettings(listen=(self.endpoint,), insecure=self.insecure), keys, vehicle.name)
        if not self.design.is_file():
            raise InputError(
                f"{self.design}: no design file; make it with groundstation design, or pass --design"
            )
        return self

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return self.listen or (LOCAL if self.keys is None else WITH_KEYS)

    @property
    def command(self) -> str:
        """The program that the unit starts."""
        beside = Path(sys.executable).with_name("companion")
        return self.program or (
            str(beside) if beside.is_file() else f"{sys.executable} -m trueflight.companion.cli"
        )


_UNIT = """\
[Unit]
Description=trueflight companion: flies the vehicle beside its autopilot
After=network.target time-sync.target
# Tries for ever: the autopilot may be switched on an hour later.
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={command} run --config /{config}
User={user}
SupplementaryGroups=dialout
StateDirectory={state}
WorkingDirectory={home}

# A companion that comes back in flight sends nothing: the vehicle is its autopilot's until it has landed.
Restart=always
RestartSec=2
# Fed by the control tick alone: no odometry, or a control thread that hangs, for so long means a new start.
WatchdogSec={watchdog}
TimeoutStartSec=120
# On SIGTERM in flight it lets the autopilot land first.
TimeoutStopSec=120

# What the control thread may ask for; how much it does stands in the configuration (realtime).
LimitRTPRIO={realtime}
OOMScoreAdjust=-500
LimitCORE=0
Environment=OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1

# What it may touch: its own state, serial ports, the network.
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
ProtectHome={protect_home}
PrivateTmp=yes
PrivateMounts=yes
UMask=0077
RemoveIPC=yes
DevicePolicy=closed
{devices}
ProtectProc=invisible
ProtectClock=yes
ProtectHostname=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
RestrictSUIDSGID=yes
LockPersonality=yes
# Netlink: Zenoh asks which addresses this machine has.
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
# User and network: the check of a model locks itself into namespaces of its own.
RestrictNamespaces=user net
SystemCallArchitectures=native
# What is not allowed fails, and does not kill: a flight goes on. Real-time priority and the limits of a model's check
# are in @resources, which @system-service holds.
SystemCallErrorNumber=EPERM
SystemCallFilter=@system-service seccomp landlock_create_ruleset landlock_add_rule landlock_restrict_self
SystemCallFilter=~@privileged @obsolete @keyring

[Install]
WantedBy=multi-user.target
"""


def texts(service: Service) -> dict[str, str]:
    """Path below the root to the text of each file, without its mark."""
    protect_home = "read-only" if service.command.startswith(("/home", "/root")) else "yes"
    unit = _UNIT.format(
        command=service.command,
        config=CONFIG,
        user=service.user,
        state=Path(STATE).name,
        home=STATE,
        watchdog=WATCHDOG,
        realtime=service.realtime,
        protect_home=protect_home,
        devices=_devices(),
    )
    sysusers = f"""\
u {service.user} - "trueflight companion" {STATE}
m {service.user} dialout
"""
    values = {
        "vehicle": json.dumps(f"/{FOLDER}/vehicle.toml"),
        "design": json.dumps(f"/{FOLDER}/design.json"),
        "connect": json.dumps(service.connect),
        "realtime": str(service.realtime),
        "records": json.dumps(f"{STATE}/records"),
        "models": json.dumps(f"{STATE}/deployed"),
        "listen": json.dumps([service.endpoint]),
    }
    if service.keys is not None:
        values["keys"] = json.dumps(f"/{FOLDER}/keys")
    if service.insecure:
        values["insecure"] = "true"
    return {UNIT: unit, SYSUSERS: sysusers, CONFIG: _configured(values)}


def _devices() -> str:
    """Serial ports of every kind: which one it is stands in the configuration, and may change there."""
    return "\n".join(
        f"DeviceAllow=char-{kind} rw" for kind in ("ttyAMA", "ttyS", "ttyTHS", "ttyUSB", "ttyACM")
    )


def _configured(values: dict[str, str]) -> str:
    """The commented example with these values; comments stay where they are."""
    text = Path(__file__).with_name("companion.toml").read_text(encoding="utf-8")
    for key, value in values.items():
        line = f"{key} = {value} ".ljust(38)
        pattern = rf"^(?:# )?{key} = [^#\n]*"
        text, count = re.subn(pattern, line.replace("\\", r"\\"), text, count=1, flags=re.MULTILINE)
        assert count == 1, key
    return re.sub(r"[ ]+$", "", text, flags=re.MULTILINE)


def install(service: Service, root: Path, dry_run: bool = False) -> list[tuple[Path, str]]:
    """Write the files below `root`; each path with what was done (or would be, on a `dry_run`).

    Raises `InputError` where something cannot be written; a file is either whole or as it was.
    """
    service = service.checked()
    files = {name: text.encode() for name, text in texts(service).items()}
    done = [(root / name, _put(root / name, text, dry_run, marked=True)) for name, text in files.items()]
    for source, name in ((service.vehicle, "vehicle.toml"), (service.design, "design.json")):
        path = root / FOLDER / name
        done.append((path, _put(path, source.read_bytes(), dry_run, marked=False)))
    if service.keys is not None:
        for name in (AUTHORITY, CERTIFICATE, PRIVATE_KEY, ACCESS):
            path = root / FOLDER / "keys" / name
            done.append(
                (path, _put(path, (service.keys / name).read_bytes(), dry_run, marked=False, mode=0o600))
            )
    return done


def _put(path: Path, text: bytes, dry_run: bool, marked: bool, mode: int = 0o644) -> str:
    whole = _MARK.encode() + hashlib.sha256(text).hexdigest().encode() + b"\n" + text if marked else text
    try:
        there = path.read_bytes() if path.exists() else None
        if there == whole:
            return SAME
        state = NEW if there is None else UPDATED if marked and _untouched(there) else KEPT
        if not dry_run:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o755 if mode == 0o644 else 0o700)
            target = path if state != KEPT else path.with_name(path.name + ".new")
            part = target.with_name(target.name + ".part")
            part.unlink(missing_ok=True)
            part.touch(mode)
            part.write_bytes(whole)
            part.chmod(mode)
            part.replace(target)
        return state
    except OSError as error:
        raise InputError(
            f"{path}: cannot write it ({error.strerror}); use sudo, or --output FOLDER"
        ) from None


def _untouched(there: bytes) -> bool:
    """Whether a file is as it was once written by us."""
    first, _, rest = there.partition(b"\n")
    return first == _MARK.encode() + hashlib.sha256(rest).hexdigest().encode()


def next_steps(service: Service) -> Iterator[str]:
    """The commands that make a service of the files, and the first things to look at."""
    if shutil.which("systemd-sysusers") or Path("/run/systemd/system").exists():
        yield "sudo systemd-sysusers                                   # makes the user"
    else:
        yield f"sudo useradd --system --groups dialout {service.user}"
    doctor = f"companion doctor --config /{CONFIG}"
    if service.keys is not None:
        yield f"sudo chown -R {service.user}: /{FOLDER}/keys                # nobody else reads them"
        program = Path(service.command.split()[0]).with_name("companion")
        doctor = f"sudo -u {service.user} {program} doctor --config /{CONFIG}"
    yield "sudo systemctl daemon-reload"
    yield doctor
    yield "sudo systemctl enable --now trueflight-companion"
    yield "journalctl -u trueflight-companion -f"
