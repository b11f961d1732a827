"""How far a model written by `greybox export --to modelica` is from `greybox simulate`.

modelica.py FOLDER CLASS HOLDS UNITS INPUT.csv SIMULATED.csv ANSWER.json

reads FOLDER/CLASS.mo with pymoca, an independent reader of Modelica, integrates its equations, and prints for each
channel the largest difference over the channel's spread as JSON. HOLDS is a JSON object: input, `zero` or `linear`,
and UNITS one: channel, size of its unit. With FOLDER and CLASS alone it only reads the model.
"""

import csv
import json
import sys

import casadi
import numpy as np
from pymoca.backends.casadi import generator
from pymoca.backends.casadi.api import transfer_model
from scipy.integrate import solve_ivp

# The name that division had in Python 2, by which pymoca 0.12 asks for it.
generator.OP_MAP["/"] = "__truediv__"

model = transfer_model(sys.argv[1], sys.argv[2], {"cache": False})
names = [state.symbol.name() for state in model.states]
if len(sys.argv) == 3:
    sys.exit(0)


def read(path):
    with open(path, newline="") as file:
        head, *rows = csv.reader(file)
    return {name.split(" [")[0]: np.array([float(row[i]) for row in rows]) for i, name in enumerate(head)}


holds, units = json.loads(sys.argv[3]), json.loads(sys.argv[4])
recording, simulated = read(sys.argv[5]), read(sys.argv[6])
with open(sys.argv[7]) as file:
    initial = json.load(file)["initial_si"][0]

# 0 = residual(t, x, ẋ, z, u), linear in the derivatives and in the other unknowns.
time, x, u = casadi.MX.sym("t"), casadi.MX.sym("x", len(names)), casadi.MX.sym("u", len(model.inputs))
unknown = casadi.MX.sym("unknown", len(names) + len(model.alg_states))
values = [parameter.value for parameter in model.parameters]
constants = [constant.value for constant in model.constants]
dx, z = unknown[: len(names)], unknown[len(names) :]
residual = model.dae_residual_function(time, x, dx, z, u, constants, values)
zero = casadi.DM.zeros(unknown.shape)
matrix, rest = (casadi.substitute(e, unknown, zero) for e in (casadi.jacobian(residual, unknown), residual))
solved = casadi.Function("solved", [time, x, u], [casadi.solve(matrix, -rest)])

step = recording["t"]
signals = [(recording[s.symbol.name()], holds[s.symbol.name()]) for s in model.inputs]


def inputs(k, t):
    share = (t - step[k]) / (step[k + 1] - step[k])
    return [v[k] if hold == "zero" else v[k] + share * (v[k + 1] - v[k]) for v, hold in signals]


def unknowns(k, t, state):
    return np.asarray(solved(t, state, inputs(k, t))).ravel()


# `theta` and `theta_dot` are the first two of the chain of `theta`.
states = [np.array([initial[name.removesuffix("_dot")][name.endswith("_dot")] for name in names])]
for k in range(len(step) - 1):
    run = solve_ivp(
        lambda t, y, k=k: unknowns(k, t, y)[: len(names)],
        (step[k], step[k + 1]),
        states[-1],
        method="LSODA",
        rtol=1e-9,
        atol=1e-12,
    )
    assert run.success, run.message
    states.append(run.y[:, -1])
outputs = [symbol.symbol.name() for symbol in model.alg_states]
found = {
    name: np.array([unknowns(min(k, len(step) - 2), step[k], s)[len(names) + i] for k, s in enumerate(states)])
    for i, name in enumerate(outputs)
}
difference = {}
for channel, unit in units.items():
    wanted = unit * simulated[channel]
    difference[channel] = float(np.max(np.abs(found["y_" + channel] - wanted)) / np.std(wanted))
print(json.dumps(difference))
