"""What only the package does: arrays in, objects out."""

import collections
import doctest
import importlib
import os
import signal
import subprocess
import sys
import threading
import time

import greybox
import numpy as np
import pytest
from conftest import FRICTION, NOMINAL, run


@pytest.fixture(scope="session")
def found(cart):
    return greybox.diagnose(NOMINAL, cart["columns"][0], cart["columns"][1])


def test_the_friction_is_named_and_sized(found):
    assert found.verdict == "missing_physics"
    first = found.mechanisms[0]
    assert isinstance(first, greybox.Mechanism)
    assert first.kind == "coulomb_friction"
    level = next(iter(first.parameters.values()))
    assert isinstance(level, greybox.Estimate)
    assert abs(level.value - FRICTION) < 0.05
    assert found.fit.holdout.improved.x.nrmse < 0.2 * found.fit.holdout.calibrated["x"].nrmse
    assert found.summary.startswith(found.report["summary"][0])


def test_the_improved_model_simulates_what_was_measured(found, cart):
    assert found.improved == found.model.text
    simulated = greybox.simulate(found.model, cart["columns"][1])
    error = np.sqrt(np.mean((simulated["x"] - cart["columns"][1]["x [m]"]) ** 2))
    assert error < 1e-3


def test_curves_are_arrays_of_every_recording(found, cart):
    assert [(curve.name, curve.role) for curve in found.curves] == [("train", "train"), ("holdout", "holdout")]
    curve = found.curves[0]
    assert isinstance(curve.channels["x"].improved, np.ndarray)
    assert np.array_equal(curve.channels["x"].measured, cart["columns"][0]["x [m]"])
    assert np.array_equal(curve.inputs["f"]["values"], cart["columns"][0]["f [N]"])
    assert curve.t.shape == curve.channels["x"].nominal.shape


def test_results_show_themselves(found, tmp_path):
    page = found.report_html(tmp_path / "page.html")
    assert page == (tmp_path / "page.html").read_text()
    assert "<html" in page
    assert "missing_physics" in repr(found)
    assert found._repr_html_().startswith("<pre>")
    with pytest.raises(AttributeError, match="verdict"):
        found.verdicts


def test_units_are_stated_beside_the_names_or_in_them(cart):
    columns = cart["columns"][0]
    millimetres = {"t": columns["t"], "x": 1e3 * columns["x [m]"], "f": columns["f [N]"]}
    stated = greybox.calibrate(NOMINAL, millimetres, units={"x": "mm", "f": "N"})
    plain = greybox.calibrate(NOMINAL, columns)
    assert stated.parameters["k"].value == pytest.approx(plain.parameters["k"].value, rel=1e-6)
    with pytest.raises(greybox.InputError, match="`units` names y"):
        greybox.calibrate(NOMINAL, columns, units={"y": "m"})


def test_channels_are_renamed(cart):
    columns = cart["columns"][0]
    renamed = {"t": columns["t"], "encoder": columns["x [m]"], "f [N]": columns["f [N]"]}
    simulated = greybox.simulate(NOMINAL, renamed, map={"x": "encoder [m]"})
    assert np.array_equal(simulated["x"], greybox.simulate(NOMINAL, columns)["x"])


def test_times_may_be_in_milliseconds(cart):
    columns = dict(cart["columns"][0])
    scaled = {"t [ms]": 1e3 * columns.pop("t"), **columns}
    assert np.allclose(greybox.Recording(scaled).t, cart["columns"][0]["t"], rtol=1e-12)


def test_frames_are_recordings(cart):
    pandas = pytest.importorskip("pandas")
    columns = cart["columns"][0]
    frame = pandas.DataFrame(columns)
    indexed = frame.set_index("t")
    clock = indexed.set_index(pandas.to_datetime("2026-01-01") + pandas.to_timedelta(columns["t"], unit="s"))
    expected = greybox.simulate(NOMINAL, columns)
    for given in (frame, indexed, clock):
        simulated = greybox.simulate(NOMINAL, given)
        assert np.allclose(simulated["x"], expected["x"], rtol=0, atol=1e-9)
    assert list(expected.frame().columns) == ["x [m]"]
    assert expected.frame().index.name == "t"
    with pytest.raises(greybox.InputError, match="no column `t`"):
        greybox.Recording(frame.drop(columns="t"))


def test_pandas_is_not_needed(cart, tmp_path):
    (tmp_path / "pandas.py").write_text("raise ImportError('there is no pandas')\n")
    script = "import greybox, numpy as np; t = np.arange(50) / 50\nprint(greybox.check({'t': t, 'y': t * t}))"
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "recording" in done.stdout


