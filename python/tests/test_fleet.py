"""A fleet on real engines leaves what the folder command leaves, to the byte, also when workers are killed.

``$GREYBOX_FLEET`` says how many recordings the fleet has; 6 where it does not.
"""

import json
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import greybox
import pytest
from conftest import NOMINAL, run, write_csv
from greybox import fleet

SIZE = int(os.environ.get("GREYBOX_FLEET", "6"))
ROWS = 200


class Recordings:
    """A folder of recordings, one of them bad, and what the command makes of it."""

    def __init__(self, folder, command):
        self.folder = folder
        (folder / "cart.toml").write_text(NOMINAL)
        self.model = str(folder / "cart.toml")
        self.place = str(folder / "recordings")
        Path(self.place).mkdir()
        for k in range(SIZE):
            write_csv(Path(self.place) / f"run{k:03}.csv", run(k, ROWS))
        (Path(self.place) / "bad.csv").write_text("t,x [m],f [N]\n0,1,2\n0.01,oops,3\n")
        self.told = command("diagnose", self.model, self.place, "--out", folder / "command").stdout

    def same(self, out):
        """Every file that the command wrote is there, with its bytes, and no other."""
        first, second = (files(folder) for folder in (self.folder / "command", Path(out)))
        assert first.keys() == second.keys()
        assert [name for name in first if first[name] != second[name]] == []


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, command):
    return Recordings(tmp_path_factory.mktemp("fleet"), command)


class Killer:
    """Hears of the recordings that are done, and kills a process after the first good one."""

    def __init__(self, kill):
        self.kill, self.heard, self.done = kill, [], False

    def __call__(self, text):
        self.heard.append(text)
        if not self.done and ": done" in text:
            self.done = True
            self.kill()


def test_threads_leave_what_the_command_leaves_and_resume(recordings, tmp_path):
    heard = []
    summary = fleet.diagnose(recordings.model, recordings.place, out=tmp_path, progress=heard.append)
    recordings.same(tmp_path)
    assert len(heard) == SIZE + 1 and heard[-1].endswith(f"({SIZE + 1} of {SIZE + 1})")
    assert recordings.told.startswith(summary.summary)
    assert summary.done_before == 0
    assert summary.to_json() == (tmp_path / "summary.json").read_text()
    assert summary.report_html() == (tmp_path / "summary.html").read_text()
    assert [one.recording for one in summary.failed] == ["bad.csv"]
    # A changed result is no result: only that recording is diagnosed again.
    (tmp_path / "run001" / "report.json").write_text("{}")
    again = fleet.diagnose(recordings.model, recordings.place, out=tmp_path)
    assert again.done_before == SIZE - 1
    recordings.same(tmp_path)
    # What the command left counts too, and the other way round.
    taken = fleet.diagnose(recordings.model, recordings.place, out=recordings.folder / "command")
    assert taken.done_before == SIZE


def test_a_dask_cluster_that_loses_a_worker_leaves_what_the_command_leaves(recordings, tmp_path):
    distributed = pytest.importorskip("dask.distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    started = [subprocess.Popen([*dask, "scheduler", "--host", f"tcp://{address}", "--no-dashboard"], **quiet)]
    try:
        for _ in range(2):
            worker = ["worker", f"tcp://{address}", "--nthreads", "1", "--no-nanny", "--no-dashboard"]
            started.append(subprocess.Popen([*dask, *worker], **quiet))
        with distributed.Client(f"tcp://{address}", timeout="60s") as client:
            client.wait_for_workers(2, timeout=60)
            killer = Killer(started[1].kill)
            fleet.diagnose(recordings.model, recordings.place, on=client, out=tmp_path / "out", progress=killer)
            assert started[1].wait(60) == -signal.SIGKILL
            assert len(client.scheduler_info()["workers"]) == 1
    finally:
        for process in started:
            process.kill()
            process.wait()
    recordings.same(tmp_path / "out")


def test_a_ray_that_loses_a_worker_leaves_what_the_command_leaves(recordings, tmp_path):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)

    @ray.remote(num_cpus=0, max_retries=0)
    def kill_a_diagnosis():
        import psutil

        names = ("ray::work",)
        busy = [p for p in psutil.process_iter(["cmdline"]) if " ".join(p.info["cmdline"] or []).startswith(names)]
        for process in busy[:1]:
            process.kill()
        return len(busy)

    try:
        killed = []
        killer = Killer(lambda: killed.append(ray.get(kill_a_diagnosis.remote())))
        fleet.diagnose(recordings.model, recordings.place, on=ray, out=tmp_path / "out", progress=killer)
        assert killed[0] > 0
    finally:
        ray.shutdown()
    recordings.same(tmp_path / "out")


