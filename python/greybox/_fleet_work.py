"""The work of one recording, as a worker does it."""

from __future__ import annotations

import functools
import hashlib
import importlib
import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from . import _native
from ._errors import GreyboxError, InputError
from ._inputs import Recording
from ._places import Folder, Options, apart, content, entries, is_url, join

#: Columns that may be the time of a frame.
_TIMES = ("t", "time", "Time", "tout", "timestamp")
#: Column that numbers the episodes of a file.
_EPISODE = "episode_index"


@dataclass(frozen=True)
class Plan:
    """What is the same for all recordings."""

    model_text: str
    model_path: str
    #: Each with the hash of what was in it when the work began.
    holdout: tuple[tuple[str, str], ...]
    map: tuple[str, ...]
    channels: tuple[str, ...]
    seed: int
    work: int | None
    mechanisms: tuple[tuple[str, str], ...]
    threads: int
    out: str | None
    options: Options = field(compare=False)


@dataclass(frozen=True)
class Run:
    """A recording: where it stands, what the summary calls it, and the folder of its results."""

    place: str
    name: str
    folder: str
    #: A folder of Parquet files that hold one recording.
    partition: bool = False


@dataclass(frozen=True)
class Outcome:
    """What a worker says of a recording."""

    statistics: str
    #: It was there from a run before.
    before: bool = False
    #: It could not be diagnosed: why.
    failure: str | None = None


def hash_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@functools.lru_cache(maxsize=4)
def fleet(plan: Plan) -> _native.Fleet:
    """The plan, read: once in a process."""
    held = []
    for place, hashed in plan.holdout:
        found = content(place, plan.options)
        if hash_of(found) != hashed:
            raise InputError(f"{place}: what is held out has changed since the work began; start it again")
        held.append((place, found))
    model = _native.Model(plan.model_text, plan.model_path)
    return _native.Fleet(model, held, list(plan.map), list(plan.channels), plan.seed, plan.work, list(plan.mechanisms))


def work(plan: Plan, run: Run) -> Outcome:
    """Diagnoses a recording and writes its results, unless that was done before. What is wrong with a recording, its
    file or the place of its results is an answer, not an exception."""
    try:
        return _work(plan, run)
    except GreyboxError as error:
        message, help = error.message, error.help
    except Exception as error:
        message, help = f"{run.place}: {type(error).__name__}: {error}", None
    return Outcome(_native.failed(run.name, message, help), failure=message)


def _work(plan: Plan, run: Run) -> Outcome:
    shared = fleet(plan)
    parts = [content(place, plan.options) for place in _parts(run, plan.options)]
    whole = b"".join(parts)
    results = None if plan.out is None else Folder(join(plan.out, run.folder), plan.options)
    if results is not None:
        found = shared.finished(run.place, whole, run.name, run.folder, results.read)
        if found is not None:
            return Outcome(found, before=True)
    recording = None
    if run.partition or (_is_parquet(apart(run.place)[0]) and not _native.READS_PARQUET):
        recording = _frames(parts, run)._inner
    files, statistics = shared.diagnose(run.place, whole, run.name, run.folder, recording, plan.threads)
    if results is not None:
        results.write(files)
    return Outcome(statistics)


def _parts(run: Run, options: Options) -> list[str]:
    if not run.partition:
        return [run.place]
    return [place for place in entries(run.place, options) if place.endswith(".parquet")]


def _is_parquet(file: str) -> bool:
    return file.lower().endswith(".parquet")


def by_episode(place: str, options: Options) -> list[str]:
    """The recordings in a file: its episodes, or itself where it is one recording or cannot be read: its worker reports
    that."""
    if not _is_parquet(place):
        return [place]
    try:
        if not _native.READS_PARQUET:
            numbers = _episodes(io.BytesIO(content(place, options)) if is_url(place) else place)
        elif is_url(place):
            numbers = _native.episodes_of(content(place, options))
        else:
            numbers = _native.episodes(place)
    except Exception:
        return [place]
    return [f"{place}#{number}" for number in numbers] or [place]


def _time(columns: Iterable[object]) -> str | None:
    """The column of times."""
    names = {str(column).split(" [")[0]: str(column) for column in columns}
    return next((names[time] for time in _TIMES if time in names), None)


def _episodes(file: Any) -> list[int]:
    """The episodes of a Parquet file, as PyArrow reads their column and the times; none where it is one recording."""
    # (Without types of its own.)
    opened = importlib.import_module("pyarrow.parquet").ParquetFile(file)
    time = _time(opened.schema_arrow.names)
    if time is None or _EPISODE not in opened.schema_arrow.names:
        return []
    return _several(opened.read(columns=[_EPISODE, time]).to_pandas(), time)


def _several(frame: Any, time: str) -> list[int]:
    """The episodes of a frame, where its times do not go on from each to the next."""
    numbers = frame[_EPISODE]
    if numbers.nunique() < 2 or (frame[time].is_monotonic_increasing and frame[time].is_unique):
        return []
    whole = numbers.astype("int64")
    if not (whole == numbers).all():
        raise ValueError(f"`{_EPISODE}` holds more than whole numbers")
    return sorted(set(whole.tolist()))


def _frames(parts: list[bytes], run: Run) -> Recording:
    """The recording that Parquet files hold together, sorted by time."""
    try:
        import pandas
    except ImportError:
        raise ImportError("Parquet files need pandas and pyarrow: pip install pandas pyarrow") from None
    frame: Any = pandas.concat([pandas.read_parquet(io.BytesIO(part)) for part in parts], ignore_index=True)
    time = _time(frame.columns)
    if time is None:
        there = ", ".join(f"`{column}`" for column in frame.columns)
        raise InputError(f"{run.place}: there is no time among {there}; call the column of times, in s, `t`")
    if not run.partition:
        frame = _episode(frame, time, run)
    frame = frame.sort_values(time, kind="stable")
    if frame[time].dtype.kind == "M":
        frame[time] = (frame[time] - frame[time].iloc[0]).dt.total_seconds()
    plain = frame.select_dtypes(["number", "bool"]).rename(columns={time: time.replace(time.split(" [")[0], "t", 1)})
    # Errors name the place, as those of the command.
    return Recording(Recording(plain, run.place), run.name)


def _episode(frame: Any, time: str, run: Run) -> Any:
    """The rows of the recording of a file: those of its episode, or all of them."""
    file, episode = apart(run.place)
    if _EPISODE not in frame.columns:
        if episode is None:
            return frame
        raise InputError(
            f"{run.place}: `#{episode}` names an episode, but the file has no column of numbers `{_EPISODE}`; "
            "name the file without it"
        )
    if episode is None:
        several = _several(frame, time)
        if several:
            raise InputError(f"{file}: the file holds {len(several)} episodes; name one, `{file}#{several[0]}`")
        return frame
    rows = frame[frame[_EPISODE].map(str) == episode]
    if rows.empty:
        there = ", ".join(str(number) for number in sorted(set(frame[_EPISODE].tolist())))
        raise InputError(
            f"{run.place}: the file has no episode {episode}; name one of those in its column `{_EPISODE}`: {there}"
        )
    return rows
