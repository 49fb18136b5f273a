"""Who could reach the companion and fly the vehicle, as findings for doctor and preflight."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from trueflight.companion.findings import DANGER, FAIL, NOTE, OK, WARN, Finding
from trueflight.companion.settings import Settings
from trueflight.companion.zenoh_session import INSECURE, plan_session
from trueflight.models.access import CERTIFICATE, Keys, certificate_period
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle


def access_findings(settings: Settings) -> Iterator[Finding]:
    """Who could reach the companion and fly the vehicle: keys and how long they hold, or what is open to anybody."""
    name = ""
    if settings.vehicle:
        with contextlib.suppress(InputError):
            name = load_vehicle(settings.vehicle).name
    try:
        keys = settings.own_keys()
        plan = plan_session(settings.zenoh, keys, name)
    except InputError as error:
        if settings.keys and not _readable(Path(settings.keys)):
            advice = "run it as the service's user: sudo -u trueflight companion ..."
            yield Finding("access", f"{settings.keys} is not for this user", "", advice, NOTE)
        else:
            yield Finding("access", "cannot be opened", "", str(error), FAIL)
        return
    if plan.exposed:
        yield Finding("access", f"INSECURE: it {' and '.join(plan.exposed)}", "", INSECURE, DANGER)
    elif plan.loose:
        yield Finding("access", "TLS, no access control", "", plan.loose, WARN)
    elif keys is None:
        yield Finding(
            "access", "this machine alone", "", "no keys; groundstation keys opens it to the ground", NOTE
        )
    else:
        told = ", ".join(f"{person.name} ({person.role})" for person in keys.people)
        yield Finding(
            "access", told or "nobody", "", "" if told else "its keys let nobody in", OK if told else WARN
        )
        yield _validity(keys)


def _validity(keys: Keys) -> Finding:
    """How long the own certificate holds, by this machine's clock."""
    try:
        end, begin = certificate_period(keys.path(CERTIFICATE))
    except ValueError:
        return Finding("keys", str(keys.path(CERTIFICATE)), "", "no certificate; make new keys", FAIL)
    now = time.time()
    if now < begin:
        return Finding(
            "keys", "not valid yet", "", "this machine's clock is wrong (step 'clock' above)", FAIL
        )
    days = (end - now) / 86400
    advice = f"groundstation keys FOLDER --remove {keys.name} --vehicle {keys.name}, and copy the new ones"
    if days < 0:
        return Finding("keys", "have run out", "", advice, FAIL)
    state = OK if days > 14 else WARN
    return Finding("keys", f"valid for {days:.0f} days", "", "" if state == OK else advice, state)


def _readable(folder: Path) -> bool:
    """Whether this user may look into a folder, or it is not there at all."""
    return not folder.exists() or os.access(folder, os.R_OK | os.X_OK)