@pytest.mark.parametrize(
    "data, words",
    [
        ({"x": [1.0] * 20}, "no time `t`"),
        ({"t": np.arange(20.0)}, "no column beside the time"),
        ({"t": np.arange(20.0), "x": ["a"] * 20}, "does not hold numbers"),
        ({"t": np.arange(20.0), "x": np.zeros((20, 2))}, "2 dimensions"),
        ({"t": np.arange(20.0), "x": np.zeros(19)}, "19 values"),
        ({"t [h]": np.arange(20.0), "x": np.zeros(20)}, r"\[h\]"),
        ({"t": np.arange(20.0), "x": np.zeros(20), "x [m]": np.zeros(20)}, "two columns `x`"),
        ({"t": np.zeros(20), "x": np.zeros(20)}, "does not come after"),
    ],
)
def test_what_is_no_recording_is_refused(data, words):
    with pytest.raises(greybox.InputError, match=words):
        greybox.Recording(data)


def test_two_recordings_of_one_name_are_refused(cart):
    twins = [greybox.Recording(c, "run") for c in cart["columns"]]
    with pytest.raises(greybox.InputError, match="two recordings are called run"):
        greybox.calibrate(NOMINAL, twins)


def test_a_model_is_read_changed_and_written(tmp_path):
    model = greybox.Model(NOMINAL).with_parameters(k=9.5)
    model.save(tmp_path / "cart.toml")
    again = greybox.Model(tmp_path / "cart.toml")
    assert again.parameters["k"] == {"value": 9.5, "unit": "N/m", "std": None, "fixed": False}
    assert "# the spring" in again.text
    with pytest.raises(greybox.InputError, match="no parameter `kk`"):
        model.with_parameters(kk=1)


def test_an_error_says_where(tmp_path):
    with pytest.raises(greybox.InputError) as error:
        greybox.Model(NOMINAL.replace("b*x'", "bb*x'"))
    assert (error.value.line, error.value.help) == (11, "did you mean `b`?")
    assert "model.toml:11:" in str(error.value)


def test_stages_are_told_and_may_end_the_work(cart):
    stages = []
    greybox.calibrate(NOMINAL, cart["columns"][0], progress=stages.append)
    assert stages[0] == "calibrating the model as it is"
    assert stages[-1] == "writing the report"

    def stop(stage):
        raise RuntimeError(stage)

    with pytest.raises(RuntimeError, match="calibrating the model"):
        greybox.calibrate(NOMINAL, cart["columns"][0], progress=stop)


def test_two_threads_may_work_at_once(cart):
    results = []

    def calibrate():
        results.append(greybox.calibrate(NOMINAL, cart["columns"][0]))

    workers = [threading.Thread(target=calibrate) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [r.to_json() for r in results] == [results[0].to_json()] * 2


@pytest.mark.skipif(os.name == "nt", reason="no signals between processes")
def test_ctrl_c_is_heard_while_it_works(cart):
    """The signal comes during the first stage. `append` is no Python code, in which Python would hear it by itself."""
    stages = collections.deque()

    def interrupt():
        while not stages:
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        greybox.diagnose(NOMINAL, cart["columns"][0], progress=stages.append)
    assert "writing the report" not in stages
    # What was given up leaves the interpreter alone, and the next call works.
    assert greybox.check(cart["columns"][0]).recordings[0].rows == 1500


def test_what_was_given_up_ends():
    columns = run(1, rows=40_000)
    begun = time.process_time()
    greybox.calibrate(NOMINAL, columns)
    whole = time.process_time() - begun

    def stop(stage):
        raise RuntimeError(stage)

    with pytest.raises(RuntimeError):
        greybox.calibrate(NOMINAL, columns, progress=stop)
    given_up = before = time.process_time()
    while True:
        time.sleep(0.3)
        now = time.process_time()
        if now - before < 0.02:
            break
        before = now
    assert now - given_up < 0.5 * whole, (now - given_up, whole)


@pytest.mark.parametrize("module", ["_inputs", "_studies", "fleet"])
def test_the_examples_of_the_docstrings_run(module):
    outcome = doctest.testmod(importlib.import_module(f"greybox.{module}"))
    assert outcome.attempted > 3
    assert outcome.failed == 0


def test_types_come_with_the_package():
    folder = os.path.dirname(greybox.__file__)
    assert {"py.typed", "_native.pyi"} <= set(os.listdir(folder))
