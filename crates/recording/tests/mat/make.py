"""Writes the MAT-files of the tests beside this script. Needs NumPy and SciPy: python make.py

All hold the same experiment: t = 0.01 k, k = 0 ... 59, v = sin(3 t), theta = cos(2 t) in degrees.
"""

import os

import numpy as np
from scipy.io import savemat

here = os.path.dirname(os.path.abspath(__file__))
k = np.arange(60)
t = 0.01 * k
v, theta = np.sin(3 * t), np.cos(2 * t)


def cells(*texts):
    return np.array(texts, dtype=object)


def structure(**fields):
    """A structure in a form that SciPy writes with its fields in this order."""
    array = np.zeros((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        array[0, 0][name] = value
    return array


def structures(*elements):
    array = np.zeros((1, len(elements)), dtype=[(name, object) for name in elements[0]])
    for k, element in enumerate(elements):
        for name, value in element.items():
            array[0, k][name] = value
    return array


def save(name, compressed=True, **variables):
    savemat(os.path.join(here, name + ".mat"), variables, do_compression=compressed, oned_as="column")


column = lambda x: x.reshape(-1, 1)
save("vectors_v6", compressed=False, t=t, v=v, theta=theta, gain=2.5, note="a remark", table=np.ones((3, 4)))
save("vectors_v7", t=t.reshape(1, -1), v=v.astype(np.float32), theta=theta, count=k.astype(np.int16))
save("structure", s=structure(time=column(t), v=column(v), theta=column(theta), units=structure(theta="deg")))
save("matrix", y=np.column_stack([v, theta]), time=t, y_names=cells("v [V]", "theta [deg]"))
save("matrix_with_time", data=np.column_stack([t * 1e3, v, theta]), columns=cells("t [ms]", "v", "theta"))
save("array", ans=np.vstack([t, v, theta]))
simulink = lambda label, values: dict(values=column(values), dimensions=1.0, label=label)
save(
    "simulink",
    logged=structure(time=column(t), signals=structures(simulink("v", v), simulink("<theta [deg]>", theta)), blockName="rig/Scope"),
)
save("simulink_one", theta=structure(time=column(t), signals=structure(values=column(theta), dimensions=1.0, label="")),
     v=structure(time=column(t), signals=structure(values=column(v), dimensions=1.0, label="")))
save("nested", t=t, hub=structure(angle=column(theta)), link=structure(angle=column(v)))
save("two_clocks", fast=structure(t=column(t), v=column(v)), slow=structure(t=column(2 * t), theta=column(theta)))
save("no_time", v=v, theta=theta)

# Two rates: every third instant of t.
axis = lambda values, **fields: dict(Data=values.reshape(1, -1), **fields)
late = t[::3]


def dspace(name, **stated):
    """Two times of one length; what each signal states of them."""
    x = [axis(t[:20], Name="fast", Unit="s", Raster="fast"), axis(late, Name="slow", Unit="s", Raster="slow")]
    y = [axis(theta[::3], Name="theta", Unit="deg"), axis(v[:20], Name="v", Unit="V")]
    for field, values in stated.items():
        for signal, value in zip(y, values):
            signal[field] = value
    save(name, run=structure(X=structures(*x), Y=structures(*y), Description="rig"))


dspace("dspace_index", XIndex=(2.0, 1.0))
dspace("dspace_raster", Raster=("slow", "fast"))
dspace("dspace_unclear")
series = lambda time, data, name: structure(Name=name, Time=column(time), Data=column(data))
save("timeseries", v=series(t, v, "v"), theta=series(late, theta[::3], "theta [deg]"))
save("flat", t_motor=t, motor_v=v, on=k % 2 == 1, load_t=late, load_theta=theta[::3], load_closed=k[::3] > 30)
