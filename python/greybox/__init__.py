"""Finds the physics a simulation leaves out.

Give greybox a recording and the simulation you believe in: it tells you what physics is missing, where it acts, how
sure it is, and hands back a simulation that fits.

>>> import greybox
>>> found = greybox.diagnose("link.toml", "run1.csv", holdout="run2.csv")   # doctest: +SKIP
>>> found.verdict                                                           # doctest: +SKIP
'missing_physics'

A recording is a file (CSV, MAT-file), a dict of arrays, or a pandas frame; see :class:`Recording`. A model is a file,
its text, or a :class:`Model`. Every result has ``summary`` (plain language), ``report`` (what report.json holds) and
``to_json()``.
"""

from . import fleet
from ._errors import GreyboxError, InputError, InternalError
from ._inputs import Model, ModelLike, Recording, RecordingLike
from ._native import __version__
from ._records import (
    Alternative,
    Channel,
    Curve,
    Equation,
    Estimate,
    Finding,
    Fit,
    FitSet,
    Location,
    Mechanism,
    Named,
    Parameter,
    Record,
    Remainder,
    Score,
    Term,
)
from ._results import Calibration, Control, Diagnosis, Health, Identification, Simulation
from ._studies import calibrate, check, control, diagnose, identify, simulate

__all__ = [
    "Alternative",
    "Calibration",
    "Channel",
    "Control",
    "Curve",
    "Diagnosis",
    "Equation",
    "Estimate",
    "Finding",
    "Fit",
    "FitSet",
    "GreyboxError",
    "Health",
    "Identification",
    "InputError",
    "InternalError",
    "Location",
    "Mechanism",
    "Model",
    "ModelLike",
    "Named",
    "Parameter",
    "Record",
    "Recording",
    "RecordingLike",
    "Remainder",
    "Score",
    "Simulation",
    "Term",
    "__version__",
    "calibrate",
    "check",
    "control",
    "diagnose",
    "fleet",
    "identify",
    "simulate",
]
