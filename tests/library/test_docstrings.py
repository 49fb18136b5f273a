"""Public docstrings name every argument, with shapes and units: strictly on the face, as far as quantities go below
it."""

import dataclasses
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import trueflight as tf
import trueflight.models
from trueflight.groundstation import library
from trueflight.models.flight import COLUMNS

FACE = [getattr(library, name) for name in library.__all__]
OWN = [one for one in FACE if one.__module__.startswith("trueflight.groundstation.library")]
FUNCTIONS = [one for one in OWN if inspect.isfunction(one)]
CLASSES = [one for one in OWN if inspect.isclass(one)]
SHAPE = re.compile(r"\((?:[A-Z]|\d|\.\.\.)(?:,[^()]*)?\)")
UNIT = re.compile(
    r"\b(m|m/s|m/s²|m²|m/s\^2|rad|rad/s|rad²|s|cm|Hz|kg|N|V|SI units?|share|0 to 1|95 %)\b|m/s²|m²|rad²"
)
QUANTITY = {
    "bandwidth": "Hz",
    "attitude_bandwidth": "Hz",
    "rate": "Hz",
    "noise": "factor",
    "parameters": "SI units",
}


def said(name: str, text: str) -> bool:
    """Whether a docstring names an argument, as code or as a word."""
    return re.search(rf"\b{re.escape(name)}\b", text) is not None


def code_of(function: Callable[..., Any]) -> str:
    return inspect.getsource(function)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_a_function_of_the_face_tells_all_of_its_arguments(function: Callable[..., Any]) -> None:
    text = inspect.getdoc(function) or ""
    taken = inspect.signature(function).parameters
    assert not [name for name in taken if f"`{name}`" not in text]
    for name in taken:
        assert name not in QUANTITY or QUANTITY[name] in text, f"{name}: no {QUANTITY[name]}"
    assert text.splitlines()[0].endswith((".", ":", "):")) or text.split("\n\n")[0].endswith("."), (
        "one line of purpose"
    )
    assert "Raises `InputError`" in text
    assert UNIT.search(text), "no unit, of what it takes or gives"


@pytest.mark.parametrize("one", CLASSES, ids=lambda c: c.__name__)
def test_a_result_tells_all_of_its_fields_with_shapes_and_units(one: type) -> None:
    text = "\n".join(inspect.getdoc(c) or "" for c in one.__mro__ if c.__module__.startswith("trueflight"))
    fields = [f for f in dataclasses.fields(one) if not f.name.startswith("_")]
    table = (
        {"name", *COLUMNS} if one is tf.Flight else set()
    )  # what the docstring refers to has a unit for each
    assert not [f.name for f in fields if f.name not in table and not said(f.name, text)]
    if any("ndarray" in str(f.type) for f in fields):
        assert SHAPE.search(text), "an array without its shape"
    if one is not tf.Summary:
        assert UNIT.search(inspect.getdoc(one) or ""), "no unit"


def answers() -> Iterator[tuple[type, str, Callable[..., Any]]]:
    """The methods and properties that the classes of the face add."""
    for one in CLASSES:
        for name, member in vars(one).items():
            if name.startswith("_") or name in {f.name for f in dataclasses.fields(one)}:
                continue
            function = getattr(member, "fget", None) or getattr(member, "func", None) or member
            if inspect.isfunction(function):
                yield one, name, function


@pytest.mark.parametrize(
    ("one", "name", "function"), list(answers()), ids=[f"{one.__name__}.{name}" for one, name, _ in answers()]
)
def test_an_answer_tells_its_arguments_errors_and_units(
    one: type, name: str, function: Callable[..., Any]
) -> None:
    text = inspect.getdoc(function) or ""
    assert text, "no docstring"
    taken = [p for p in inspect.signature(function).parameters if p != "self"]
    assert not [p for p in taken if f"`{p}`" not in text and f'"{p}"' not in text]
    raises = any(
        word in code_of(function) for word in ("raise InputError", "picture(", "data_frame(", "write")
    )
    assert not raises or "Raises `InputError`" in text
    if name.startswith(("to_", "plot")):
        assert UNIT.search(text) or "units" in text


def quantities() -> Iterator[tuple[str, Callable[..., Any], str]]:
    """The public functions of models/ that take or give numbers and arrays, with what is known of their classes."""
    for found in pkgutil.walk_packages(trueflight.models.__path__, "trueflight.models."):
        if found.name.endswith("record_pb2"):
            continue
        module = importlib.import_module(found.name)
        for name, one in vars(module).items():
            if name.startswith("_") or getattr(one, "__module__", "") != found.name:
                continue
            if inspect.isfunction(one):
                yield f"{found.name}.{name}", one, ""
            elif inspect.isclass(one):
                for method, function in vars(one).items():
                    if not method.startswith("_") and inspect.isfunction(function):
                        yield f"{found.name}.{name}.{method}", function, inspect.getdoc(one) or ""


def test_functions_of_models_name_their_quantities_and_shapes() -> None:
    """Every number and array that goes in is named, and arrays have shapes. An effect's own parameters are numbers
    whose unit and meaning stand in its `Parameter`s."""
    wrong, seen = [], 0
    for where, function, around in quantities():
        text = f"{inspect.getdoc(function) or ''}\n{around}"
        kinds = {n: str(k) for n, k in function.__annotations__.items()}
        formula = where.startswith("trueflight.models.effects.") and where.endswith(".formula")
        for name, kind in kinds.items():
            array = re.search(r"ndarray|\bArray\b", kind) is not None
            if not array and kind not in ("float", "int"):
                continue
            seen += 1
            if name != "return" and not said(name, text):
                wrong.append(f"{where}: {name} is not told")
            if array and not formula and not SHAPE.search(text):
                wrong.append(f"{where}: {name} has no shape")
    assert seen > 80
    assert not wrong, "\n".join(wrong)


def test_every_effect_has_a_source_and_units() -> None:
    for name, effect in tf.effects().items():
        assert effect.citation and effect.title and effect.manoeuvre, name
        assert (inspect.getdoc(effect.formula) or "").strip(), name
        assert all(p.unit and p.meaning for p in effect.parameters), name


def test_the_page_of_the_library_tells_every_function() -> None:
    page = (Path(__file__).parents[2] / "docs" / "library.md").read_text(encoding="utf-8")
    assert not [one.__name__ for one in FUNCTIONS if f"tf.{one.__name__}" not in page]


def test_the_reference_of_the_site_names_everything_that_the_library_offers() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "library.md").read_text()
    told = re.findall(r"^\.\. auto\w+:: (\w+)$", page, flags=re.MULTILINE)
    assert sorted(told) == sorted(library.__all__)
