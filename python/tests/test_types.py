"""The types that the package states are the types of what is there."""

import subprocess
import sys
import typing
from pathlib import Path

import greybox
import numpy as np
import pytest
from conftest import NOMINAL

pytest.importorskip("mypy")

SCRIPT = Path(__file__).with_name("script.py")


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """Runs a module of mypy, away from the sources, and gives its status and what it says."""
    folder = tmp_path_factory.mktemp("mypy")

    def call(*arguments):
        command = [sys.executable, "-m", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", cwd=folder)
        return done.returncode, done.stdout + done.stderr

    return call


def test_the_package_holds_to_its_types(checked):
    status, said = checked("mypy", "--strict", "-p", "greybox")
    assert status == 0, said


def test_a_script_is_typed(checked):
    status, said = checked("mypy", "--strict", SCRIPT)
    assert status == 0, said


@pytest.mark.parametrize(
    "mistake, told",
    [
        ("found.verdict = 1", "Incompatible types in assignment"),
        ("greybox.diagnose('link.toml')", "Missing positional argument"),
        ("greybox.diagnose('link.toml', 'run1.csv', holdut='run2.csv')", "Unexpected keyword argument"),
        ("found.mechanisms[0].kind + 1", "Unsupported operand"),
        ("found.parameters.J.value.upper()", '"float" has no attribute "upper"'),
        ("greybox.simulate('link.toml', 3)", "incompatible type"),
        ("run['theta'] + 'deg'", "Unsupported operand|No overload variant"),
    ],
)
def test_a_mistake_is_told(checked, tmp_path, mistake, told):
    script = tmp_path / "mistaken.py"
    script.write_text(SCRIPT.read_text() + f"\n{mistake}\n")
    status, said = checked("mypy", "--strict", script)
    assert status == 1, said
    assert any(words in said for words in told.split("|")), said


def test_the_stubs_are_those_of_the_native_half(checked):
    status, said = checked("mypy.stubtest", "greybox._native")
    assert status == 0, said


def strays(value, kind, at):
    """Where a value is not what its annotation says."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind is typing.Any:
        return []
    if origin is typing.Union:
        tried = [strays(value, other, at) for other in arguments]
        return [] if [] in tried else tried[0]
    if origin is list and isinstance(value, list):
        return [s for k, one in enumerate(value) for s in strays(one, arguments[0], f"{at}[{k}]")]
    if origin is greybox.Named and isinstance(value, greybox.Named):
        return [s for key, one in value.items() for s in strays(one, arguments[0], f"{at}.{key}")]
    if isinstance(kind, type) and issubclass(kind, greybox.Record) and isinstance(value, kind):
        return of_class(value, kind, at)
    kind = origin or kind
    fits = isinstance(value, (int, float) if kind is float else kind)
    return [] if fits else [f"{at} is {type(value).__name__}, not {kind}"]


def of_class(value, kind, at):
    hints = typing.get_type_hints(kind)
    missing = [f"{at} has no {name}" for name in hints if not hasattr(value, name)]
    there = {name: hint for name, hint in hints.items() if hasattr(value, name)}
    return missing + [s for name, hint in there.items() for s in strays(getattr(value, name), hint, f"{at}.{name}")]


def test_results_are_what_their_annotations_say(cart):
    columns = cart["columns"]
    results = [
        greybox.diagnose(NOMINAL, columns[0], columns[1]),
        greybox.calibrate(NOMINAL, columns[0]),
        greybox.identify(columns[0], "x", "f", order=2, library="separate", replicates=3),
        greybox.simulate(NOMINAL, columns[0]),
    ]
    for result in results:
        name = type(result).__name__
        assert typing.get_type_hints(type(result)), name
        assert of_class(result, type(result), name) == []
        for curve in getattr(result, "curves", []):
            assert of_class(curve, greybox.Curve, name) == []
    assert strays({"a": "b"}, greybox.Estimate, "here") and strays("1", float, "here")


def test_a_number_that_is_not_finite_is_nan():
    from greybox._records import shaped

    score = shaped({"nrmse": None}, greybox.Score)
    assert np.isnan(score.nrmse)
    assert shaped({"ci95": None}, greybox.Estimate).ci95 is None
