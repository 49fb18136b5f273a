"""The correction as one C99 header: effects and network in float, without allocation, for an autopilot's own module.

It computes what the ONNX file of the same model computes: the effects' own formulas, traced in symbols, and the
network's layers as tables. The golden vectors of that file are its self-test.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import sympy
from sympy.codegen.ast import float32, real
from sympy.printing.c import C99CodePrinter

from trueflight.groundstation.export.equations import traced
from trueflight.groundstation.export.symbols import Symbolic
from trueflight.groundstation.export.target import NOT, WHOLE, Line, Written
from trueflight.groundstation.export.words import one_line
from trueflight.models import contract
from trueflight.models.effect import Array, Effect, Stage
from trueflight.models.features import feature_names
from trueflight.models.model import Model
from trueflight.models.network import Network, folded_layers
from trueflight.models.prediction import error_acceleration, motion_of_features
from trueflight.models.vehicle import GRAVITY

ENDING = ".h"
_WIDTH = 110


@dataclass(frozen=True)
class Deployed:
    """What the ONNX file of a model says beside its graph: its `hash`, the features with their training range, golden
    `vectors` (K, F) and `answers` (K, 3), and the numbers of the `actuation`."""

    hash: str
    features: tuple[Mapping[str, Any], ...]
    vectors: np.ndarray
    answers: np.ndarray
    actuation: Mapping[str, float]


def deployed(onnx: bytes) -> Deployed:
    """What an ONNX file made by `models.export` says of itself."""
    from onnx import load_from_string

    meta = {one.key: one.value for one in load_from_string(onnx).metadata_props}
    return Deployed(
        contract.model_hash(onnx),
        tuple(json.loads(meta[contract.KEY_FEATURES])),
        np.array(json.loads(meta[contract.KEY_GOLDEN_FEATURES]), dtype=np.float32),
        np.array(json.loads(meta[contract.KEY_GOLDEN_DELTA]), dtype=np.float32),
        json.loads(meta.get(contract.KEY_ACTUATION, "{}")),
    )


def write(model: Model, file: Deployed) -> Written:
    """The C header of a model, with what its deployed `file` says. Raises `InputError` where a user's effect cannot be
    traced."""
    lines = tuple(_lines(model))
    network, names = model.network, feature_names(model)
    # its fade is a function of its own here: as units of the layers it would be mostly zeros, in flash
    layers = [] if network is None else folded_layers(replace(network, margin=None), names)
    notes = tuple(_notes(file, layers))
    said = (f"{model.vehicle.name}, {model.label}, written by trueflight from model {file.hash}", *notes)
    held = [
        f"{'holds' if line.held == WHOLE else 'does NOT hold'} {line.effect}: {line.how}" for line in lines
    ]
    text = _header(_comment([*said, *held]), model, file, layers)
    return Written(text, lines, notes)


def _static(model: Model) -> list[tuple[Effect, Mapping[str, float]]]:
    """The effects that a correction without memory holds."""
    return [
        (effect, values)
        for effect, values in model.effect_chain()
        if effect.exports and effect.stage is not Stage.SENSOR
    ]


def _lines(model: Model) -> Iterator[Line]:
    held = {effect.name for effect, _ in _static(model)}
    for effect, _ in model.effect_chain():
        if effect.name in held:
            yield Line(effect.name, WHOLE, "its own formula, with the fitted numbers")
        elif effect.undone_by_look_ahead:
            yield Line(
                effect.name, NOT, "has memory; the caller looks ahead by the CORRECTION_*_DELAY and _LAG"
            )
        elif effect.stage is Stage.SENSOR:
            yield Line(
                effect.name, NOT, "an error of the sensor, which nothing needs to be commanded against"
            )
        else:
            yield Line(
                effect.name,
                NOT,
                "has memory or acts on the torque; a correction of the acceleration has neither",
            )
    if model.network is not None:
        yield Line("network", WHOLE, f"{model.network.parameters} numbers, float")


def _notes(file: Deployed, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterator[str]:
    widest = max((len(b) for _, b in layers), default=0)
    yield "C99, float, no allocation, no state; needs math.h; compile with -ffp-contract=off to get the same digits"
    if widest:
        yield f"stack: two rows of {widest} floats for the network's layers"
    if file.actuation:
        yield "what was measured of the path from command to motion is in CORRECTION_*: evaluate it that far ahead"


def _expressions(model: Model) -> tuple[sympy.Expr, ...]:
    """The effects' part of the correction, three expressions of the features."""
    names = feature_names(model)
    columns = {name: Symbolic(np.array([_symbol(name)], dtype=object)) for name in names}
    motion = motion_of_features(cast(Mapping[str, Array], columns), model.vehicle)
    chain = _static(model)
    if not chain:
        return ()
    delta = cast(Symbolic, traced(lambda: error_acceleration(motion, chain), motion, chain))
    return tuple(sympy.sympify(one) for one in delta.values[0])


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(f"f_{name}", real=True)


# --- as C -----------------------------------------------------------------------------------------------------------