def test_lost_processes_lose_nothing_that_was_finished(recordings, tmp_path):
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        killer = Killer(lambda: next(iter(pool._processes.values())).kill())
        with pytest.raises(greybox.InternalError, match=f"lost its workers after [0-9]+ of {SIZE + 1} recordings"):
            fleet.diagnose(recordings.model, recordings.place, on=pool, out=tmp_path, progress=killer)
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        summary = fleet.diagnose(recordings.model, recordings.place, on=pool, out=tmp_path)
    assert summary.done_before >= 1
    recordings.same(tmp_path)


def test_urls_are_read_and_written(recordings, tmp_path):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for name in ("run000.csv", "run001.csv"):
        memory.pipe_file(f"/lab/runs/{name}", (Path(recordings.place) / name).read_bytes())
    given = {"out": "memory://lab/results"}
    first = fleet.diagnose(recordings.model, "memory://lab/runs", **given)
    for name in ("report.json", "report.html", "improved.toml", "done.json"):
        there = memory.cat_file(f"/lab/results/run001/{name}")
        assert there == (recordings.folder / "command" / "run001" / name).read_bytes()
    assert memory.cat_file("/lab/results/summary.json").decode() == first.to_json()
    again = fleet.diagnose(recordings.model, ["memory://lab/runs/run000.csv", "memory://lab/runs/run001.csv"], **given)
    assert (again.done_before, again.to_json()) == (2, first.to_json())
    assert fleet.diagnose(recordings.model, "memory://lab/*/*.csv", **given).done_before == 2
    with pytest.raises(greybox.InputError, match="memory://lab/gone.csv: no such file"):
        fleet.diagnose(recordings.model, "memory://lab/gone.csv")


