"""Diagnoses of many recordings, on the engine that is there: Dask, Ray, executors, or the threads of this process.

>>> from greybox import fleet
>>> summary = fleet.diagnose("cart.toml", "recordings", out="results")        # doctest: +SKIP
>>> from dask.distributed import Client
>>> summary = fleet.diagnose("cart.toml", "s3://lab/recordings", on=Client("scheduler:8786"),
...                          out="s3://lab/results")                          # doctest: +SKIP

:func:`map`, :func:`reduce` and :func:`conclude` are the same as pure functions, for an engine of your own.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any, Union

from . import _native
from ._engines import each, engine
from ._errors import GreyboxError, InputError, InternalError
from ._fleet_work import Outcome, Plan, Run, by_episode, fleet, hash_of, work as _work
from ._inputs import ModelLike, model as native, names, renames
from ._places import Folder, Options, apart, content, entries, is_folder, is_url, matching
from ._tables import RunsLike, table
from ._records import Named, Record
from ._results import Diagnosis, _Result, _write

__all__ = ["Statistics", "Summary", "conclude", "diagnose", "failed", "map", "reduce"]

#: A path or a URL.
Place = Union[str, "os.PathLike[str]"]


class Statistics:
    """What any number of recordings leave for the summary: a set of recordings with their figures. It can be pickled,
    and its text is JSON."""

    def __init__(self, text: str) -> None:
        self._text = text

    def to_json(self) -> str:
        """As text, which ``Statistics(text)`` reads."""
        return self._text

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Statistics) and self._text == other._text

    def __hash__(self) -> int:
        return hash(self._text)


class Summary(_Result):
    """What recordings of one model say together: ``verdicts``, ``mechanisms``, ``parameters``, ``holdout``,
    ``recordings``, ``failed``, as in summary.json."""

    verdicts: Named[int]
    parameters: Named[Record]

    def __init__(self, told: tuple[str, str, str], done_before: int = 0) -> None:
        text, summary, self._html = told
        super().__init__(text, summary)
        #: How many of the recordings had results from a run before.
        self.done_before = done_before

    def report_html(self, path: str | os.PathLike[str] | None = None) -> str:
        """The self-contained page: summary.html; written to ``path`` where one is named."""
        if path is not None:
            _write(path, self._html.encode())
        return self._html

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.verdicts.items() if count)
        return f"Summary({counts})"


def map(recording: str, report: Diagnosis | str, page: str | None = None) -> Statistics:
    """The statistics of one recording from its diagnosis, or from the text of its report.json.

    Args:
        recording: what the summary calls it.
        report: the diagnosis.
        page: where its report.html is, from the summary.
    """
    text = report.to_json() if isinstance(report, Diagnosis) else report
    return Statistics(_native.statistics(recording, page, text))


def failed(recording: str, error: Exception) -> Statistics:
    """The statistics of a recording that could not be diagnosed."""
    if isinstance(error, GreyboxError):
        return Statistics(_native.failed(recording, error.message, error.help))
    return Statistics(_native.failed(recording, str(error), None))


def reduce(parts: Iterable[Statistics]) -> Statistics:
    """Joins statistics: in any order and grouping, the result is the same to the byte."""
    return Statistics(_native.reduce([part.to_json() for part in parts]))


def conclude(statistics: Statistics, model: ModelLike, seed: int = 0, runs: RunsLike | None = None) -> Summary:
    """What the recordings say together; over the machines too, where ``runs`` says which each is of.

    >>> import greybox
    >>> from greybox import fleet
    >>> model = '''
    ... [states]
    ... x = { unit = "m" }
    ... [parameters]
    ... a = { value = 2, unit = "1/s" }
    ... [equations]
    ... decay = "x' + a*x = 0"
    ... '''
    >>> lost = fleet.failed("run1.csv", ValueError("the disk is gone"))
    >>> fleet.conclude(fleet.reduce([lost, lost]), model)
    Summary(1 failed)
    """
    inner = native(model)
    return Summary(_native.conclude([statistics.to_json()], table(runs), inner.name, inner.file, seed))


def diagnose(
    model: ModelLike,
    recordings: Place | Iterable[Place],
    *,
    on: Any = None,
    out: Place | None = None,
    holdout: Place | Iterable[Place] | None = None,
    runs: RunsLike | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
    seed: int = 0,
    work: int | None = None,
    mechanisms: str | os.PathLike[str] | None = None,
    threads: int = 1,
    storage_options: Options = None,
    progress: Callable[[str], object] | None = None,
) -> Summary:
    """Diagnoses every recording by itself, and says what all show together: ``greybox diagnose MODEL FOLDER`` on many
    machines. Results and summary are those of the command to the byte.

    A worker holds one recording at a time, and writes its results as soon as they are there; the same call resumes an
    interrupted run. A recording that cannot be diagnosed is listed with its error, and ends nothing.

    Args:
        model: the nominal model.
        recordings: a folder, a pattern (``"fleet/**/*.csv"``), or paths, each on a disk that all workers see, or a URL
            that fsspec reads. Folders ``key=value`` of Parquet files, as Spark, Polars and pandas partition a dataset,
            are one recording each, and so is each episode of a Parquet file, ``data.parquet#3``.
        on: a Dask client, the module ``ray``, an executor of ``concurrent.futures``, or none: the threads of this
            process.
        out: folder of the results, as of the command, or its URL; none where only the summary is wanted.
        holdout: files that judge every recording, and are not diagnosed themselves.
        runs: which machine each recording is of, when it was made and under what conditions: a CSV file, a frame or a dict of
            columns ``recording`` (its name in the summary), ``machine``, ``date``, and covariates such as
            ``temperature [degC]``.
        map, channels, seed, work, mechanisms: as of :func:`greybox.diagnose`.
        threads: how many cores the diagnosis of one recording uses.
        storage_options: arguments of the file system behind the URLs.
        progress: hears of every recording that is done.

    Raises:
        InputError: the model, an argument or what is held out is wrong, or no recording could be diagnosed.
        InternalError: the executor lost its workers for good; what was finished is kept.
    """
    if threads < 1:
        raise InputError(f"`threads` is {threads}; a diagnosis needs one at least")
    inner = native(model)
    held = _places(holdout, storage_options) if holdout is not None else []
    plan = Plan(
        model_text=inner.text,
        model_path=os.fspath(inner.path),
        holdout=tuple((place, hash_of(content(place, storage_options))) for place in held),
        map=tuple(renames(map)),
        channels=tuple(names(channels)),
        seed=seed,
        work=work,
        mechanisms=tuple(_native.mechanisms(mechanisms)) if mechanisms is not None else (),
        threads=threads,
        out=None if out is None else os.fspath(out),
        options=storage_options,
    )
    # A fault in what all share is told once.
    fleet(plan)
    told_of = table(runs)
    files = [place for place in _places(recordings, storage_options) if place not in held]
    places = [place for file in files for place in by_episode(file, storage_options) if place not in held]
    work_on = _runs(places, storage_options)
    if told_of is not None:
        _native.check_table(*told_of, [run.name for run in work_on])
    parts: list[str] = []
    failures: list[str] = []
    before = 0
    with engine(on, threads) as submit:
        for count, (run, future) in enumerate(each(submit, _work, plan, work_on), start=1):
            outcome = _outcome(run, future, count - 1, len(work_on), plan.out)
            parts.append(outcome.statistics)
            before += outcome.before
            if outcome.failure is not None:
                failures.append(outcome.failure)
            if progress is not None:
                said = "failed" if outcome.failure is not None else "done before" if outcome.before else "done"
                progress(f"{run.name}: {said} ({count} of {len(work_on)})")
    if len(failures) == len(work_on):
        reported = "".join(f"\n  {failure}" for failure in sorted(failures))
        raise InputError(f"no recording could be diagnosed:{reported}")
    told = _native.conclude(parts, told_of, inner.name, inner.file, seed)
    if plan.out is not None:
        text, _, page = told
        Folder(plan.out, storage_options).write([("summary.json", text.encode()), ("summary.html", page.encode())])
    return Summary(told, before)


def _outcome(run: Run, future: Any, finished: int, of: int, out: str | None) -> Outcome:
    """What the worker said; what the engine says where it lost the worker with this recording."""
    error = future.exception()
    if error is None:
        outcome: Outcome = future.result()
        return outcome
    if isinstance(error, BrokenExecutor):
        kept = f"; those are kept in {out}, and the same call goes on from them" if out is not None else ""
        raise InternalError(f"the executor lost its workers after {finished} of {of} recordings{kept}") from error
    if not isinstance(error, Exception):
        raise error
    message = f"{run.place}: its worker was lost: {type(error).__name__}: {error}"
    return Outcome(_native.failed(run.name, message, None), failure=message)


def _places(given: Place | Iterable[Place], options: Options) -> list[str]:
    """The recordings that paths, patterns and folders name; a partition of a dataset is one."""
    several = [given] if isinstance(given, (str, os.PathLike)) else list(given)
    found: list[str] = []
    for place in several:
        text = os.fspath(place)
        if _ending(text) in _native.EXTENSIONS and "*" not in text:
            found.append(text)
        elif any(mark in text for mark in "*?[") and not os.path.exists(text):
            found.extend(matching(text, options))
        elif is_folder(text, options):
            found.extend(_inside(text, options))
        else:
            found.append(text)
    if not found:
        endings = ", ".join(f"`*.{ending}`" for ending in _native.EXTENSIONS)
        raise InputError(f"{_named(several)}: there is no recording ({endings})")
    return list(dict.fromkeys(found))


def _named(places: list[Place]) -> str:
    return ", ".join(os.fspath(place) for place in places[:3]) or "`recordings`"


def _inside(folder: str, options: Options) -> list[str]:
    """The recordings of a folder: its files, or the partitions of a dataset."""
    if "=" in posixpath.basename(folder.rstrip("/")):
        below = [place for place in entries(folder, options) if "=" in posixpath.basename(place)]
        return [deep for place in below for deep in _inside(place, options)] if below else [folder]
    found: list[str] = []
    for place in entries(folder, options):
        name = os.path.basename(place)
        if "=" in name and is_folder(place, options):
            found.extend(_inside(place, options))
        elif _ending(name) in _native.EXTENSIONS:
            found.append(place)
    return found


def _ending(name: str) -> str:
    return os.path.splitext(name)[1].lstrip(".").lower()


def _runs(places: list[str], options: Options) -> list[Run]:
    """Each recording with its name, its path below the folder that all are in, and the folder of its results."""
    if not places:
        raise InputError("every recording is held out; leave at least one of them to learn from")
    parts = [place.rstrip("/").split("/") if is_url(place) else place.rstrip(os.sep).split(os.sep) for place in places]
    shared = os.path.commonprefix([part[:-1] for part in parts])
    runs: list[Run] = []
    taken = {"summary.json": "summary.json", "summary.html": "summary.html"}
    for place, part in zip(places, parts):
        name = "/".join(part[len(shared) :])
        _, episode = apart(place)
        partition = episode is None and _ending(name) not in _native.EXTENSIONS and is_folder(place, options)
        if episode is not None:
            # (`#` begins the fragment of a link.)
            folder = f"{name[: -len(episode) - 1]}.{episode}"
        else:
            folder = name if partition else os.path.splitext(name)[0]
        if folder in taken:
            raise InputError(
                f"{place}: its results would go where those of `{taken[folder]}` go, to `{folder}`; rename the recording"
            )
        taken[folder] = place
        runs.append(Run(place, name, folder, partition))
    return runs