def _header(said: str, model: Model, file: Deployed, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> str:
    names = feature_names(model)
    listed = ",\n".join(f"    CORRECTION_{n.upper()}{_meaning(n, file)}" for n in names[:-1])
    actuation = "".join(
        f"#define CORRECTION_{name.upper()} {_float(value)} /* {'1/s' if name.endswith('integral') else 's'} */\n"
        for name, value in file.actuation.items()
    )
    low, high = (_floats([feature[key] for feature in file.features]) for key in ("low", "high"))
    vectors, answers = (
        ",\n".join("        {" + _floats(row) + "}" for row in table)
        for table in (file.vectors, file.answers)
    )
    return f"""{said}
#ifndef TRUEFLIGHT_CORRECTION_H
#define TRUEFLIGHT_CORRECTION_H

#include <math.h>

#define CORRECTION_MODEL "{file.hash}" /* of the ONNX file that computes the same */
#define CORRECTION_MASS {_float(model.vehicle.mass)} /* kg */
#define CORRECTION_HOVER_THRUST {_float(model.vehicle.hover_thrust)} /* normalised command, by which T was made */
{actuation}
/* What goes in, by place. World ENU with z above ground; heading frame: x ahead, y left, z up, yaw taken out;
   phi and theta are roll and pitch of the body (FLU) against it. */
enum {{
{listed},
    CORRECTION_{names[-1].upper()}{_meaning(names[-1], file)},
    CORRECTION_FEATURES
}};

/* The first feature outside the range of the flights that the model is from (NaN is outside), or -1: beyond it do not
   use the correction. */
static inline int correction_outside(const float features[CORRECTION_FEATURES])
{{
    static const float low[CORRECTION_FEATURES] = {{{low}}};
    static const float high[CORRECTION_FEATURES] = {{{high}}};
    for (int i = 0; i < CORRECTION_FEATURES; ++i)
        if (!(low[i] <= features[i] && features[i] <= high[i]))
            return i;
    return -1;
}}

static inline float correction_square(float x)
{{
    return x * x;
}}
{_share(model.network, names)}{_layers(layers, model.network)}
/* Error acceleration in m/s^2, heading frame: what the vehicle does beyond its hover linearisation. The cascade
   commands its own acceleration less this. */
static inline void correction(const float features[CORRECTION_FEATURES], float delta[3])
{{
{_body(model, layers)}}}

/* The same against the exact rotation of thrust, for a cascade that inverts it, as PX4's position control does: what
   the vehicle does beyond thrust T along its own z axis. */
static inline void correction_beyond_rotation(const float features[CORRECTION_FEATURES], float delta[3])
{{
    const float sin_phi = features[CORRECTION_SIN_PHI], cos_phi = features[CORRECTION_COS_PHI];
    const float sin_theta = features[CORRECTION_SIN_THETA], cos_theta = features[CORRECTION_COS_THETA];
    const float thrust = features[CORRECTION_T] / CORRECTION_MASS;
    correction(features, delta);
    delta[0] += {_float(GRAVITY)} * asinf(fminf(1.0F, fmaxf(-1.0F, sin_theta))) - sin_theta * cos_phi * thrust;
    delta[1] += sin_phi * thrust - {_float(GRAVITY)} * asinf(fminf(1.0F, fmaxf(-1.0F, sin_phi)));
    delta[2] += thrust - cos_theta * cos_phi * thrust;
}}

/* The first golden vector that is not met within {_float(contract.GOLDEN_TOLERANCE)[:-1]} m/s^2, or -1: do not fly. */
static inline int correction_self_test(void)
{{
    static const float given[][CORRECTION_FEATURES] = {{
{vectors}
    }};
    static const float wanted[][3] = {{
{answers}
    }};
    for (int i = 0; i < {len(file.vectors)}; ++i) {{
        float got[3];
        correction(given[i], got);
        for (int k = 0; k < 3; ++k)
            if (!(fabsf(got[k] - wanted[i][k]) <= {_float(contract.GOLDEN_TOLERANCE)}))
                return i;
    }}
    return -1;
}}

#endif
"""


def _meaning(name: str, file: Deployed) -> str:
    unit = next(str(feature["unit"]) for feature in file.features if feature["name"] == name)
    return f" /* {'no unit' if unit == '1' else unit} */"


def _comment(said: Sequence[str]) -> str:
    lines = "\n".join(f" * {one_line(text).replace('*/', '* /')}" for text in said)
    return f"/*\n{lines}\n */"


class _Printer(C99CodePrinter):
    """Expressions in float, each minimum and maximum with two arguments."""

    def __init__(self) -> None:
        super().__init__({"type_aliases": {real: float32}})

    def _print_Float(self, expr: Any) -> str:
        return _float(float(expr))

    def _print_Rational(self, expr: Any) -> str:
        return _float(expr.p / expr.q)

    def _print_Integer(self, expr: Any) -> str:
        return _float(float(expr))

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:
        power = expr.exp
        if power.is_Number and power < 0:
            return f"(1.0F/{self._print_Pow(expr.base**-power) if power != -1 else self.parenthesize(expr.base, 1000)})"
        if power == 2:
            return f"correction_square({self._print(expr.base)})"
        return cast(str, super()._print_Pow(expr))


def _float(value: float) -> str:
    """A float's shortest text, as C reads it."""
    text = str(np.float32(value))
    return (text if any(c in text for c in ".en") else f"{text}.0") + "F"


def _floats(values: Sequence[float] | np.ndarray, indent: str = "        ") -> str:
    """Numbers with commas between, on as many lines as they need."""
    text = ", ".join(_float(float(value)) for value in values)
    return textwrap.fill(
        text, _WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False
    )


def _body(model: Model, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> str:
    expressions = _expressions(model)
    learnt = "    correction_network(features, delta);\n" if layers else ""
    if not expressions:
        nothing = "    (void)features;\n    delta[0] = delta[1] = delta[2] = 0.0F;\n"
        return learnt or nothing
    shared, results = sympy.cse(expressions, symbols=sympy.numbered_symbols("c"), order="none")
    printer = _Printer()
    used = set().union(*(one.free_symbols for one in expressions))
    taken = "".join(
        f"    const float {_symbol(name)} = features[CORRECTION_{name.upper()}];\n"
        for name in feature_names(model)
        if _symbol(name) in used
    )
    unused = "" if taken or layers else "    (void)features;\n"
    steps = "".join(_statement(f"const float {name} = {printer.doprint(value)};") for name, value in shared)
    sign = "+=" if layers else "="
    last = "".join(
        _statement(f"delta[{i}] {sign} {printer.doprint(value)};") for i, value in enumerate(results)
    )
    return f"{unused}{taken}{steps}{learnt}{last}"


def _statement(text: str) -> str:
    """A statement on as many lines as it needs; a blank is nowhere inside a word of C."""
    return (
        textwrap.fill(
            text,
            _WIDTH,
            initial_indent="    ",
            subsequent_indent="        ",
            break_on_hyphens=False,
            break_long_words=False,
        )
        + "\n"
    )


def _share(network: Network | None, names: Sequence[str]) -> str:
    """How much of a network that fades acts, as a function; nothing for one that does not."""
    if network is None or network.margin is None:
        return ""
    count = len(network.features)
    places = ", ".join(f"CORRECTION_{name.upper()}" for name in network.features)
    places = textwrap.fill(places, _WIDTH, subsequent_indent="        ", break_on_hyphens=False)
    low, high = _floats(network.low), _floats(network.high)
    return f"""
/* Share of the network that acts: 1 in the range of the flights that it was trained on, 0 far outside. */
static inline float correction_share(const float features[CORRECTION_FEATURES])
{{
    static const int place[{count}] = {{{places}}};
    static const float low[{count}] = {{{low}}};
    static const float high[{count}] = {{{high}}};
    static const float per_unit[{count}] = {{{_floats(1.0 / network.margin)}}};
    float outside = 0.0F;
    for (int i = 0; i < {count}; ++i) {{
        const float x = features[place[i]];
        if (x < low[i])
            outside += (low[i] - x) * per_unit[i];
        else if (!(x <= high[i]))
            outside += (x - high[i]) * per_unit[i];
    }}
    return outside < 1.0F ? 1.0F - outside : 0.0F;
}}
"""


def _layers(layers: Sequence[tuple[np.ndarray, np.ndarray]], network: Network | None) -> str:
    """The network as a function: two rows of values that take turns, linear units rectified between the layers."""
    if not layers or network is None:
        return ""
    tables, calls = [], []
    widest = max(len(biases) for _, biases in layers)
    given = "features"
    for number, (weights, biases) in enumerate(layers):
        rows, columns = weights.shape
        table = ",\n".join("        {" + _floats(row) + "}" for row in weights)
        tables.append(
            f"    static const float w{number}[{rows}][{columns}] = {{\n{table}\n    }};\n"
            f"    static const float b{number}[{rows}] = {{{_floats(biases)}}};\n"
        )
        last = number == len(layers) - 1
        out = "delta" if last else ("one", "other")[number % 2]
        calls.append(
            f"    correction_layer(&w{number}[0][0], b{number}, {rows}, {columns}, {given}, {out}, {int(not last)});\n"
        )
        given = out
    rows_of = (
        ""
        if len(layers) == 1
        else f"    float one[{widest}]" + (";\n" if len(layers) == 2 else f", other[{widest}];\n")
    )
    if network.margin is not None:
        calls += [
            "    const float share = correction_share(features);\n",
            "    for (int i = 0; i < 3; ++i)\n        delta[i] *= share;\n",
        ]
    return f"""
static inline void correction_layer(const float *weights, const float *biases, int rows, int columns, const float *in,
                                    float *out, int rectified)
{{
    for (int i = 0; i < rows; ++i) {{
        float sum = 0.0F;
        for (int k = 0; k < columns; ++k)
            sum += weights[i * columns + k] * in[k];
        sum += biases[i];
        out[i] = rectified && sum < 0.0F ? 0.0F : sum;
    }}
}}

static inline void correction_network(const float features[CORRECTION_FEATURES], float delta[3])
{{
{"".join(tables)}{rows_of}{"".join(calls)}}}
"""
