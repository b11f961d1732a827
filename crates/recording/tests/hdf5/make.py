"""Writes the HDF5 files and the MAT-files of `-v7.3` of the tests beside this script. Needs h5py, NumPy and hdf5storage:
python make.py

All hold the same experiment: t = 0.01 k, k = 0 ... 59, v = sin(3 t), theta = cos(2 t) in degrees. MAT-files are laid out as
MATLAB does: a user block of 512 bytes, arrays transposed, the class in the attribute `MATLAB_class`, texts as `uint16`,
cells and arrays of structures as references to `#refs#`. `cells.mat` and `vectors.mat` are what hdf5storage writes.
"""

import glob
import os

import h5py
import hdf5storage
import numpy as np

here = os.path.dirname(os.path.abspath(__file__))
k = np.arange(60)
t = 0.01 * k
v, theta = np.sin(3 * t), np.cos(2 * t)


def path(name):
    return os.path.join(here, name)


# hdf5storage adds to a file that there is.
for made in glob.glob(path("*.mat")):
    os.remove(made)
np.concatenate([t, v, theta]).astype("<f8").tofile(path("samples.bin"))


class Mat:
    """A MAT-file of `-v7.3`, variable by variable."""

    def __init__(self, name):
        self.name = path(name)
        self.file = h5py.File(self.name, "w", userblock_size=512)
        self.count = 0

    def marked(self, item, kind, **attributes):
        item.attrs["MATLAB_class"] = np.bytes_(kind)
        for name, value in attributes.items():
            item.attrs[name] = value
        return item

    def array(self, at, name, values, kind="double", **attributes):
        values = np.asarray(values)
        values = values.reshape(-1, 1) if values.ndim == 1 else values
        chunked = dict(chunks=(values.T.shape[0], 16), compression=3) if values.shape[0] > 16 else {}
        return self.marked(at.create_dataset(name, data=values.T, **chunked), kind, **attributes)

    def logical(self, at, name, values):
        self.array(at, name, np.asarray(values, np.uint8), "logical", MATLAB_int_decode=np.int32(1))

    def text(self, at, name, text):
        units = np.frombuffer(text.encode("utf-16-le"), np.uint16)
        self.array(at, name, units.reshape(1, -1), "char", MATLAB_int_decode=np.int32(2))

    def empty(self, at, name, kind="double"):
        self.marked(at.create_dataset(name, data=np.zeros(2, np.uint64)), kind, MATLAB_empty=np.uint8(1))

    def structure(self, at, name, *fields):
        group = self.marked(at.create_group(name), "struct")
        names = np.empty(len(fields), object)
        for n, field in enumerate(fields):
            names[n] = np.array([c.encode() for c in field], "S1")
        group.attrs.create("MATLAB_fields", names, dtype=h5py.vlen_dtype(np.dtype("S1")))
        return group

    def reference(self, write):
        """A reference to what `write` writes into `#refs#`."""
        refs = self.file.require_group("#refs#")
        name, self.count = "r%d" % self.count, self.count + 1
        write(refs, name)
        return refs[name].ref

    def references(self, at, name, writes):
        refs = np.array([[self.reference(write)] for write in writes], dtype=h5py.ref_dtype)
        return at.create_dataset(name, data=refs, dtype=h5py.ref_dtype)

    def cells(self, at, name, writes):
        return self.marked(self.references(at, name, writes), "cell")

    def close(self):
        self.file.close()
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan 05 12:00:00 2026 HDF5 schema 1.00 ."
        with open(self.name, "r+b") as file:
            file.write(head.ljust(116, b" ") + bytes(8) + b"\x00\x02IM")


def text(mat, value):
    return lambda at, name: mat.text(at, name, value)


def column(mat, values):
    return lambda at, name: mat.array(at, name, values)


