"""Recordings and models from what Python has."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Union

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._errors import InputError

if TYPE_CHECKING:
    import pandas

#: Columns with one clock: a dict of arrays or a frame.
TableLike = Union[Mapping[str, Any], "pandas.DataFrame"]
#: A recording: a file, a dict of arrays, a frame, a list of such tables with a clock each, or a :class:`Recording`.
RecordingLike = Union[str, "os.PathLike[str]", TableLike, Sequence[TableLike], "Recording"]
#: A model: a file, its text (more than one line), or a :class:`Model`.
ModelLike = Union[str, "os.PathLike[str]", "Model"]

#: Seconds in the units that a time may have.
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_HEADER = re.compile(r"\s*(.*?)\s*\[(.*)\]\s*")


def _header(cell: object) -> tuple[str, str | None]:
    """Name and unit of ``name [unit]``."""
    found = _HEADER.fullmatch(str(cell))
    return (found[1], found[2].strip() or None) if found else (str(cell).strip(), None)


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


def _headers(table: Any) -> list[str]:
    """Names of the columns of a table."""
    if not hasattr(table, "items"):
        raise TypeError(f"a recording is a file, a dict of arrays or a pandas frame, not {type(table).__name__}")
    return [_header(key)[0] for key, _ in table.items()]


def _origin(tables: Sequence[Any], called: str) -> Any:
    """The first date of frames whose times are dates; ``None`` where none are."""
    indexed = [table for table in tables if "t" not in _headers(table) and hasattr(table, "index")]
    dates = [table.index for table in indexed if table.index.dtype.kind == "M"]
    if dates and len(dates) < len(tables):
        raise InputError(f"{called}: some of its tables have dates and others times in s; give all of them one kind")
    return min((index.min() for index in dates if len(index)), default=None)


def _index(frame: Any, origin: Any, called: str) -> tuple[str, Any]:
    """The index of a frame as a time, under its header; a date counts from the origin."""
    index = frame.index
    if index.dtype.kind == "M":
        index = index - origin
    if index.dtype.kind == "m":
        return "t", index.total_seconds()
    if index.name is None:
        raise InputError(f"{called}: the frame has no column `t`; give it one, or name its index `t`")
    return str(index.name), index


class _Channel(NamedTuple):
    name: str
    unit: str | None
    #: Whether each value stays until the next one.
    held: bool
    values: NDArray[np.float64]


class _Clock(NamedTuple):
    time: NDArray[np.float64]
    channels: list[_Channel]

    @staticmethod
    def of(table: Any, origin: Any, called: str) -> _Clock:
        """The times and the channels of a table."""
        headers = _headers(table)
        columns = [(*_header(key), values) for key, values in table.items()]
        times = [column for column in columns if column[0] == "t"]
        if not times:
            if not hasattr(table, "index"):
                there = ", ".join(headers)
                raise InputError(f"{called}: there is no time `t` among {there}; give the times in seconds under `t`")
            key, values = _index(table, origin, called)
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
            _Channel(name, unit, getattr(values, "dtype", None) == bool, _values(values, name, called))
            for name, unit, values in columns
            if name != times[0][0]
        ]
        if not channels:
            raise InputError(f"{called}: there is no column beside the time; add at least one channel")
        return _Clock(time * scale if scale != 1.0 else time, channels)


def _known(called: str, what: str, names: Iterable[str], clocks: Sequence[_Clock]) -> None:
    """Sees that the channels that ``what`` names are there."""
    there = [channel.name for clock in clocks for channel in clock.channels]
    unknown = [name for name in names if name not in there]
    if unknown:
        raise InputError(f"{called}: `{what}` names {', '.join(unknown)}, but the channels are {', '.join(there)}")


class Recording:
    """A recording in memory: a dict of arrays, a pandas frame, a list of these, or the content of a file.

    Keys or columns are ``name`` or ``name [unit]``; ``units`` states the units of others. The time is the key ``t`` (in
    seconds, or ``t [ms]``), or the index of a frame; NaN is a missing sample. ``name`` is what reports call it.

    >>> import numpy as np, greybox
    >>> t = np.arange(100) / 50
    >>> run = greybox.Recording({"t": t, "theta": 30 * np.sin(t), "v [V]": np.cos(t)}, units={"theta": "deg"})
    >>> run
    Recording('recording', 100 rows of theta [deg], v [V])

    The tables of a list have clocks of their own, which are joined on the grid of the one with the most samples: what has
    the same times is copied, another sample goes to the nearest instant along the line to its neighbour, and nothing is
    made up between. A channel that ``held`` names, or of truth values, keeps each value until the next one.

    >>> slow = {"t": t[::5], "on": t[::5] > 1}
    >>> run = greybox.Recording([{"t": t, "theta [rad]": np.sin(t)}, slow])
    >>> run, run["on"][:6]
    (Recording('recording', 100 rows of theta [rad], on), array([ 0., nan, nan, nan, nan,  0.]))
    """

    _inner: _native.Recording

    def __init__(
        self,
        data: RecordingLike,
        name: str | None = None,
        *,
        units: Mapping[str, str] | None = None,
        held: Sequence[str] = (),
    ) -> None:
        if isinstance(data, Recording):
            read: _native.Recording | None = data._inner
        elif isinstance(data, (str, os.PathLike)):
            read = _native.Recording.read(data)
        else:
            read = None
        if read is not None:
            called = read.name if name is None else name
            columns = [_Channel(channel, unit, False, values) for channel, unit, values in read.channels]
            clocks = [_Clock(read.t, columns)]
        else:
            called = "recording" if name is None else name
            tables: list[Any] = list(data) if isinstance(data, (list, tuple)) else [data]
            origin = _origin(tables, called)
            clocks = [_Clock.of(table, origin, called) for table in tables]
        units = dict(units or {})
        _known(called, "units", units, clocks)
        _known(called, "held", held, clocks)
        stated = [
            (
                clock.time,
                [c._replace(unit=units.get(c.name, c.unit), held=c.held or c.name in held) for c in clock.channels],
            )
            for clock in clocks
        ]
        if len(stated) == 1:
            time, channels = stated[0]
            self._inner = _native.Recording(called, time, [(c.name, c.unit, c.values) for c in channels])
        else:
            self._inner = _native.Recording.from_clocks(called, stated)

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
    """Recordings as the native half takes them: files stay files where no units are stated. A list has one recording in
    each place, which may be a list of the tables of one recording."""
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
