"""Recordings and models from what Python has."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._errors import InputError

if TYPE_CHECKING:
    import pandas

#: A recording: a file, a dict of arrays, a frame, or a :class:`Recording`.
RecordingLike = Union[str, "os.PathLike[str]", Mapping[str, Any], "pandas.DataFrame", "Recording"]
#: A model: a file, its text (more than one line), or a :class:`Model`.
ModelLike = Union[str, "os.PathLike[str]", "Model"]

#: Seconds in the units that a time may have.
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_HEADER = re.compile(r"\s*(.*?)\s*\[(.*)\]\s*")


def _header(cell: object) -> tuple[str, str | None]:
    """Name and unit of ``name [unit]``."""
    found = _HEADER.fullmatch(str(cell))
    return (found[1], found[2].strip()) if found else (str(cell).strip(), None)


def _values(values: object, what: str, called: str) -> NDArray[np.float64]:
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{called}: `{what}` does not hold numbers: {error}") from None
    if array.ndim != 1:
        raise InputError(f"{called}: `{what}` has {array.ndim} dimensions; give one value per time")
    return np.ascontiguousarray(array)


def _index(frame: Any, called: str) -> tuple[str, Any]:
    """The index of a frame as a time, under its header."""
    index = frame.index
    if index.dtype.kind == "M":
        index = index - index[0]
    if index.dtype.kind == "m":
        return "t", index.total_seconds()
    if index.name is None:
        raise InputError(f"{called}: the frame has no column `t`; give it one, or name its index `t`")
    return str(index.name), index


class Recording:
    """A recording in memory: a dict of arrays, a pandas frame, or the content of a file.

    Keys or columns are ``name`` or ``name [unit]``; ``units`` states the units of others. The time is the key ``t`` (in
    seconds, or ``t [ms]``), or the index of a frame; NaN is a missing sample. ``name`` is what reports call it.

    >>> import numpy as np, greybox
    >>> t = np.arange(100) / 50
    >>> run = greybox.Recording({"t": t, "theta": 30 * np.sin(t), "v [V]": np.cos(t)}, units={"theta": "deg"})
    >>> run
    Recording('recording', 100 rows of theta [deg], v [V])
    """

    _inner: _native.Recording

    def __init__(
        self, data: RecordingLike, name: str | None = None, *, units: Mapping[str, str] | None = None
    ) -> None:
        units = dict(units or {})
        read: _native.Recording | None = None
        if isinstance(data, Recording):
            read = data._inner
        elif isinstance(data, (str, os.PathLike)):
            read = _native.Recording.read(data)
        if read is not None:
            called = read.name if name is None else name
            time, columns = read.t, read.channels
        else:
            called = "recording" if name is None else name
            time, columns = self._columns(data, called)
        stated = []
        for channel, unit, values in columns:
            stated.append((channel, units.pop(channel, unit), values))
        if units:
            there = ", ".join(channel for channel, _, _ in stated)
            raise InputError(f"{called}: `units` names {', '.join(units)}, but the channels are {there}")
        self._inner = _native.Recording(called, time, stated)

    @staticmethod
    def _columns(
        data: Any, called: str
    ) -> tuple[NDArray[np.float64], list[tuple[str, str | None, NDArray[np.float64]]]]:
        if not hasattr(data, "items"):
            raise TypeError(f"a recording is a file, a dict of arrays or a pandas frame, not {type(data).__name__}")
        columns = [(*_header(key), values) for key, values in data.items()]
        times = [column for column in columns if column[0] == "t"]
        if not times:
            if not hasattr(data, "index"):
                there = ", ".join(name for name, _, _ in columns)
                raise InputError(f"{called}: there is no time `t` among {there}; give the times in seconds under `t`")
            key, values = _index(data, called)
            times = [(*_header(key), values)]
            columns = [*times, *columns]
        _, unit, values = times[0]
        scale = _SECONDS.get(unit or "s")
        if scale is None:
            raise InputError(f"{called}: the time is in [{unit}]; give it in s, ms or us")
        time = _values(values, "t", called)
        names = [name for name, _, _ in columns]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{called}: there are two columns `{name}`; rename or delete one of them")
        channels = [
            (name, unit, _values(values, name, called)) for name, unit, values in columns if name != times[0][0]
        ]
        if not channels:
            raise InputError(f"{called}: there is no column beside the time; add at least one channel")
        return time * scale if scale != 1.0 else time, channels

    @property
    def name(self) -> str:
        """What reports call it."""
        return self._inner.name

    @property
    def t(self) -> NDArray[np.float64]:
        """Times, s."""
        return self._inner.t

    @property
    def units(self) -> dict[str, str | None]:
        """Unit of each channel; none where none was stated."""
        return {name: unit for name, unit, _ in self._inner.channels}

    def __getitem__(self, channel: str) -> NDArray[np.float64]:
        for name, _, values in self._inner.channels:
            if name == channel:
                return values
        raise KeyError(channel)

    def __repr__(self) -> str:
        cells = (name if unit is None else f"{name} [{unit}]" for name, unit, _ in self._inner.channels)
        return f"Recording({self.name!r}, {len(self.t)} rows of {', '.join(cells)})"


class Model:
    """A model in the model language, from a file or from its text.

    >>> import greybox
    >>> model = greybox.Model('''
    ... [inputs]
    ... f = { unit = "N" }
    ... [states]
    ... x = { unit = "m" }
    ... [parameters]
    ... m = { value = 2, unit = "kg" }
    ... [equations]
    ... cart = "m*x'' = f"
    ... ''')
    >>> model.equations
    {'cart': "m*x'' = f"}
    >>> model.with_parameters(m=3).parameters["m"]["value"]
    3.0
    """

    _inner: _native.Model

    def __init__(self, source: ModelLike | _native.Model, file: str = "model.toml") -> None:
        if isinstance(source, Model):
            self._inner = source._inner
        elif isinstance(source, _native.Model):
            self._inner = source
        elif isinstance(source, str) and "\n" in source:
            self._inner = _native.Model(source, file)
        elif isinstance(source, (str, os.PathLike)):
            self._inner = _native.Model.read(source)
        else:
            raise TypeError(f"a model is a file, its text or a Model, not {type(source).__name__}")

    @property
    def name(self) -> str:
        """Its title."""
        return self._inner.name

    @property
    def file(self) -> str:
        """The file that errors and reports name."""
        return self._inner.file

    @property
    def text(self) -> str:
        """The text of its file."""
        return self._inner.text

    @property
    def inputs(self) -> list[str]:
        """Names of its inputs."""
        return self._inner.inputs

    @property
    def states(self) -> list[str]:
        """Names of its states."""
        return self._inner.states

    @property
    def equations(self) -> dict[str, str]:
        """Its equations, by name."""
        return self._inner.equations

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, unit, standard deviation and ``fixed`` of each parameter, in the units of the file."""
        return self._inner.parameters

    def with_parameters(self, **values: float) -> Model:
        """The model with other values, in the units of the file; comments are kept."""
        return Model(self._inner.with_parameters([(name, float(v)) for name, v in values.items()]))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it to a file."""
        with open(path, "w", encoding="utf-8", newline="\n") as file:
            file.write(self.text)

    def __repr__(self) -> str:
        return f"Model({self.name or self.file!r})"


def model(source: ModelLike) -> _native.Model:
    """A model as the native half takes it."""
    return Model(source)._inner


def recordings(
    data: RecordingLike | Iterable[RecordingLike] | None, role: str, units: Mapping[str, str] | None
) -> list[Any]:
    """Recordings as the native half takes them: files stay files where no units are stated."""
    if data is None:
        return []
    alone = isinstance(data, (str, os.PathLike, Mapping, Recording)) or hasattr(data, "columns")
    several = [data] if alone else list(data)  # type: ignore[arg-type]
    made: list[Any] = []
    for k, one in enumerate(several):
        if isinstance(one, (str, os.PathLike)) and not units:
            made.append(one)
        elif isinstance(one, Recording):
            made.append((Recording(one, units=units) if units else one)._inner)
        else:
            called = None if isinstance(one, (str, os.PathLike)) else f"{role} {k + 1}" if len(several) > 1 else role
            made.append(Recording(one, called, units=units)._inner)  # type: ignore[arg-type]
    return made


def renames(map: Mapping[str, str] | None) -> list[str]:
    """``map`` as the command has it."""
    return [f"{name}={channel}" for name, channel in (map or {}).items()]


def names(channels: str | Sequence[str]) -> list[str]:
    """``channels`` as the command has it."""
    return [channels] if isinstance(channels, str) else list(channels)
