"""The same input gives what the command gives."""

import json
import shutil
from pathlib import Path

import greybox
import numpy as np
import pytest
from conftest import write_csv


@pytest.fixture(scope="module")
def diagnosed(cart, command, tmp_path_factory):
    """What the command leaves of a diagnosis, and what it says."""
    folder = tmp_path_factory.mktemp("diagnosed")
    first, second = cart["files"]
    done = command("diagnose", cart["model"], first, "--holdout", second, "--out", folder, "--seed", "3")
    return folder, done.stdout


def test_a_diagnosis_of_files_is_the_command_s_to_the_byte(cart, diagnosed):
    folder, said = diagnosed
    found = greybox.diagnose(cart["model"], *cart["files"], seed=3)
    assert found.to_json() == (folder / "report.json").read_text()
    assert found.improved == (folder / "improved.toml").read_text()
    assert found.report_html() == (folder / "report.html").read_text()
    assert found.summary == said.split("\nWritten:")[0].rstrip("\n") + "\n"


def test_a_diagnosis_of_arrays_is_the_command_s(cart, diagnosed):
    named = [greybox.Recording(c, f.name) for c, f in zip(cart["columns"], cart["files"])]
    found = greybox.diagnose(cart["model"], *named, seed=3)
    assert found.report == json.loads((diagnosed[0] / "report.json").read_text())


def test_a_calibration_is_the_command_s(cart, command, tmp_path):
    command("calibrate", cart["model"], *cart["files"], "--out", tmp_path)
    found = greybox.calibrate(cart["model"], cart["files"])
    assert found.to_json() == (tmp_path / "report.json").read_text()
    assert found.model_text == (tmp_path / "model.toml").read_text()
    assert "# the spring" in found.model_text


def test_an_identification_is_the_command_s(cart, command, tmp_path):
    flags = ["--states", "x", "--inputs", "f", "--order", "2", "--library", "separate,friction", "--replicates", "5"]
    flags += ["--dead-time", "f=0.2"]
    command("identify", cart["files"][0], *flags, "--out", tmp_path)
    wanted = {"order": 2, "library": ["separate", "friction"], "replicates": 5, "derivatives": [2], "dead_time": {"f": 0.2}}
    found = greybox.identify(cart["files"][0], "x", "f", **wanted)
    assert found.to_json() == (tmp_path / "report.json").read_text()
    assert found.model_text == (tmp_path / "model.toml").read_text()
    assert found.dead_time["f"].longest == 0.2
    with pytest.raises(greybox.InputError, match="2 orders of leading derivatives"):
        greybox.identify(cart["files"][0], "x", "f", derivatives=[2, 1])


def test_a_simulation_is_the_command_s(cart, command, tmp_path):
    out = tmp_path / "out.csv"
    done = command("simulate", cart["model"], cart["files"][0], "--out", out, "--json")
    simulated = greybox.simulate(cart["model"], cart["columns"][0])
    table = np.genfromtxt(out, delimiter=",", skip_header=1)
    assert np.array_equal(table[:, 0], simulated.t)
    assert np.array_equal(table[:, 1], simulated["x"])
    told = json.loads(done.stdout)
    assert simulated.fit.x.nrmse == told["fit"]["x"]["nrmse"]


def test_a_controller_is_the_command_s(cart, command, tmp_path):
    flags = ["--track", "x", "--to", "0.2", "--size", "x=0.2", "--limit", "8", "--hold", "3"]
    command("control", cart["model"], *flags, "--out", tmp_path)
    law = greybox.control(cart["model"], track="x", to=0.2, size={"x": 0.2}, limit=8, hold=3)
    assert law.to_json() == (tmp_path / "report.json").read_text()
    for name, content in law.files.items():
        assert content == (tmp_path / name).read_bytes(), name


def test_an_observer_is_the_command_s(cart, command, tmp_path):
    flags = ["--track", "x", "--to", "0.2", "--size", "x=0.2", "--limit", "8", "--hold", "3"]
    more = ["--feedback", "output", "--observer", "eso", "--resolution", "x=0.001", "--delay", "0.001"]
    command("control", cart["model"], *flags, *more, "--out", tmp_path)
    law = greybox.control(
        cart["model"], track="x", to=0.2, size={"x": 0.2}, limit=8, hold=3,
        feedback="output", observer="eso", resolution={"x": 0.001}, delay=0.001,
    )
    assert law.to_json() == (tmp_path / "report.json").read_text()
    assert law.observer_c == (tmp_path / "observer.c").read_text()
    assert law.observer_rust == (tmp_path / "observer.rs").read_text()
    for alone in [{"resolution": {"x": 0.001}}, {"bandwidth": 50.0}, {"integral": False}, {"integral_at_rest": True}]:
        with pytest.raises(greybox.InputError, match="full state") as refused:
            greybox.control(cart["model"], track="x", **alone)
        assert next(iter(alone)) in str(refused.value) and "feedback" in refused.value.help


