"""Reports as dicts whose keys are attributes, too."""

from __future__ import annotations

import math
import typing
from typing import Any, Dict, List, Optional, TypeVar, Union

import numpy as np
from numpy.typing import NDArray


T = TypeVar("T")


class Named(Dict[str, T]):
    """A dict whose keys are attributes, too: ``report.fit.train`` is ``report["fit"]["train"]``.

    Where a key is no name (``theta'``) or a method of dicts, it is an item only.
    """

    def __getattr__(self, name: str) -> T:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"there is no {name!r} here; there are {', '.join(self) or 'none'}") from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(key for key in self if key.isidentifier())]


class Record(Named[Any]):
    """Part of a report: each key means something of its own."""


class Estimate(Record):
    """A value with its 95 % interval; none where it is known exactly."""

    value: float
    ci95: Optional[List[float]]
    unit: str


class Alternative(Record):
    """Another explanation; ``separate`` is the recording that would tell."""

    kind: str
    confidence: float


class Location(Record):
    """Where something acts: times (s) by recording, a region of the state, a band (Hz)."""

    windows_s: Named[List[List[float]]]
    region: Named[List[Optional[float]]]


class Mechanism(Record):
    """A mechanism that is missing."""

    kind: str
    family: str
    equation: Union[str, List[str]]
    expression: str
    parameters: Named[Estimate]
    share_explained: float
    confidence: float
    alternatives: List[Alternative]
    location: Location


class Remainder(Record):
    """What is still unexplained."""

    significant: bool
    location: Location
    share_of_residual: float


class Parameter(Record):
    """A parameter before and after, in the unit of the model file."""

    nominal: float
    value: float
    ci95: Optional[List[float]]


class Score(Record):
    """RMS error of a free run, and over the RMS of the measurement about its mean."""

    nrmse: float


class FitSet(Record):
    """Scores by channel of the model as given, refitted, and with what was found."""

    nominal: Named[Score]
    calibrated: Named[Score]
    improved: Named[Score]


class Fit(Record):
    """Scores on the recordings that were learnt from, and on those held out."""

    train: FitSet
    holdout: FitSet


class Finding(Record):
    """What to know about the recordings."""

    severity: str
    code: str
    message: str


class Term(Record):
    """A term of an identified equation: sum of value × term = input."""

    expression: str
    value: float
    ci95: Optional[List[float]]


class Equation(Record):
    """An identified equation; ``input`` is what its terms add up to, none where nothing drives it."""

    input: Optional[str]
    expression: str
    terms: List[Term]


class Channel(Record):
    """A measured channel beside the free runs: an array for each model that there is."""

    unit: str
    measured: NDArray[np.float64]


class Curve(Record):
    """A recording beside the free runs on its inputs; NaN separates its pieces."""

    name: str
    role: str
    t: NDArray[np.float64]
    channels: Named[Channel]
    inputs: Named[Record]


def shaped(value: Any, kind: Any = Record) -> Any:
    """The value with records in place of dicts, of the class that the annotations of its place name.

    A number that is not finite, which JSON cannot say, is NaN.
    """
    if value is None and kind is float:
        return math.nan
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(value, list):
        inner = arguments[0] if origin is list else Record
        return [shaped(v, inner) for v in value]
    if not isinstance(value, dict):
        return value
    if origin in (dict, Named):
        return Named({k: shaped(v, arguments[-1]) for k, v in value.items()})
    made = kind if isinstance(kind, type) and issubclass(kind, Record) else Record
    hints = typing.get_type_hints(made)
    return made({k: shaped(v, hints.get(k, Record)) for k, v in value.items()})
