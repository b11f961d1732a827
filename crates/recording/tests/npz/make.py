"""Writes the NumPy files of the tests beside this script. Needs NumPy: python make.py

All hold the same experiment: t = 0.01 k, k = 0 ... 59, v = sin(3 t), theta = cos(2 t) in degrees.
"""

import os

import numpy as np

here = os.path.dirname(os.path.abspath(__file__))
k = np.arange(60)
t = 0.01 * k
v, theta = np.sin(3 * t), np.cos(2 * t)


def path(name):
    return os.path.join(here, name)


np.concatenate([t, v, theta]).astype("<f8").tofile(path("samples.bin"))
np.savez(path("plain.npz"), t=t, v=v, theta=theta)
np.savez_compressed(path("packed.npz"), t=t, v=v, theta=theta, gain=2.5, note="a remark")
names = np.array(["v [V]", "theta [deg]"])
np.savez(path("matrix.npz"), time=t, y=np.column_stack([v, theta]), y_names=names)
np.savez(path("columns.npz"), time=t, y=np.asfortranarray(np.column_stack([v, theta])), y_names=names.astype("S"))
np.savez_compressed(path("first.npz"), run=np.column_stack([t, v, theta]))
np.savez(
    path("kinds.npz"),
    t=t,
    big=v.astype(">f4"),
    half=(k / 4 - 5).astype("f2"),
    wide=(-k).astype(">i8"),
    byte=k.astype("u1"),
    on=k % 2 == 1,
    z=v + 1j * theta,
    when=np.datetime64("2026-01-01", "ms") + k,
    things=np.array([None] * 60, object),
)
records = np.array(list(zip(t, v, theta, k)), [("t", "f8"), ("v", "f8"), ("theta", "f8"), ("word", "S5")])
np.save(path("records.npy"), records)
np.savez(path("records.npz"), run=records)
np.save(path("matrix.npy"), np.column_stack([t, v, theta]))
np.savez(path("no_time.npz"), v=v, theta=theta)

# Two rates: every third instant of t.
late = dict(load_theta=theta[::3], load_closed=k[::3] > 30)
np.savez_compressed(path("two_times.npz"), t_motor=t, motor_v=v, t_load=t[::3], **late)
np.savez_compressed(path("beside.npz"), t=t, v=v, t_load=t[::3], **late)
np.savez_compressed(path("unclear.npz"), t_a=t, a_v=v, t_b=t + 0.003, b_theta=theta, gap=v - theta)
