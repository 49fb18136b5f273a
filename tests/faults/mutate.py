"""Damaged files by the thousand through every reader, in-process, with a fixed seed and a time limit for each.

A reader may take a file or refuse it in one line (`InputError`); anything else is a failure: another exception, a
warning of numpy's beside the line, more processor time than `SECONDS`, or more memory than `MEMORY`. `run` is for the
campaign; alone:

    python tests/faults/mutate.py --count 100000 --seed 1
"""

from __future__ import annotations

import argparse
import collections
import random
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).parent))

from damage import damaged
from readers import Reader, readers

from trueflight.models.errors import InputError

SECONDS = 10.0
"""Processor time of one file; the slowest whole one takes below 1 s here."""
MEMORY = 2 << 30
"""Bytes of address space that a reader may take beside what the process has."""


class TooSlow(BaseException):
    """The time of a file is up. No reader may hold it, so it is no `Exception`."""


@dataclass(frozen=True)
class Failure:
    """What a reader did with one damaged file; `kept` is that file, where it is kept."""

    reader: str
    number: int
    what: str
    where: str
    kept: Path | None = None

    def __str__(self) -> str:
        return f"{self.reader} {self.number}: {self.what}\n{self.where}" + (
            f"\n{self.kept}" if self.kept else ""
        )


@dataclass
class Figures:
    """How many files were taken and refused, by reader, and the longest processor time (s)."""

    taken: collections.Counter[str] = field(default_factory=collections.Counter)
    refused: collections.Counter[str] = field(default_factory=collections.Counter)
    slowest: dict[str, float] = field(default_factory=dict)


def run(
    count: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, failed: None,
    only: str = "",
    without: Sequence[str] = (),
    keep: Path | None = None,
    figures: Figures | None = None,
) -> list[Failure]:
    """`count` damaged files, the same for the same seed, each through its reader; `progress` hears how many are done
    and how many failed. Files that failed are kept in the folder `keep`."""
    figures = figures or Figures()
    failures: list[Failure] = []
    with tempfile.TemporaryDirectory(prefix="mutated-") as name, _limits():
        folder = Path(name)
        chosen = [reader for reader in readers(folder) if only in reader.name and reader.name not in without]
        weights = [reader.weight for reader in chosen]
        for number in range(count):
            draw = random.Random(f"{seed} {number}")
            reader = draw.choices(chosen, weights)[0]
            content = damaged(draw, draw.choice(reader.seeds), reader.seeds, reader.kind)
            failure = _one(reader, number, content, folder / f"file{reader.suffix}", figures)
            if failure is not None:
                failures.append(_kept(failure, reader, content, keep))
            progress(number + 1, len(failures))
    return failures


def _one(reader: Reader, number: int, content: bytes, path: Path, figures: Figures) -> Failure | None:
    path.write_bytes(content)
    begun = _processor_time()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", RuntimeWarning)
            reader.read(path)
    except InputError as error:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        if isinstance(error.__cause__, MemoryError):
            return Failure(
                reader.name, number, f"takes more than {MEMORY >> 20} MiB", _place(error.__cause__)
            )
        figures.refused[reader.name] += 1
    except TooSlow as error:
        return Failure(reader.name, number, f"takes more than {SECONDS:g} s", _place(error))
    except (Exception, SystemExit) as error:  # noqa: BLE001 - any other exception is what is looked for
        return Failure(reader.name, number, f"{type(error).__name__}: {str(error)[:200]}", _place(error))
    else:
        figures.taken[reader.name] += 1
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        took = _processor_time() - begun
        figures.slowest[reader.name] = max(took, figures.slowest.get(reader.name, 0.0))
    if said:
        first = said[0]
        return Failure(reader.name, number, f"warns: {first.message}", f"{first.filename}:{first.lineno}")
    return None


def _place(error: BaseException) -> str:
    return "".join(traceback.format_tb(error.__traceback__)[-4:]).rstrip()


def _kept(failure: Failure, reader: Reader, content: bytes, keep: Path | None) -> Failure:
    if keep is None:
        return failure
    keep.mkdir(parents=True, exist_ok=True)
    path = keep / f"{reader.name.replace(' ', '-')}-{failure.number}{reader.suffix}"
    path.write_bytes(content)
    return Failure(failure.reader, failure.number, failure.what, failure.where, path)


def _processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


class _limits:
    """Memory and signal of the files; what was there before comes back."""

    def __enter__(self) -> None:
        def up(_signal: int, _frame: FrameType | None) -> None:
            raise TooSlow

        self._handler = signal.signal(signal.SIGPROF, up)
        self._memory = resource.getrlimit(resource.RLIMIT_AS)
        self._warnings = warnings.catch_warnings()
        self._warnings.__enter__()
        warnings.simplefilter("ignore")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        # threads of pyarrow and torch take address space of their own when they start
        most = pages * resource.getpagesize() + MEMORY + (4 << 30)
        resource.setrlimit(resource.RLIMIT_AS, (most, self._memory[1]))

    def __exit__(self, *_: object) -> None:
        resource.setrlimit(resource.RLIMIT_AS, self._memory)
        self._warnings.__exit__(None, None, None)
        signal.signal(signal.SIGPROF, self._handler)


def main() -> int:
    """Run alone: prints what failed and the sums; exit code 1 where anything did."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="readers whose name holds this text")
    parser.add_argument("--without", action="append", default=[], help="a reader to leave out")
    parser.add_argument("--keep", type=Path, default=None, help="folder for the files that failed")
    asked = parser.parse_args()
    figures = Figures()

    def progress(done: int, failed: int) -> None:
        if done % 1000 == 0:
            print(f"{done} of {asked.count} files, {failed} failures", file=sys.stderr, flush=True)  # noqa: T201

    failures = run(asked.count, asked.seed, progress, asked.only, asked.without, asked.keep, figures)
    kinds = collections.Counter((f.reader, f.what, f.where.rsplit("\n", 2)[0][-200:]) for f in failures)
    for (reader, what, _), times in kinds.most_common():
        first = next(f for f in failures if (f.reader, f.what) == (reader, what))
        print(f"{times} times {first}")  # noqa: T201
    for name in sorted(figures.slowest):
        print(  # noqa: T201
            f"{name:22s} {figures.taken[name]:6d} taken {figures.refused[name]:6d} refused, "
            f"slowest {figures.slowest[name]:.2f} s"
        )
    print(f"{asked.count} files, seed {asked.seed}: {len(failures)} failures")  # noqa: T201
    return int(bool(failures))


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    shutil.os._exit(code)  # type: ignore[attr-defined]  # threads of libraries that the limits starved must not hold it
