"""Damaged files, uninvited peers, and what the plain cascade's latency is beside an earlier version's."""

from __future__ import annotations

import importlib
import json
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from promise import Row

HERE = Path(__file__).parent
SLOWER = 1.1
"""By how much the median may differ from the earlier version's, each as a ratio to the echo of its own run."""

KINDS = {
    "uninvited peers: plain TCP, no certificate, a foreign one, one that has run out, one that is not on the list": (
        *("plain_tcp", "no_certificate", "foreign_authority", "expired_certificate", "not_on_the_list"),
    ),
    "broken and silent handshakes": ("broken_handshakes",),
    "the wrong role, queries for everything, forged ticks and tokens": (
        *("wrong_role", "wildcards", "forged_publications", "forged_by_a_colleague"),
    ),
    "others that stand in for the vehicle": ("engineer_as_vehicle", "other_vehicle"),
    "models unsigned, changed, replayed, for another vehicle, by nobody": (
        *("signed_model_and_replay", "unsigned_model", "tampered_model", "signed_for_another_vehicle"),
        *("edited_signature", "signed_by_nobody", "mutated_signature"),
    ),
    "without keys: forged tokens, two vehicles, two of one name": (
        *("forged_token", "two_of_one_name", "second_of_one_name_later", "two_vehicles"),
    ),
}
"""The attacks of `hostile_network` by kind; one that is not named here is a row of its own."""
KINDS_HOLD = dict(
    zip(
        KINDS,
        (
            "not let in, nothing reached",
            "nobody cut off, others get in again",
            "each reaches what it may, and nothing else",
            "no mission goes to them",
            "refused; the signed one is taken, once",
            "a mission goes to the vehicle that was meant, or to none",
        ),
        strict=True,
    )
)


def files(count: int, kills: int, seed: int, limit: float) -> Iterator[Row]:
    """`count` mutated files through every reader; every writer on the ground killed `kills` times and on a full disk.

    Each in a process of its own that may take `limit` s.
    """
    out, why = _program(limit, "mutate.py", "--count", str(count), "--seed", str(seed))
    readers = re.findall(r"^(.+?) +(\d+) taken +(\d+) refused, slowest ([\d.]+) s$", out, re.MULTILINE)
    failures = re.search(r"(\d+) failures$", out.strip())
    seen = why
    if failures:
        taken, refused = (sum(int(row[i]) for row in readers) for i in (1, 2))
        seen = (
            f"{len(readers)} readers: {taken} read, {refused} refused in one line, {failures[1]} failures; "
        )
        seen += f"slowest {max(float(row[3]) for row in readers):.1f} s"
    promised = "read, or refused in one line; no traceback, no hang"
    yield Row(f"mutated files through every reader, seed {seed}", count, promised, seen, not why)
    out, why = _program(limit, "writers.py", "--kills", str(kills), "--seed", str(seed))
    writers = re.findall(r"^(.+?) +(\d+) wrong$", out, re.MULTILINE)
    seen = f"{len(writers)} writers, {sum(int(wrong) for _, wrong in writers)} wrong" if writers else why
    promised = "what was there before stays, nothing half-written"
    yield Row(
        "everything written on the ground, killed in its middle, and a full disk",
        kills,
        promised,
        seen,
        not why,
    )


def _program(limit: float, name: str, *arguments: str) -> tuple[str, str]:
    """What a program beside this one printed, and '' or why it failed."""
    command = [sys.executable, str(HERE / name), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return "", f"not done after {limit:.0f} s"
    told = (done.stderr.strip() or done.stdout.strip() or "no answer").splitlines()[-1]
    return done.stdout, f"exit code {done.returncode}: {told}" if done.returncode else ""


def networks(folder: Path, times: int) -> Iterator[Row]:
    """Every attack of `hostile_network` on a companion with keys, `times` times; attacks of a kind are one row."""
    hostile = importlib.import_module("hostile_network")
    found: dict[str, list[str]] = {}
    with hostile.Stage(folder) as stage:
        for attack in hostile.ATTACKS:
            kind = next((kind for kind, names in KINDS.items() if attack.name in names), attack.expected)
            results = (attack.run(stage) for _ in range(times))
            found.setdefault(kind, []).extend(f"{attack.name}: {what}" if what else "" for what in results)
    for kind, told in found.items():
        wrong = sorted(set(filter(None, told)))
        seen = "; ".join(wrong)[:300] or "held each time"
        yield Row(kind, len(told), KINDS_HOLD.get(kind, "held"), seen, not wrong)


def latency(before: Path | None, rounds: int, rates: str = "100,250") -> Iterator[Row]:
    """`benchmarks/companion_latency.py` of this version and of an earlier one, by turns."""
    trees = [HERE.parents[1], *([before] if before else [])]
    found: list[list[dict[str, Any]]] = [[] for _ in trees]
    for _ in range(rounds):
        for tree, rows in zip(trees, found, strict=True):
            rows += _benchmark(tree, rates)
    for rate in map(float, rates.split(",")):
        here = _of(found[0], rate)
        seen = (
            f"median {_pair(here, 'median')}, p99 {_pair(here, 'p99')} of its echo; {_lost(here)} unanswered"
        )
        promised, kept = "told", True
        if before:
            then = _of(found[1], rate)
            seen += f"; before: median {_pair(then, 'median')}, p99 {_pair(then, 'p99')}; {_lost(then)} unanswered"
            promised = f"median at most {SLOWER:g} times that of before, as ratios"
            kept = _ratio(here, "median") <= SLOWER * _ratio(then, "median")
        yield Row(f"plain cascade at {rate:.0f} Hz beside MAVSDK's plugins", rounds, promised, seen, kept)


def _benchmark(tree: Path, rates: str) -> list[dict[str, Any]]:
    # This version's stopwatch for both: only what it times is the tree's.
    benchmark = str(HERE.parents[1] / "benchmarks" / "companion_latency.py")
    command = [sys.executable, benchmark, "--rates", rates, "--rounds", "1", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(
        command, cwd=tree, env=environment, capture_output=True, text=True, timeout=600.0, check=True
    )
    return list(json.loads(done.stdout.strip().splitlines()[-1])["rows"])


def _of(rows: list[dict[str, Any]], rate: float) -> list[dict[str, Any]]:
    return [row for row in rows if row["rate"] == rate and row["program"] == "companion"]


def _ratio(rows: list[dict[str, Any]], what: str) -> float:
    return statistics.median(row[f"{what}_ratio"] for row in rows)


def _pair(rows: list[dict[str, Any]], what: str) -> str:
    return (
        f"{statistics.median(row[f'{what}_ms'] for row in rows):.2g} ms, {_ratio(rows, what):.2g} times that"
    )


def _lost(rows: list[dict[str, Any]]) -> str:
    return f"{sum(row['lost'] for row in rows)} of {sum(row['sent'] for row in rows)}"
