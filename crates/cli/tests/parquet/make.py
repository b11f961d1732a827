"""Writes the Parquet file of the tests beside this script. Needs pandas and PyArrow: python make.py

Episodes 0, 1 and 2 are recordings of the mass on a spring of `tests/common/spring.rs`; episode 3 is too short.
"""

import os

import numpy as np
import pandas as pd

noise = np.random.default_rng(1)


def episode(number, rows):
    b, k, dt, fine = 0.8, 25.0, 0.01, 100
    x = v = 0.0
    table = []
    for row in range(rows):
        t = row * dt
        force = np.sin(2 * t + number) + np.sin(5 * t)
        table.append((round(t, 2), force, 1e3 * x + 0.2 * noise.normal(), number))
        for i in range(fine):
            at = t + i * dt / fine
            v += dt / fine * (np.sin(2 * at + number) + np.sin(5 * at) - b * v - k * x)
            x += dt / fine * v
    return pd.DataFrame(table, columns=["t", "f [N]", "x [mm]", "episode_index"])


frames = [episode(number, rows) for number, rows in enumerate([400, 450, 420, 3])]
table = pd.concat(frames).astype({"f [N]": np.float32, "x [mm]": np.float32, "episode_index": np.int16})
path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "episodes.parquet")
table.to_parquet(path, index=False, compression="zstd", row_group_size=500)