def test_integral_action_at_rest_is_the_command_s(cart, command, tmp_path):
    flags = ["--track", "x", "--to", "0.2", "--size", "x=0.2", "--limit", "8", "--hold", "3", "--feedback", "output"]
    command("control", cart["model"], *flags, "--resolution", "x=0.001", "--integral-at-rest", "--out", tmp_path)
    options = dict(track="x", to=0.2, size={"x": 0.2}, limit=8, hold=3, feedback="output", resolution={"x": 0.001})
    law = greybox.control(cart["model"], integral_at_rest=True, **options)
    assert law.to_json() == (tmp_path / "report.json").read_text()
    assert law.observer_c == (tmp_path / "observer.c").read_text()
    assert law.report["observer"]["rest"]["step"] == 0.001
    with pytest.raises(greybox.InputError, match="integral"):
        greybox.control(cart["model"], integral=False, integral_at_rest=True, **options)


def test_a_trajectory_is_the_command_s(cart, command, tmp_path):
    t = np.arange(101) / 50
    move = tmp_path / "move.csv"
    np.savetxt(move, np.c_[t, 0.1 * np.sin(t)], delimiter=",", header="t,x [m]", comments="")
    command("control", cart["model"], "--track", "x", "--size", "x=0.2", "--reference", move, "--out", tmp_path / "out")
    law = greybox.control(cart["model"], track="x", size={"x": 0.2}, reference=move)
    assert law.to_json() == (tmp_path / "out" / "report.json").read_text()
    for name, content in law.files.items():
        assert content == (tmp_path / "out" / name).read_bytes(), name
    with pytest.raises(greybox.InputError, match="feed-forward"):
        greybox.control(cart["model"], reference=move, feed_forward="none")


def test_a_check_is_the_command_s(cart, command):
    done = command("check", cart["files"][0], "--model", cart["model"], "--json")
    assert greybox.check(cart["files"][0], cart["model"]).report == json.loads(done.stdout)


MAT_FILES = Path(__file__).parents[2] / "crates" / "recording" / "tests" / "mat"


def test_mat_files_are_read_as_by_the_command(command):
    path = MAT_FILES / "structure.mat"
    done = command("check", path, "--json")
    assert greybox.check(path).report == json.loads(done.stdout)
    read = greybox.Recording(path)
    assert read.units and np.isfinite(read.t).all()


def test_a_folder_is_checked_as_by_the_command(cart, command, tmp_path):
    for file in cart["files"]:
        shutil.copy(file, tmp_path)
    done = command("check", tmp_path, "--json")
    assert greybox.check(tmp_path).report == json.loads(done.stdout)
    told = command("calibrate", cart["model"], tmp_path, "--out", tmp_path / "out", status=2).stderr
    with pytest.raises(greybox.InputError) as error:
        greybox.calibrate(cart["model"], tmp_path)
    assert told == f"error: {error.value}\n"


def test_what_a_build_leaves_out_is_told_as_by_the_command(cart, command, tmp_path):
    path = tmp_path / "run.parquet"
    path.write_bytes(b"PAR1")
    told = command("check", path, status=2).stderr
    with pytest.raises(greybox.InputError) as error:
        greybox.check(path)
    assert told == f"error: {error.value}\n"


@pytest.mark.parametrize(
    "model, change",
    [("no_such.toml", None), ("bad.toml", ("b*x'", "bb*x'")), ("unit.toml", ('"N s/m"', '"N/m"'))],
)
def test_errors_are_in_the_command_s_words(cart, command, tmp_path, model, change):
    path = tmp_path / model
    if change:
        path.write_text(cart["model"].read_text().replace(*change))
    told = command("calibrate", path, cart["files"][0], "--out", tmp_path / "out", status=2).stderr
    with pytest.raises(greybox.InputError) as error:
        greybox.calibrate(path, cart["files"][0])
    assert told == f"error: {error.value}\n"
    assert isinstance(error.value, ValueError)


def test_a_missing_channel_is_told_as_by_the_command(cart, command, tmp_path):
    columns = {("y [m]" if key == "x [m]" else key): v for key, v in cart["columns"][0].items()}
    path = write_csv(tmp_path / "run.csv", columns)
    told = command("diagnose", cart["model"], path, "--out", tmp_path / "out", status=2).stderr
    with pytest.raises(greybox.GreyboxError) as error:
        greybox.diagnose(cart["model"], greybox.Recording(columns, "run.csv"))
    assert told == f"error: {error.value}\n"
    assert error.value.channel == "x"