def test_partitions_of_a_dataset_are_recordings(recordings, tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    frames = [pandas.DataFrame(run(k, ROWS)).assign(run=k) for k in range(2)]
    for frame in frames:
        # As an engine writes it: a partition in several files, rows in any order, a column of text.
        shuffled = frame.assign(note="as found").sample(frac=1, random_state=1)
        shuffled.iloc[:90].to_parquet(tmp_path / "set", partition_cols=["run"])
        shuffled.iloc[90:].to_parquet(tmp_path / "set", partition_cols=["run"])
    summary = fleet.diagnose(recordings.model, tmp_path / "set", out=tmp_path / "out")
    assert [one.recording for one in summary.recordings] == ["run=0", "run=1"]
    for k in range(2):
        report = json.loads((tmp_path / "out" / f"run={k}" / "report.json").read_text())
        wanted = json.loads((recordings.folder / "command" / f"run{k:03}" / "report.json").read_text())
        assert report["parameters"] == wanted["parameters"]
        found, expected = ([(m["kind"], m["parameters"]) for m in one["mechanisms"]] for one in (report, wanted))
        assert found == expected


def test_episodes_of_a_file_are_recordings(recordings, tmp_path):
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    pytest.importorskip("fsspec")
    frames = [pandas.DataFrame(run(k, ROWS)).assign(episode_index=k) for k in range(3)]
    # As they lie: the rows of two episodes mixed, those of each in the order of time.
    mixed = pandas.concat(frames[:2]).sort_index(kind="stable")
    (tmp_path / "set").mkdir()
    pandas.concat([mixed, frames[2], frames[0].tail(3).assign(episode_index=7)]).to_parquet(tmp_path / "set/data.parquet")
    frames[0].drop(columns="episode_index").to_parquet(tmp_path / "set/one.parquet")
    summary = fleet.diagnose(recordings.model, tmp_path / "set", out=tmp_path / "out")
    assert [one.recording for one in summary.recordings] == [*(f"data.parquet#{k}" for k in range(3)), "one.parquet"]
    assert [one.recording for one in summary.failed] == ["data.parquet#7"]
    assert "at least 8 are needed" in summary.failed[0].message
    folders = [*(f"data.parquet.{k}" for k in range(3)), "one"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.is_dir()) == folders
    for k in range(3):
        report = json.loads((tmp_path / "out" / f"data.parquet.{k}" / "report.json").read_text())
        wanted = json.loads((recordings.folder / "command" / f"run{k:03}" / "report.json").read_text())
        assert report["parameters"] == wanted["parameters"]
        found, expected = ([(m["kind"], m["parameters"]) for m in one["mechanisms"]] for one in (report, wanted))
        assert found == expected
    assert fleet.diagnose(recordings.model, tmp_path / "set", out=tmp_path / "out").done_before == 4
    # By URL, and one by its name.
    assert len(fleet.diagnose(recordings.model, f"file://{tmp_path}/set").recordings) == 4
    one = fleet.diagnose(recordings.model, f"file://{tmp_path}/set/data.parquet#2")
    assert [run.recording for run in one.recordings] == ["data.parquet#2"]
    with pytest.raises(greybox.InputError, match="data.parquet#9: the file has no episode 9"):
        fleet.diagnose(recordings.model, tmp_path / "set/data.parquet#9")


def test_map_reduce_and_conclude_give_the_command_s_summary(recordings):
    bag = pytest.importorskip("dask.bag")
    folder = recordings.folder / "command"
    good = sorted(path.parent.name for path in folder.glob("*/report.json"))

    def one(name):
        return fleet.map(f"{name}.csv", (folder / name / "report.json").read_text(), f"{name}/report.html")

    def join(first, second):
        return fleet.reduce([first, second])

    parts = bag.from_sequence(good, npartitions=3).map(one).fold(join).compute(scheduler="threads")
    summary = json.loads((folder / "summary.json").read_text())
    bad = greybox.InputError("", {"message": summary["failed"][0]["message"], "help": summary["failed"][0].get("help")})
    joined = fleet.reduce([fleet.failed("bad.csv", bad), parts, parts])
    told = fleet.conclude(joined, recordings.model)
    assert told.to_json() == (folder / "summary.json").read_text()
    assert told.report_html() == (folder / "summary.html").read_text()
    assert fleet.Statistics(joined.to_json()) == joined


def test_a_table_says_which_machine_a_recording_is_of(recordings, command, tmp_path):
    names = [f"run{k:03}.csv" for k in range(SIZE)] + ["bad.csv"]
    columns = {
        "recording": names,
        "machine": [f"M{k // 2}" for k in range(len(names))],
        "date": [f"2026-01-{k % 28 + 1:02}" for k in range(len(names))],
        "temperature [degC]": [20.0 + k % 5 for k in range(len(names) - 1)] + [None],
    }
    text = [",".join(columns)] + [",".join("" if v is None else str(v) for v in row) for row in zip(*columns.values())]
    (tmp_path / "runs.csv").write_text("\n".join(text) + "\n")
    out = tmp_path / "out"
    shutil.copytree(recordings.folder / "command", out)
    told = command("diagnose", recordings.model, recordings.place, "--out", out, "--runs", tmp_path / "runs.csv").stdout
    assert "machines (" in told
    wanted = (out / "summary.json").read_text()
    given = [columns, tmp_path / "runs.csv"]
    if (pandas := pytest.importorskip("pandas")) is not None:
        frame = pandas.DataFrame(columns)
        given.append(frame.assign(date=pandas.to_datetime(frame["date"]).dt.date))
    for runs in given:
        summary = fleet.diagnose(recordings.model, recordings.place, out=out, runs=runs)
        assert summary.to_json() == wanted
    assert summary.recordings[0].run.machine == "M0"
    part = json.loads(wanted)
    plain = fleet.Statistics(json.dumps({key: part[key] for key in ("recordings", "failed")}))
    assert fleet.conclude(plain, recordings.model, runs=columns).to_json() == wanted
    with pytest.raises(greybox.InputError, match="runs: there is no row for the recording `run001.csv`"):
        fleet.diagnose(recordings.model, recordings.place, runs={"recording": ["run000.csv", "bad.csv"]})
    with pytest.raises(greybox.InputError, match="its columns have 1 and 2 rows"):
        fleet.conclude(plain, recordings.model, runs={"recording": ["a", "b"], "machine": ["A"]})
    with pytest.raises(greybox.InputError, match="no such file"):
        fleet.conclude(plain, recordings.model, runs=tmp_path / "gone.csv")


def test_machines_in_folders_of_their_own_are_told_apart(recordings, tmp_path):
    for machine in ("one", "two"):
        (tmp_path / machine).mkdir()
        shutil.copy(Path(recordings.place) / "run000.csv", tmp_path / machine / "run.csv")
    summary = fleet.diagnose(recordings.model, tmp_path / "*" / "run.csv", out=tmp_path / "out")
    assert [one.recording for one in summary.recordings] == ["one/run.csv", "two/run.csv"]
    assert (tmp_path / "out" / "two" / "run" / "done.json").exists()


def test_what_all_share_is_checked_first(recordings, tmp_path):
    calls = []
    given = {"progress": calls.append}
    with pytest.raises(greybox.InputError, match="there is no recording"):
        fleet.diagnose(recordings.model, tmp_path, **given)
    with pytest.raises(greybox.InputError, match="oops"):
        held = Path(recordings.place) / "bad.csv"
        fleet.diagnose(recordings.model, recordings.place, holdout=held, **given)
    with pytest.raises(greybox.InputError, match="every recording is held out"):
        one = Path(recordings.place) / "run000.csv"
        fleet.diagnose(recordings.model, one, holdout=one, **given)
    with pytest.raises(TypeError, match="`on` is a Dask client"):
        fleet.diagnose(recordings.model, recordings.place, on="localhost", **given)
    with pytest.raises(greybox.InputError, match="`threads` is 0"):
        fleet.diagnose(recordings.model, recordings.place, threads=0, **given)
    with pytest.raises(greybox.InputError, match="these are no statistics"):
        fleet.reduce([fleet.Statistics("{")])
    assert calls == []
    with pytest.raises(greybox.InputError, match="no recording could be diagnosed:\n.*oops"):
        fleet.diagnose(recordings.model, Path(recordings.place) / "bad.csv")
    summary = fleet.diagnose(recordings.model, [Path(recordings.place) / f"run00{k}.csv" for k in (0, 1)],
                             holdout=Path(recordings.place) / "run001.csv")
    assert [one.recording for one in summary.recordings] == ["run000.csv"]


def test_what_is_held_out_is_read_anew_where_it_has_changed(recordings, tmp_path):
    held, one = tmp_path / "held.csv", Path(recordings.place) / "run000.csv"
    shutil.copy(Path(recordings.place) / "run001.csv", held)
    given = {"holdout": held, "out": tmp_path / "out"}
    first = fleet.diagnose(recordings.model, one, **given)
    assert fleet.diagnose(recordings.model, one, **given).done_before == 1
    shutil.copy(Path(recordings.place) / "run002.csv", held)
    second = fleet.diagnose(recordings.model, one, **given)
    assert second.done_before == 0
    assert second.to_json() != first.to_json()
