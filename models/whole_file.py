"""Files that are there whole or not at all: written beside their place, forced to the disk, then renamed.

A kill or a full disk at any moment leaves what was there before. What a killed writer left beside a file is removed by
the next one that writes it. The flight record of a companion is the exception: it is appended to, and read without
its end.
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trueflight.models.errors import InputError

_LONGEST = 60
"""Characters of a file's name that stand in the name of its unfinished one: a name may have 255 bytes."""


@contextmanager
def whole_file(path: str | Path, what: str, advice: str = "", new: bool = False) -> Iterator[Path]:
    """Where to write `path` to: a file of the same name in a hidden folder beside it, which becomes `path` when the
    block ends well.

    `what` names the file in messages ("the design"), `advice` says what to do where it cannot be written; missing
    folders are made. With `new` a file that is there already is never replaced. A device (`/dev/stdout`) is written to
    as it is. Raises `InputError` where the file cannot be written, or is there already and must not be.
    """
    path = Path(path)
    try:
        place = Path(os.path.realpath(path)) if path.is_symlink() else path
        if place.exists() and not place.is_file() and not place.is_dir():
            yield place
            return
        if new and place.exists():
            raise FileExistsError(place)
        place.parent.mkdir(parents=True, exist_ok=True)
        _remove_left_over(place, every=new)
        with _folder_beside(place) as folder:
            partial = folder / place.name
            yield partial
            _to_disk(partial)
            if new:
                _link(partial, place)
            else:
                _keep_mode(partial, place)
                partial.replace(place)
            _to_disk(place.parent)
    except FileExistsError:
        raise InputError(f"{path}: is there already and is never overwritten; choose another name") from None
    except OSError as error:
        reason = f"{error.strerror or error}{advice and '; ' + advice}"
        raise InputError(f"{path}: cannot write {what} ({reason})") from None


def write_whole(
    path: str | Path, content: str | bytes, what: str, advice: str = "", new: bool = False
) -> None:
    """Write a text (UTF-8) or bytes as `whole_file` does. Raises `InputError` as it does."""
    with whole_file(path, what, advice, new) as partial:
        partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def is_hidden(path: Path, folder: Path) -> bool:
    """Whether a file below a folder is hidden, as unfinished ones are: who looks through a folder passes it by."""
    return any(part.startswith(".") for part in path.relative_to(folder).parts)


def _begin(place: Path) -> str:
    return f".{place.name[:_LONGEST]}."


@contextmanager
def _folder_beside(place: Path) -> Iterator[Path]:
    """A hidden folder beside a file, gone at the end. Its lock tells others that its writer lives."""
    folder = place.with_name(f"{_begin(place)}{secrets.token_hex(4)}.part")
    folder.mkdir()
    lock = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with contextlib.suppress(OSError):  # without locks, what a killed writer leaves stays
            fcntl.flock(lock, fcntl.LOCK_EX)  # who looks whether it is left over holds it for a moment
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _remove_left_over(place: Path, every: bool) -> None:
    """Remove unfinished files of this place whose writers have ended. With `every` also those of other places in its
    folder: a place that is written once only is never written again where the kill came just after its file was whole.
    An empty folder of another place may be one whose writer has not locked it yet."""
    mine = _begin(place)
    begin = f"{glob.escape(str(place.parent))}/{'.*.' if every else glob.escape(mine)}"
    for name in glob.iglob(f"{begin}????????.part"):
        with contextlib.suppress(OSError):
            lock = os.open(name, os.O_RDONLY | os.O_CLOEXEC)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if Path(name).is_dir() and (Path(name).name.startswith(mine) or any(Path(name).iterdir())):
                    shutil.rmtree(name, ignore_errors=True)
            finally:
                os.close(lock)


def _link(partial: Path, place: Path) -> None:
    """Give the file its name unless something has it. A rename would replace; where a file system has no links (a
    memory card), nothing better is left than to look first."""
    try:
        os.link(partial, place)
    except FileExistsError:
        raise
    except OSError:
        if place.exists():
            raise FileExistsError(place) from None
        partial.replace(place)


def _keep_mode(partial: Path, place: Path) -> None:
    if place.exists():
        with contextlib.suppress(OSError):
            partial.chmod(place.stat().st_mode & 0o7777)


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
