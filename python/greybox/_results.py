"""Results: what report.json has as attributes, in words, as files and as arrays."""

from __future__ import annotations

import html
import json
import os
import typing
from typing import TYPE_CHECKING, Any, Dict, List, Sequence

import numpy as np
from numpy.typing import NDArray

from ._inputs import Model
from ._records import (
    Curve,
    Equation,
    Finding,
    Fit,
    Mechanism,
    Named,
    Parameter,
    Record,
    Remainder,
    Score,
    shaped,
)

if TYPE_CHECKING:
    import pandas


def _write(path: str | os.PathLike[str], content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)


def _frame(columns: dict[str, NDArray[np.float64]], index: NDArray[np.float64]) -> pandas.DataFrame:
    try:
        import pandas
    except ImportError:
        raise ImportError("a frame needs pandas: pip install pandas; the arrays are there without it") from None
    return pandas.DataFrame(columns, index=pandas.Index(index, name="t"))


class _Result:
    """What all results have. Keys of ``report`` are attributes of the result, of the types that its class states."""

    def __init__(self, text: str, summary: str) -> None:
        self._text = text
        #: The result in plain language, as the command tells it.
        self.summary: str = summary
        hints = typing.get_type_hints(type(self))
        #: What report.json holds.
        self.report = Record({key: shaped(v, hints.get(key, Record)) for key, v in json.loads(text).items()})

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or "report" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.report, name)

    def to_json(self) -> str:
        """The text of report.json."""
        return self._text

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.summary)}</pre>"

    def __str__(self) -> str:
        return self.summary


class _Study(_Result):
    """A result that stands on recordings."""

    def __init__(self, told: tuple[str, str, str | None, str, list[dict[str, Any]]]) -> None:
        text, summary, self._html, self._model, curves = told
        super().__init__(text, summary)
        #: Every recording, held-out ones last, beside the free runs on its inputs.
        self.curves: List[Curve] = [shaped(curve, Curve) for curve in curves]

    def frame(self, recording: str | int = 0) -> pandas.DataFrame:
        """Measurements and free runs of a recording (its name, or its place in ``curves``) as a pandas frame."""
        if isinstance(recording, int):
            curve = self.curves[recording]
        else:
            named = [curve for curve in self.curves if curve.name == recording]
            if not named:
                raise KeyError(f"{recording}; there are {', '.join(curve.name for curve in self.curves)}")
            curve = named[0]
        columns = {
            f"{channel} {run}": values
            for channel, series in curve.channels.items()
            for run, values in series.items()
            if run != "unit"
        }
        return _frame(columns, curve.t)


class _Paged(_Study):
    def report_html(self, path: str | os.PathLike[str] | None = None) -> str:
        """The self-contained page with plots; written to ``path`` where one is named."""
        text = self._html or ""
        if path is not None:
            _write(path, text.encode())
        return text


class Diagnosis(_Paged):
    """What a model leaves out.

    ``verdict`` is ``consistent``, ``missing_physics`` or ``unexplained``; ``mechanisms`` are sorted by the share of
    the residual that they explain.
    """

    verdict: str
    mechanisms: List[Mechanism]
    remainder: Remainder
    parameters: Named[Parameter]
    fit: Fit
    noise_floor: Named[float]
    findings: List[Finding]

    @property
    def improved(self) -> str:
        """The text of the completed model: improved.toml."""
        return self._model

    @property
    def model(self) -> Model:
        """The completed model."""
        return Model(self._model, "improved.toml")

    def __repr__(self) -> str:
        kinds = ", ".join(mechanism.kind for mechanism in self.mechanisms)
        return f"Diagnosis({self.verdict}{': ' + kinds if kinds else ''})"


class Identification(_Paged):
    """Governing equations found from recordings alone: ``equations`` by state, each with its ``terms``."""

    equations: Named[Equation]
    order: Record
    fit: Fit
    noise_floor: Named[float]
    findings: List[Finding]

    @property
    def delay(self) -> Named[Record]:
        """The delayed feedback by the name of its state; empty where none was looked for."""
        there: Named[Record] = self.report.get("delay", Named())
        return there

    @property
    def dead_time(self) -> Named[Record]:
        """The dead times of inputs by the name of the input; empty where none was looked for."""
        there: Named[Record] = self.report.get("dead_time", Named())
        return there

    @property
    def model_text(self) -> str:
        """The text of the identified model: model.toml."""
        return self._model

    @property
    def model(self) -> Model:
        """The identified model."""
        return Model(self._model, "model.toml")

    def __repr__(self) -> str:
        return f"Identification({'; '.join(e.expression for e in self.equations.values())})"


