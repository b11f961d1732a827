"""Recordings whose signals have clocks of their own."""

import greybox
import numpy as np
import pytest
from conftest import NOMINAL

FAST = np.arange(600) / 100
SLOW = FAST[::4]


def same(values, wanted):
    """Whether arrays are the same to the bit, missing samples too."""
    return np.array_equal(np.asarray(values).view(np.uint64), np.asarray(wanted, float).view(np.uint64))


def spread(samples, every=4, rows=597):
    """Samples at every so many rows, and nothing between."""
    column = np.full(rows, np.nan)
    column[::every] = samples
    return column


def is_joined(run, x, force):
    assert same(run.t, FAST[:597])
    assert same(run["x"], x[:597])
    assert same(run["force"], spread(force))
    told = [finding.message for finding in greybox.check(run).recordings[0].findings if finding.code == "clocks"]
    assert any("`force` has its own clock (25 Hz)" in message for message in told), told


def test_tables_are_clocks():
    x, force = np.sin(3 * FAST) / 3, np.cos(2 * SLOW) / 7
    fast, slow = {"t": FAST, "x [m]": x}, {"t": SLOW, "force": force}
    for tables in ([fast, slow], (slow, fast)):
        run = greybox.Recording(tables, "run", units={"force": "N"})
        assert run.units == {"x": "m", "force": "N"}
        is_joined(run, x, force)
    assert same(greybox.Recording([fast])["x"], x)


def test_what_is_held_stays():
    slow = {"t": SLOW[:100], "on": SLOW[:100] > 1, "u": SLOW[:100]}
    fast = {"t": FAST, "x": FAST}
    assert len(greybox.Recording([fast, slow]).t) == 397
    run = greybox.Recording([fast, slow], held=["u"])
    assert len(run.t) == 600
    assert same(run["on"], np.concatenate([spread(SLOW[:100] > 1, rows=400), np.full(200, np.nan)]))
    late = greybox.Recording([fast, {"t": SLOW + 0.004, "u": SLOW}], held=["u"])
    # Each as it was, though it moves by 4 ms, and none between two of them.
    assert same(late["u"][~np.isnan(late["u"])], SLOW)


def test_frames_are_clocks(cart):
    pandas = pytest.importorskip("pandas")
    x, force = np.sin(3 * FAST) / 3, np.cos(2 * SLOW) / 7
    fast, slow = pandas.DataFrame({"x": x}, index=FAST), pandas.DataFrame({"force": force}, index=SLOW)
    for frame in (fast, slow):
        frame.index.name = "t"
    is_joined(greybox.Recording([fast, slow]), x, force)
    # Dates count from the first of all frames, whichever has it.
    start = pandas.to_datetime("2026-01-01")
    dates = [
        pandas.DataFrame({"x": x}, index=start + pandas.to_timedelta(FAST, unit="s")),
        pandas.DataFrame({"force": force[1:]}, index=start + pandas.to_timedelta(SLOW[1:], unit="s")),
    ]
    run = greybox.Recording(dates)
    assert run.t[0] == pytest.approx(0.04)
    assert same(run["x"], x[4:597])
    with pytest.raises(greybox.InputError, match="give all of them one kind"):
        greybox.Recording([dates[0], slow])


def test_a_recording_of_several_tables_is_diagnosed_as_one(cart):
    columns = cart["columns"][0]
    fast = {"t": columns["t"], "f [N]": columns["f [N]"], "x [m]": columns["x [m]"]}
    tables = [fast, {"t": columns["t"][::5], "spare": columns["t"][::5]}]
    joined = greybox.calibrate(NOMINAL, [tables])
    rows = len(columns["t"]) - 4
    plain = greybox.calibrate(NOMINAL, {name: values[:rows] for name, values in fast.items()})
    assert joined.parameters["k"].value == plain.parameters["k"].value


@pytest.mark.parametrize(
    "tables, words",
    [
        ([], "no column beside the time"),
        ([{"t": FAST, "x": FAST}, {"t": SLOW, "x": SLOW}], "already stands"),
        ([{"t": FAST, "x": FAST}, {"t": SLOW + 100, "y": SLOW}], "no instant has a value of both"),
        ([{"t": FAST, "x": FAST}, {"t": SLOW, "y": SLOW[1:]}], "149 values"),
        ([{"t": FAST, "x": FAST}, {"y": SLOW}], "no time `t`"),
    ],
)
def test_what_cannot_be_joined_is_refused(tables, words):
    with pytest.raises(greybox.InputError, match=words):
        greybox.Recording(tables)
    with pytest.raises(greybox.InputError, match="`held` names z"):
        greybox.Recording({"t": FAST, "x": FAST}, held=["z"])


def test_groups_of_an_mf4_are_joined(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    x, force = np.sin(3 * FAST) / 3, np.cos(2 * SLOW) / 7
    file = asammdf.MDF(version="4.10")
    file.append([asammdf.Signal(x, FAST, name="x", unit="m")])
    file.append([asammdf.Signal(force, SLOW, name="force", unit="N")])
    file.save(tmp_path / "run.mf4")
    with asammdf.MDF(tmp_path / "run.mf4") as log:
        signals = log.select(["x", "force"])
        groups = list(log.iter_groups(time_from_zero=False))
    tables = [{"t": s.timestamps, f"{s.name} [{s.unit}]": s.samples} for s in signals]
    run = greybox.Recording(tables, "run.mf4")
    assert run.units == {"x": "m", "force": "N"}
    is_joined(run, x, force)
    is_joined(greybox.Recording(groups, "run.mf4"), x, force)