mat = Mat("kinds.mat")
mat.array(mat.file, "t", t)
mat.array(mat.file, "v", v.astype(np.float32), "single")
mat.array(mat.file, "theta", theta.reshape(1, -1))
mat.array(mat.file, "count", (k - 30).astype(np.int16), "int16")
mat.logical(mat.file, "on", k % 2)
mat.array(mat.file, "gain", [[2.5]])
mat.array(mat.file, "table", np.ones((3, 4)))
mat.text(mat.file, "note", "a remark")
mat.empty(mat.file, "nothing")
mat.array(mat.file, "z", (v + 1j * theta).astype(np.complex128).view([("real", "f8"), ("imag", "f8")]))
mat.close()

mat = Mat("structure.mat")
s = mat.structure(mat.file, "s", "time", "v", "theta", "units")
mat.array(s, "time", t)
mat.array(s, "v", v)
mat.array(s, "theta", theta)
mat.text(mat.structure(s, "units", "theta"), "theta", "deg")
mat.close()

mat = Mat("matrix.mat")
mat.array(mat.file, "time", t)
mat.array(mat.file, "y", np.column_stack([v, theta]))
mat.cells(mat.file, "y_names", [text(mat, "v [V]"), text(mat, "theta [deg]")])
mat.close()

mat = Mat("simulink.mat")
logged = mat.structure(mat.file, "logged", "time", "signals", "blockName")
mat.array(logged, "time", t)
signals = mat.structure(logged, "signals", "values", "dimensions", "label")
mat.references(signals, "values", [column(mat, v), column(mat, theta)])
mat.references(signals, "dimensions", [column(mat, [[1.0]]), column(mat, [[1.0]])])
mat.references(signals, "label", [text(mat, "v"), text(mat, "<theta [deg]>")])
mat.text(logged, "blockName", "rig/Scope")
mat.close()

mat = Mat("object.mat")
mat.array(mat.file, "t", t)
ts = mat.file.create_dataset("ts", data=np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32))
mat.marked(ts, "timeseries", MATLAB_object_decode=np.int32(3))
mat.array(mat.file, "v", v)
sparse = mat.marked(mat.file.create_group("s"), "double", MATLAB_sparse=np.uint64(60))
sparse["data"], sparse["ir"], sparse["jc"] = v, np.arange(60, dtype=np.uint64), np.array([0, 60], np.uint64)
mat.marked(mat.file.create_group("f"), "function_handle", MATLAB_object_decode=np.int32(1))["x"] = v
mat.file.create_group("#subsystem#")
mat.close()

mat = Mat("loop.mat")
mat.array(mat.file, "t", t)
cell = mat.marked(mat.file.create_dataset("c", (2, 1), h5py.ref_dtype), "cell")
cell[0, 0], cell[1, 0] = cell.ref, cell.ref
mat.close()

mat = Mat("again.mat")
mat.array(mat.file, "t", t)
same = mat.reference(column(mat, v))
mat.marked(mat.file.create_dataset("c", data=np.array([[same] * 2000], h5py.ref_dtype), dtype=h5py.ref_dtype), "cell")
mat.close()

mat = Mat("empty.mat")
mat.array(mat.file, "t", t)
mat.array(mat.file, "v", v)
nothing = mat.reference(lambda at, name: mat.empty(at, name, "canonical empty"))
mat.marked(mat.file.create_dataset("c", data=np.array([[nothing] * 2000], h5py.ref_dtype), dtype=h5py.ref_dtype), "cell")
mat.close()

hdf5storage.savemat(
    path("vectors.mat"), dict(t=t, v=v, theta=theta, note="a remark"), format="7.3", oned_as="column", store_python_metadata=False
)
names = np.array(["v [V]", "theta [deg]"], dtype=object)
hdf5storage.savemat(
    path("cells.mat"),
    dict(run=dict(t=t, y=np.column_stack([v, theta]), y_names=names)),
    format="7.3",
    oned_as="row",
    store_python_metadata=False,
)

