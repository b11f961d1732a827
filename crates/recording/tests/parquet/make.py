"""Writes the Parquet files with lists of the tests beside this script. Needs pandas and PyArrow: python make.py

As data sets of robot learning (LeRobot) have them: a row per sample, `observation.state` and `action` lists of one length.
"""

import os

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

here = os.path.dirname(os.path.abspath(__file__))
k = np.arange(60)
t = k / 50
state = [[np.sin(3 * a), np.cos(2 * a), float(b)] for a, b in zip(t, k)]
action = [[b / 4, None if b % 2 == 0 else 1.0] for b in k]
state[17] = action[17] = None
ragged = [[1.0] * (b % 3) for b in k]
nested = [[[1.0, 2.0]]] * 60


def path(name):
    return os.path.join(here, name)


def table(list_of):
    return pa.table({
        "observation.state": pa.array(state, list_of(pa.float32(), 3)),
        "action [N]": pa.array(action, list_of(pa.float64(), 2)),
        "timestamp": pa.array(t, pa.float32()),
        "frame_index": pa.array(k, pa.int64()),
        "episode_index": pa.array(np.zeros(60), pa.int64()),
        "ragged": pa.array(ragged, pa.list_(pa.float64())),
        "nested": pa.array(nested, pa.list_(pa.list_(pa.float64()))),
    })


lists = table(lambda element, _: pa.list_(element))
pq.write_table(lists, path("lists.parquet"), row_group_size=25)
pq.write_table(table(pa.list_), path("fixed.parquet"), data_page_version="2.0", compression="zstd")
lists.to_pandas().to_parquet(path("old_lists.parquet"), use_compliant_nested_type=False)

late = pd.DataFrame({"v": np.sin(t), "timestamp": (5000 + t).astype(np.float32)})
late.to_parquet(path("late.parquet"), index=False)

several = pd.DataFrame({
    "observation.state": [np.array([a, 2 * a], np.float32) for a in np.tile(t[:20], 3)],
    "timestamp": np.tile(t[:20], 3).astype(np.float32),
    "episode_index": np.repeat([4, 5, 6], 20),
})
several.to_parquet(path("episodes.parquet"), index=False)
several.assign(timestamp=t).to_parquet(path("one_time.parquet"), index=False)
