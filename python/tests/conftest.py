"""A machine whose truth is known, and the command to compare with."""

import os
import shutil
import subprocess

import numpy as np
import pytest

#: A cart: the truth has Coulomb friction of 0.6 N, the nominal model none.
NOMINAL = """name = "Cart"
[inputs]
f = { unit = "N", hold = "zero" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 2, unit = "kg", fixed = true }
b = { value = 2, unit = "N s/m" }
k = { value = 8, unit = "N/m" } # the spring
[equations]
cart = "m*x'' + b*x' + k*x = f"
"""
FRICTION = 0.6


def run(seed, rows=1500):
    """Columns of one recording of the cart."""
    t = np.arange(rows) / 100
    f = 2 * np.sin((1.3 + 0.1 * seed) * t) + 1.5 * np.sin(3.1 * t + seed)
    x, v, path = 0.0, 0.0, []
    for force in f:
        path.append(x)
        for _ in range(20):
            v += 0.0005 * (force - 3 * v - 8 * x - FRICTION * np.tanh(v / 1e-3)) / 2
            x += 0.0005 * v
    noise = 1e-4 * np.random.default_rng(seed).standard_normal(rows)
    return {"t": t, "x [m]": np.array(path) + noise, "f [N]": f}


def write_csv(path, columns):
    """A recording as a file; every number as Python prints it, so that it reads back the same."""
    lines = [",".join(columns)] + [",".join(map(repr, map(float, row))) for row in zip(*columns.values())]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def cart(tmp_path_factory):
    """The cart's model and two recordings, as files and as columns."""
    folder = tmp_path_factory.mktemp("cart")
    columns = [run(1), run(2)]
    files = [write_csv(folder / f"run{k + 1}.csv", c) for k, c in enumerate(columns)]
    (folder / "cart.toml").write_text(NOMINAL)
    return {"model": folder / "cart.toml", "files": files, "columns": columns, "folder": folder}


@pytest.fixture(scope="session")
def command():
    """Runs the `greybox` command that $GREYBOX names."""
    binary = os.environ.get("GREYBOX") or shutil.which("greybox")
    if binary is None:
        pytest.skip("$GREYBOX names no greybox command to compare with")

    def call(*arguments, status=0):
        done = subprocess.run([binary, *map(str, arguments)], capture_output=True, text=True, encoding="utf-8")
        assert done.returncode == status, done.stderr
        return done

    return call