class Calibration(_Study):
    """The same equations with refitted parameters."""

    parameters: Named[Parameter]
    fit: Fit
    noise_floor: Named[float]
    findings: List[Finding]

    @property
    def model_text(self) -> str:
        """The text of the model with the new values: model.toml."""
        return self._model

    @property
    def calibrated(self) -> Model:
        """The model with the new values (``model`` is the report's entry on the one that was given)."""
        return Model(self._model, "model.toml")

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={p.value:.4g}" for name, p in self.parameters.items())
        return f"Calibration({values})"


class Simulation(_Result):
    """A free run: an array for each measured channel, at the recording's times and in its units; NaN = not reached."""

    fit: Named[Score]
    diverged: bool

    def __init__(
        self, told: tuple[str, str, NDArray[np.float64], Sequence[tuple[str, NDArray[np.float64]]]]
    ) -> None:
        text, summary, t, columns = told
        super().__init__(text, summary)
        #: Times, s.
        self.t: NDArray[np.float64] = t
        #: Values by header: ``name`` or ``name [unit]``.
        self.columns: Dict[str, NDArray[np.float64]] = dict(columns)

    def __getitem__(self, channel: str) -> NDArray[np.float64]:
        for header, values in self.columns.items():
            if channel in (header, header.split(" [")[0]):
                return values
        raise KeyError(f"{channel}; there are {', '.join(self.columns)}")

    def frame(self) -> pandas.DataFrame:
        """The run as a pandas frame with the time as its index."""
        return _frame(self.columns, self.t)

    def __repr__(self) -> str:
        return f"Simulation({len(self.t)} rows of {', '.join(self.columns)})"


class Control(_Result):
    """A controller, its simulated closed loop, and its law as code."""

    def __init__(self, told: tuple[str, str, Sequence[tuple[str, bytes]], tuple[Any, ...]]) -> None:
        text, summary, files, (t, set_point, command, states) = told
        super().__init__(text, summary)
        #: Content of every file that the command writes, by name.
        self.files: Dict[str, bytes] = dict(files)
        #: Times of the closed loop, s.
        self.t: NDArray[np.float64] = t
        #: Its set point, SI.
        self.set_point: NDArray[np.float64] = set_point
        #: Its command, SI.
        self.command: NDArray[np.float64] = command
        #: Its states, SI.
        self.trajectories: Dict[str, NDArray[np.float64]] = dict(states)

    @property
    def law_c(self) -> str:
        """The law as C99."""
        return self.files["law.c"].decode()

    @property
    def law_rust(self) -> str:
        """The law as Rust without the standard library."""
        return self.files["law.rs"].decode()

    @property
    def observer_c(self) -> str | None:
        """The observer as C99; none where the law is given the full state."""
        content = self.files.get("observer.c")
        return None if content is None else content.decode()

    @property
    def observer_rust(self) -> str | None:
        """The observer as Rust without the standard library; none where the law is given the full state."""
        content = self.files.get("observer.rs")
        return None if content is None else content.decode()

    def report_html(self, path: str | os.PathLike[str] | None = None) -> str:
        """The self-contained page with plots; written to ``path`` where one is named."""
        content = self.files["report.html"]
        if path is not None:
            _write(path, content)
        return content.decode()

    def frame(self) -> pandas.DataFrame:
        """The closed loop as a pandas frame with the time as its index."""
        return _frame({"set_point": self.set_point, "command": self.command, **self.trajectories}, self.t)

    def __repr__(self) -> str:
        return f"Control({self.method} by {self.report.input}: {self.verdict})"


class Health(_Result):
    """Whether recordings are good enough: ``recordings``, each with its ``findings``.

    ``failures`` has the errors of those that could not be checked.
    """

    def __repr__(self) -> str:
        return f"Health({', '.join(one.file for one in self.recordings)})"
