"""A correction as C, compiled and run: natively, and for a Cortex-M7 in QEMU. As a script: what models cost there.

python tests/groundstation/c_compilers.py
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from trueflight.groundstation.export.correction_c import deployed, write
from trueflight.groundstation.reading import read_flight
from trueflight.models import contract
from trueflight.models.effects import catalogue
from trueflight.models.export import export_onnx
from trueflight.models.model import Model, Term, linear_model, rigid_body_model
from trueflight.models.network import Network

SAMPLES = Path(__file__).parents[2] / "samples"
HERE = Path(__file__).parent / "cortex_m7"
STRICT = (
    "-O2",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-Wpedantic",
    "-Wconversion",
    "-Wdouble-promotion",
)
SAME_DIGITS = "-ffp-contract=off"
ARM = ("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-sp-d16", "-mfloat-abi=hard")
SECTIONS = ("-ffunction-sections", "-fdata-sections")

_ROWS = r"""
#include <stdio.h>
#include "correction.h"

int main(void)
{
    float features[CORRECTION_FEATURES], delta[3];
    if (correction_self_test() != -1)
        return 3;
    while (fread(features, sizeof features, 1, stdin) == 1) {
        const int outside = correction_outside(features);
        float beyond[3];
        correction(features, delta);
        correction_beyond_rotation(features, beyond);
        fwrite(delta, sizeof delta, 1, stdout);
        fwrite(beyond, sizeof beyond, 1, stdout);
        fwrite(&outside, sizeof outside, 1, stdout);
    }
    return 0;
}
"""


FLIGHT = read_flight(SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet")
NAMES = tuple(contract.FEATURES)


def a_network(widths: tuple[int, ...], seed: int = 0, names: tuple[str, ...] = NAMES) -> Network:
    g = np.random.default_rng(seed)
    layers = tuple(
        (g.normal(0, 0.6, (b, a)).astype(np.float32), g.normal(0, 0.3, b).astype(np.float32))
        for a, b in pairwise([len(names), *widths, 3])
    )
    return Network(
        features=names,
        centre=g.normal(0, 1, len(names)).astype(np.float32),
        scale=g.uniform(0.5, 2, len(names)).astype(np.float32),
        layers=layers,
        output_scale=np.array([0.5, 0.6, 0.8], np.float32),
        low=np.full(len(names), -1, np.float32),
        high=np.full(len(names), 1, np.float32),
        data_hash="abc",
    )


def with_effects(effects: Mapping[str, Mapping[str, float]] | None, network: Network | None = None) -> Model:
    """A model with these effects; with None, with all there are, half as strong as usual."""
    if effects is None:
        effects = {
            e.name: {p.name: 0.5 * (p.neutral_for(FLIGHT.vehicle) + p.typical) for p in e.parameters}
            for e in catalogue().values()
            if e.name != "rigid_body"
        }
    base = rigid_body_model(FLIGHT.vehicle) if effects else linear_model(FLIGHT.vehicle)
    terms = tuple(Term(name, values) for name, values in effects.items())
    return base.with_terms((*base.terms, *terms)).with_network(network)


def header_of(model: Model) -> str:
    return write(model, deployed(export_onnx(model, FLIGHT))).text


def has_native() -> bool:
    """Whether this machine has a C compiler."""
    return shutil.which("gcc") is not None and shutil.which("g++") is not None


def has_cortex_m7() -> bool:
    """Whether this machine compiles for a Cortex-M7, and runs it (gcc-arm-none-eabi, libnewlib-arm-none-eabi,
    qemu-system-arm)."""
    return all(shutil.which(tool) for tool in ("arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"))


def _run(*command: str | Path, given: bytes = b"") -> bytes:
    words = [str(part) for part in command]
    done = subprocess.run(words, input=given, capture_output=True, timeout=120)
    assert done.returncode == 0, f"{command[0]}: {done.returncode}\n{done.stderr.decode()}"
    return done.stdout or done.stderr  # QEMU speaks for its guest on the latter


def evaluate(header: str, features: np.ndarray, folder: Path) -> np.ndarray:
    """What the native program makes of `features` (N, F): rows with `delta` and `beyond` rotation (3,), and `outside`,
    the first feature out of range."""
    (folder / "correction.h").write_text(header)
    (folder / "rows.c").write_text(_ROWS)
    for compiler in (("gcc", "-std=c99", "-x", "c"), ("g++", "-std=c++14", "-x", "c++")):
        _run(*compiler, *STRICT, SAME_DIGITS, "-o", folder / compiler[0], folder / "rows.c", "-lm")
    given = np.ascontiguousarray(features, dtype=np.float32).tobytes()
    out = _run(folder / "gcc", given=given)
    assert out == _run(folder / "g++", given=given)  # autopilots are written in C++
    return np.frombuffer(out, dtype=[("delta", "<f4", 3), ("beyond", "<f4", 3), ("outside", "<i4")])


@dataclass(frozen=True)
class Cost:
    """Of a correction on a Cortex-M7: `flash` and static `ram` of itself in bytes, `library` in bytes of flash that it
    brings in of libm, deepest `stack` in bytes, and `instructions` of one evaluation, as QEMU counts them."""

    flash: int
    library: int
    ram: int
    stack: int
    instructions: int


_ONE = """#include "correction.h"
#include "board.h"
static volatile float given[CORRECTION_FEATURES], found[3];
int run(void)
{
    float features[CORRECTION_FEATURES], delta[3] = {0.0F, 0.0F, 0.0F};
    for (int i = 0; i < CORRECTION_FEATURES; ++i)
        features[i] = given[i];
#ifdef WITH
    correction(features, delta);
#endif
    for (int i = 0; i < 3; ++i)
        found[i] = delta[i] + features[i];
    return 0;
}
"""


def on_cortex_m7(header: str, folder: Path) -> Cost:
    """Compile for a Cortex-M7, pass the self-test in QEMU, count."""
    (folder / "correction.h").write_text(header)
    flags = (*ARM, "-std=c99", *STRICT[:-3], SAME_DIGITS, *SECTIONS, f"-I{folder}", f"-I{HERE}")
    program, board = folder / "program.elf", HERE / "board.c"
    ends = ("-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections", "-T", HERE / "link.ld", "-lm")
    _run("arm-none-eabi-gcc", *flags, board, HERE / "main.c", *ends, "-o", program)
    said = _run(
        *("qemu-system-arm", "-M", "mps2-an500", "-nographic", "-icount", "shift=0", "-kernel", program),
        *("-semihosting-config", "enable=on,target=native"),
    ).decode()
    counted = re.fullmatch(r"self_test -1\ninstructions (\d+)\n", said)
    assert counted, said
    # one program with and without the correction: the difference is what it takes
    source = folder / "one.c"
    source.write_text(_ONE)
    own, whole = [], []
    for name, extra in (("without", ()), ("with", ("-DWITH", "-fstack-usage"))):
        part, linked = folder / f"{name}.o", folder / f"{name}.elf"
        _run("arm-none-eabi-gcc", *flags, *extra, "-c", source, "-o", part)
        _run("arm-none-eabi-gcc", *flags, part, board, *ends, "-o", linked)
        own.append(_sizes(part))
        whole.append(_sizes(linked))
    flash, ram = own[1] - own[0]
    functions = [line.split("\t") for line in (folder / "with.su").read_text().splitlines()]
    stack = sum(int(size) for _, size, _ in functions)  # they call each other, one deep
    return Cost(flash, whole[1][0] - whole[0][0] - flash, ram, stack, int(counted[1]))


def _sizes(file: Path) -> np.ndarray:
    """Bytes in flash and in RAM."""
    text, data, bss = (int(n) for n in _run("arm-none-eabi-size", file).split(b"\n")[1].split()[:3])
    return np.array([text + data, data + bss])


def _models() -> Iterator[tuple[str, str]]:
    """What is measured, and its header."""
    usual = {
        "thrust_gain": {"gain": 0.92},
        "battery_sag": {"exponent": 1.3},
        "rotor_drag": {"x": 0.3, "y": 0.35},
    }
    yield "three effects", header_of(with_effects(usual))
    yield "every effect", header_of(with_effects(None))
    for widths in ((8,), (16,), (32,), (16, 16), (32, 32), (64, 64), (64, 64, 64)):
        yield "network " + "-".join(map(str, widths)), header_of(with_effects({}, a_network(widths)))
    yield "three effects, network 64-64", header_of(with_effects(usual, a_network((64, 64))))


if __name__ == "__main__":
    row = "| {} | {} | {} | {} | {} | {} |\n"
    say = sys.stdout.write
    say(row.format("model", "flash, bytes", "and of libm", "static RAM", "stack", "instructions"))
    say(row.format(*6 * ["---"]))
    for label, header in _models():
        with tempfile.TemporaryDirectory() as made:
            cost = on_cortex_m7(header, Path(made))
        say(row.format(label, cost.flash, cost.library, cost.ram, cost.stack, cost.instructions))