for name, options in [("plain.h5", {}), ("latest.h5", dict(libver="latest"))]:
    with h5py.File(path(name), "w", **options) as file:
        run = file.create_group("run")
        run["time"] = 1000 * t
        run["time"].attrs["units"] = "ms"
        run.create_dataset("v", data=v, chunks=(16,), compression=6, shuffle=True, fletcher32=True)
        run["v"].attrs["unit"] = np.bytes_("V")
        run.create_dataset("theta", data=theta, chunks=(7,), maxshape=(None,))
        run["theta"].attrs["units"] = "deg"
        run["y"] = np.column_stack([v, theta])
        run["y_names"] = ["a [V]", "b"]
        run["wide"] = (-k).astype(">i8")
        run["big"] = v.astype(">f4")
        run["half"] = (k / 4 - 5).astype("f2")
        run["on"] = k % 2 == 1
        run["note"] = "a remark"
        records = np.zeros(60, [("code", "i4"), ("word", "S4")])
        records["code"] = k
        run["records"] = records
        lists = run.create_dataset("lists", (60,), h5py.vlen_dtype(np.float64))
        lists[0] = [1.0, 2.0]
        file["gain"] = 2.5
        file["soft"], file["far"] = h5py.SoftLink("/run/v"), h5py.ExternalLink("other.h5", "/v")

with h5py.File(path("scales.h5"), "w") as file:
    file["elapsed"] = t
    file["elapsed"].make_scale("time")
    for name, values in [("v", v), ("theta", theta)]:
        file[name] = values
        file[name].dims[0].attach_scale(file["elapsed"])

with h5py.File(path("records.h5"), "w") as file:
    file["run"] = np.array(list(zip(t, v, theta)), [("t", "f8"), ("v", "f8"), ("theta", "f8")])

with h5py.File(path("unread.h5"), "w") as file:
    file["t"], file["v"] = t, v
    packed = file.create_dataset("packed", (60,), "f8", chunks=(60,), compression=32008, allow_unknown_filter=True)
    packed.id.write_direct_chunk((0,), v.tobytes(), filter_mask=0)
    layout = h5py.VirtualLayout(shape=(60,), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "v", shape=(60,))
    file.create_virtual_dataset("far", layout)

with h5py.File(path("square.h5"), "w") as file:
    file["t"], file["y"] = t[:8], np.arange(64.0).reshape(8, 8)

with h5py.File(path("two_clocks.h5"), "w") as file:
    for name, step in [("fast", 1), ("slow", 2)]:
        group = file.create_group(name)
        group["t"], group["v"] = step * t, v

# Two rates: every third instant of t.
with h5py.File(path("two_scales.h5"), "w") as file:
    for scale, time in [("a", t), ("b", t[::3])]:
        file[scale] = 1000 * time
        file[scale].attrs["units"] = "ms"
        file[scale].make_scale(scale)
    for name, values, scale in [("v", v, "a"), ("theta", theta[::3], "b"), ("closed", k[::3] > 30, "b")]:
        file[name] = values
        file[name].dims[0].attach_scale(file[scale])

mat = Mat("two_rasters.mat")
run = mat.structure(mat.file, "run", "X", "Y")
x = mat.structure(run, "X", "Data", "Raster")
mat.references(x, "Data", [column(mat, t), column(mat, t[::3])])
mat.references(x, "Raster", [text(mat, "fast"), text(mat, "slow")])
y = mat.structure(run, "Y", "Name", "Data", "Unit", "Raster")
mat.references(y, "Name", [text(mat, "theta"), text(mat, "v"), text(mat, "closed")])
closed = lambda at, name: mat.logical(at, name, k[::3] > 30)
mat.references(y, "Data", [column(mat, theta[::3]), column(mat, v), closed])
mat.references(y, "Unit", [text(mat, "deg"), text(mat, "V"), text(mat, "1")])
mat.references(y, "Raster", [text(mat, "slow"), text(mat, "fast"), text(mat, "slow")])
mat.close()
