"""What a recording costs in a fleet: `greybox.fleet` on threads, processes, Dask and Ray of this machine.

    python dev/bench/fleet.py COUNT [--cores N]

needs the wheel (`cargo xtask python-package`) and the packages of python/requirements.txt. Diagnoses COUNT short recordings
of a cart whose friction the model leaves out, on each engine, and then once more with all of them done: the second run
has nothing to compute, and costs what the engine and the files cost. All engines must leave the same bytes. Last, the
summary of 10 000 recordings, those of the first ones under other names, of 2500 machines.
"""

import argparse
import hashlib
import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from greybox import fleet

MODEL = """
[inputs]
f = { unit = "N", hold = "zero" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 2, unit = "kg", fixed = true }
b = { value = 2, unit = "N s/m" }
k = { value = 8, unit = "N/m" }
[equations]
cart = "m*x'' + b*x' + k*x = f"
"""
ROWS, STEPS, DT = 200, 100, 0.01


def record(seed, path):
    """2 x'' + 3 x' + 8 x + 0.6 sign(x') = f, with exact sticking; noise of 0.1 mm."""
    t = DT * np.arange(ROWS)
    f = 2 * np.sin((1.3 + 0.1 * (seed % 7)) * t + 0.3 * seed) + 1.5 * np.sin(3.1 * t + seed)
    x, v, xs, h = 0.0, 0.0, [], DT / STEPS
    for force in f:
        xs.append(x)
        for _ in range(STEPS):
            drive = force - 3 * v - 8 * x
            if v == 0.0 and abs(drive) <= 0.6:
                continue
            new = v + h * (drive - 0.6 * np.sign(v if v != 0.0 else drive)) / 2
            v = 0.0 if v * new < 0.0 else new
            x += h * v
    x = np.array(xs) + 1e-4 * np.random.default_rng(seed).standard_normal(ROWS)
    rows = "\n".join(f"{a:.2f},{b!r},{c!r}" for a, b, c in zip(t.tolist(), x.tolist(), f.tolist()))
    path.write_text(f"t,x [m],f [N]\n{rows}\n")


def bytes_of(folder):
    """A hash of every file below a folder."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def summary_of_many(results, model, machines=2500, each=4):
    """Seconds and bytes of the summary of many recordings."""
    measured = json.loads((results / "summary.json").read_text())["recordings"]
    names = [f"run{k:06}.csv" for k in range(machines * each)]
    many = [{**measured[k % len(measured)], "recording": name} for k, name in enumerate(names)]
    temperatures = 20 + 5 * np.random.default_rng(1).standard_normal(len(names))
    runs = {
        "recording": names,
        "machine": [f"M{k // each:05}" for k in range(len(names))],
        "temperature [degC]": temperatures.round(1).tolist(),
    }
    statistics = fleet.Statistics(json.dumps({"recordings": many, "failed": []}))
    start = time.perf_counter()
    summary = fleet.conclude(statistics, model, runs=runs)
    took = time.perf_counter() - start
    print(f"\n{len(names)} recordings of {machines} machines: {took:.0f} s, ", end="")
    print(f"summary.json {len(summary.to_json()) / 1e6:.1f} MB, summary.html {len(summary.report_html()) / 1e6:.2f} MB")


@contextmanager
def threads(_):
    yield None


@contextmanager
def processes(cores):
    with ProcessPoolExecutor(cores, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@contextmanager
def dask(cores):
    from dask.distributed import Client, LocalCluster

    with LocalCluster(n_workers=cores, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        yield client


@contextmanager
def ray(cores):
    import ray

    ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False)
    try:
        yield ray
    finally:
        ray.shutdown()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int)
    parser.add_argument("--cores", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "cart.toml").write_text(MODEL)
        (folder / "recordings").mkdir()
        for k in range(arguments.count):
            record(k, folder / "recordings" / f"run{k:06}.csv")
        print(f"{arguments.count} recordings of {ROWS} samples, {arguments.cores} cores\n")
        print("| engine | recordings a second and a core | cost of the engine and the files, ms a recording |")
        print("|---|---|---|")
        left = set()
        for engine in (threads, processes, dask, ray):
            out = folder / engine.__name__
            took = []
            with engine(arguments.cores) as on:
                for _ in range(2):
                    start = time.perf_counter()
                    fleet.diagnose(folder / "cart.toml", folder / "recordings", on=on, out=out)
                    took.append(time.perf_counter() - start)
            left.add(bytes_of(out))
            rate = arguments.count / took[0] / arguments.cores
            print(f"| {engine.__name__} | {rate:.2f} | {1e3 * took[1] / arguments.count:.1f} |", flush=True)
        print("\nall engines left the same bytes" if len(left) == 1 else "\nTHE ENGINES LEFT DIFFERENT BYTES")
        summary_of_many(folder / "threads", folder / "cart.toml")
        return len(left) != 1


if __name__ == "__main__":
    raise SystemExit(main())
