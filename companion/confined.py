"""What a child may do that reads a file or a message from outside: compute, and answer through what is open already.

Several fences, each enough by itself against opening files or the network; a kernel that lacks one is told, and
the others stand. Limits of POSIX hold everywhere: no further descriptor, no further process, little memory and
time. Linux adds a network namespace of its own, Landlock and seccomp. None of this makes a hostile file
welcome: it makes what it can reach small.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import resource
import struct
import sys
from pathlib import Path

_NEW_USER, _NEW_NET = 0x10000000, 0x40000000  # sched.h
_NO_NEW_PRIVILEGES, _DUMPABLE, _SECCOMP, _FILTER = 38, 4, 22, 2  # prctl.h
_LANDLOCK_CREATE, _LANDLOCK_RESTRICT = 444, 446
"""The same numbers on every architecture."""
_LANDLOCK_FILES = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""Rights over files that a version of Landlock knows; later ones know as many as the fifth."""

_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_FORBIDDEN = {
    "x86_64": {
        *(2, 85, 257, 437),  # open, creat, openat, openat2
        *(41, 42, 43, 44, 46, 49, 50, 53, 288),  # sockets
        *(56, 57, 58, 435, 59, 322),  # clone, fork, vfork, clone3, execve, execveat
        *(62, 101, 310, 311, 434, 438),  # kill, ptrace, process_vm_*, pidfd_open, pidfd_getfd
        *(82, 83, 84, 86, 87, 88, 76, 90, 92, 165, 161, 272, 308),  # renames, links, mounts, namespaces
        *(258, 259, 263, 264, 265, 266, 268, 316, 319, 321, 323, 298, 425, 248, 249, 250),
    },
    "aarch64": {
        *(56, 437),
        *(198, 199, 200, 201, 202, 203, 206, 211, 242),
        *(220, 435, 221, 281),
        *(129, 117, 270, 271, 434, 438),
        *(38, 276, 34, 35, 36, 37, 33, 45, 53, 54, 40, 51, 97, 268),
        *(279, 280, 282, 241, 425, 217, 218, 219),
    },
}


def leave_network() -> str:
    """Go into a network namespace in which there is nothing; '' or what the kernel said.

    To be called before any thread is started: a user namespace, which the right to do so comes from, needs that.
    """
    if sys.platform != "linux":
        return "no network namespaces here"
    library = ctypes.CDLL(None, use_errno=True)
    for flags in (_NEW_NET, _NEW_USER | _NEW_NET):
        if library.unshare(flags) == 0:
            return ""
    return f"no network namespace ({os.strerror(ctypes.get_errno())})"


def confine(memory: int, seconds: int) -> list[str]:
    """From here on `memory` more bytes, `seconds` of the processor, and nothing that is not open already.

    Returns what the kernel did not offer. To be called once everything needed is imported.
    """
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    missing = _no_files_and_sockets()
    if pages:
        memory += pages * resource.getpagesize()
        _at_most(resource.RLIMIT_AS, memory)
    _at_most(resource.RLIMIT_CPU, seconds)
    _at_most(resource.RLIMIT_FSIZE, 1 << 20)
    _at_most(resource.RLIMIT_CORE, 0)
    # What is open stays open; nothing else can be opened, whatever it is.
    _at_most(resource.RLIMIT_NOFILE, 0)
    _at_most(resource.RLIMIT_NPROC, 0)
    if sys.platform == "linux":
        missing += _filter_calls()
    return missing


def _at_most(kind: int, limit: int) -> None:
    """Lower a limit; one that is lower already stays, for nobody may raise it again."""
    _, hard = resource.getrlimit(kind)
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(kind, (limit, limit))


def _no_files_and_sockets() -> list[str]:
    """Landlock without a single rule: no file, no TCP, no signal to anybody else."""
    if sys.platform != "linux":
        return ["no Landlock here"]
    library = ctypes.CDLL(None, use_errno=True)
    library.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    library.prctl(_DUMPABLE, 0, 0, 0, 0)
    version = library.syscall(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return [f"no Landlock ({os.strerror(ctypes.get_errno())})"]
    files = (1 << _LANDLOCK_FILES.get(version, 16)) - 1
    # `struct landlock_ruleset_attr`: later kernels know more of its members.
    attributes = struct.pack("=QQQ", files, 0b11 if version >= 4 else 0, 0b11 if version >= 6 else 0)
    attributes = attributes[: 24 if version >= 6 else 16 if version >= 4 else 8]
    ruleset = library.syscall(_LANDLOCK_CREATE, attributes, ctypes.c_size_t(len(attributes)), 0)
    if ruleset < 0 or library.syscall(_LANDLOCK_RESTRICT, ruleset, 0) != 0:
        return [f"no Landlock ({os.strerror(ctypes.get_errno())})"]
    os.close(ruleset)
    return []


def _filter_calls() -> list[str]:
    """A seccomp filter that answers EPERM to whatever opens, connects, starts or signals."""
    machine = platform.machine()
    if machine not in _ARCHITECTURES or struct.calcsize("P") != 8:
        return [f"no list of system calls for {machine}"]
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    refuse, allow = 0x00050000 | errno.EPERM, 0x7FFF0000
    numbers = sorted(_FORBIDDEN[machine])
    program = [
        (load, 0, 0, 4),
        (equal, 1, 0, _ARCHITECTURES[machine]),
        (answer, 0, 0, refuse),
        (load, 0, 0, 0),
        (at_least, len(numbers) + 1, 0, 0x40000000),  # the other numbering of x86-64
        *((equal, len(numbers) - i, 0, number) for i, number in enumerate(numbers)),
        (answer, 0, 0, allow),
        (answer, 0, 0, refuse),
    ]
    code = b"".join(struct.pack("=HBBI", *line) for line in program)
    buffer = ctypes.create_string_buffer(code, len(code))
    header = struct.pack("HxxxxxxP", len(program), ctypes.addressof(buffer))
    library = ctypes.CDLL(None, use_errno=True)
    if library.prctl(_SECCOMP, _FILTER, ctypes.create_string_buffer(header, len(header)), 0, 0) != 0:
        return [f"no seccomp ({os.strerror(ctypes.get_errno())})"]
    return []
