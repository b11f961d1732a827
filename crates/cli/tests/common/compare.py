"""How far a module written by `greybox export` is from `greybox simulate`.

compare.py MODULE.py INPUT.csv SIMULATED.csv ANSWER.json  prints for each channel the largest difference over the
channel's spread, and the number of events, as JSON.
"""

import csv
import importlib.util
import json
import sys

import numpy as np

spec = importlib.util.spec_from_file_location("exported", sys.argv[1])
exported = importlib.util.module_from_spec(spec)
spec.loader.exec_module(exported)


def read(path):
    with open(path, newline="") as file:
        head, *rows = csv.reader(file)
    return {name.split(" [")[0]: np.array([float(row[i]) for row in rows]) for i, name in enumerate(head)}


recording, simulated = read(sys.argv[2]), read(sys.argv[3])
with open(sys.argv[4]) as file:
    initial = json.load(file)["initial_si"][0]
inputs = {name: recording[name] * factor for name, (_, factor) in exported.INPUTS.items()}
result = exported.simulate(recording["t"], inputs, initial)
difference = {}
for name, (_, factor) in exported.CHANNELS.items():
    wanted = simulated[name] * factor
    difference[name] = float(np.max(np.abs(result.outputs[name] - wanted)) / np.std(wanted))
print(json.dumps({"difference": difference, "events": result.events}))
