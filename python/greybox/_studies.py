"""The commands as functions."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Union

from . import _native
from ._inputs import ModelLike, RecordingLike, model as native, names, recordings, renames
from ._results import Calibration, Control, Diagnosis, Health, Identification, Simulation

Recordings = Union[RecordingLike, Iterable[RecordingLike]]
#: Hears what is being done. An exception that it raises ends the work.
Progress = Callable[[str], object]


def diagnose(
    model: ModelLike,
    train: Recordings,
    holdout: Recordings | None = None,
    *,
    units: Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
    seed: int = 0,
    work: int | None = None,
    mechanisms: str | os.PathLike[str] | None = None,
    terms_only: bool = False,
    progress: Progress | None = None,
) -> Diagnosis:
    """Finds what physics a model leaves out: what, where, how sure, and a model that fits.

    Args:
        model: the nominal model.
        train: the recordings to choose and fit with.
        holdout: recordings that only judge the result; without any, the last fifth of each recording is held out.
        units: unit of each channel that states none, such as ``{"theta": "deg"}``.
        map: channel for a name of the model, such as ``{"theta": "sensor_3 [deg]"}``.
        channels: channels to read, and no other but those of ``map``; without any, of a file with several clocks those
            that the model and ``map`` name.
        seed: echoed into the report; the same seed and inputs give the same result.
        work: most work of the search, in billions of operations.
        mechanisms: folder of mechanisms of your own (``*.toml``), tried beside the built-in ones.
        terms_only: identify the terms that the model lacks and name none of them, as ``greybox identify --model``.
        progress: hears what is being done.

    Raises:
        InputError: the model, a recording or an argument is wrong.

    A mass that slides on a table whose friction the model leaves out:

    >>> import numpy as np, greybox
    >>> t = np.arange(1500) / 100
    >>> f = 2 * np.sin(1.3 * t) + 1.5 * np.sin(3.1 * t)
    >>> x, v, xs = 0.0, 0.0, []
    >>> for force in f:
    ...     xs.append(x)
    ...     for _ in range(20):                           # truth: 2 x'' + 3 x' + 8 x + 0.6 sign(x') = f
    ...         v += 0.0005 * (force - 3 * v - 8 * x - 0.6 * np.tanh(v / 1e-3)) / 2
    ...         x += 0.0005 * v
    >>> nominal = '''
    ... [inputs]
    ... f = { unit = "N", hold = "zero" }
    ... [states]
    ... x = { unit = "m" }
    ... [parameters]
    ... m = { value = 2, unit = "kg", fixed = true }
    ... b = { value = 2, unit = "N s/m" }
    ... k = { value = 8, unit = "N/m" }
    ... [equations]
    ... cart = "m*x'' + b*x' + k*x = f"
    ... '''
    >>> noise = 1e-4 * np.random.default_rng(1).standard_normal(len(t))
    >>> found = greybox.diagnose(nominal, {"t": t, "x [m]": xs + noise, "f [N]": f})
    >>> found.verdict
    'missing_physics'
    >>> found.mechanisms[0].family
    'friction'
    """
    return Diagnosis(
        _native.diagnose(
            native(model),
            recordings(train, "train", units),
            recordings(holdout, "holdout", units),
            renames(map),
            names(channels),
            seed,
            work,
            mechanisms,
            terms_only,
            progress,
        )
    )


def identify(
    train: Recordings,
    states: str | Sequence[str],
    inputs: str | Sequence[str] = (),
    holdout: Recordings | None = None,
    *,
    units: Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
    order: int | None = None,
    library: Sequence[str] = (),
    terms: Sequence[str] = (),
    derivatives: int | Sequence[int] = 2,
    hold: str | None = None,
    delay: str | None = None,
    gain: float | None = None,
    longest: float = 1.0,
    dead_time: str | Sequence[str] | Mapping[str, float | None] = (),
    replicates: int = 100,
    seed: int = 0,
    progress: Progress | None = None,
) -> Identification:
    """Finds the governing equations from recordings alone: which terms, their values, and how sure each is.

    Args:
        train, holdout, units, map, channels, progress: as of :func:`diagnose`.
        states: channels that are the coordinates, one equation each.
        inputs: channels that drive the machine; which of them enters which equation is found.
        order: highest order of the library; 6 for one state, 4 for several.
        library: one of ``tensor``, ``total``, ``separate``, and any of ``constant``, ``friction``, ``trigonometric``,
            ``lagrangian`` (kinetic energy and gravity of rigid bodies on joints).
        terms: candidate terms of your own, such as ``"x'*abs(x')"``.
        derivatives: order of the leading derivative, one for all states or one for each: 2 for mechanics, 1 for
            first-order systems.
        hold: what the inputs do between samples; found from the recordings where none is given.
        delay: state that is also fed back with an unknown delay, ``gain`` where its gain is known, ``longest`` (s) how
            far to look.
        dead_time: inputs with a dead time of their own to be found; by name with the longest to look for (s, ``None``: a
            typical oscillation of the states, at most a tenth of the longest recording).
        replicates: resampled data sets behind the inclusion probabilities.
        seed: of every random choice.
    """
    if isinstance(dead_time, str):
        dead_time = [dead_time]
    longest_of = dead_time if isinstance(dead_time, Mapping) else dict.fromkeys(dead_time)
    coordinates = [states] if isinstance(states, str) else list(states)
    wanted = {
        "states": coordinates,
        "inputs": [inputs] if isinstance(inputs, str) else list(inputs),
        "order": order,
        "library": [library] if isinstance(library, str) else list(library),
        "terms": [terms] if isinstance(terms, str) else list(terms),
        "derivatives": [derivatives] * len(coordinates) if isinstance(derivatives, int) else list(derivatives),
        "hold": hold,
        "delay": delay,
        "gain": gain,
        "longest": longest,
        "dead_time": list(longest_of.items()),
        "replicates": replicates,
        "seed": seed,
    }
    return Identification(
        _native.identify(
            recordings(train, "train", units),
            recordings(holdout, "holdout", units),
            renames(map),
            names(channels),
            wanted,
            progress,
        )
    )


def calibrate(
    model: ModelLike,
    train: Recordings,
    holdout: Recordings | None = None,
    *,
    units: Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
    progress: Progress | None = None,
) -> Calibration:
    """Refits the parameters of a model, its equations unchanged, with uncertainties.

    The arguments are those of :func:`diagnose`.
    """
    return Calibration(
        _native.calibrate(
            native(model),
            recordings(train, "train", units),
            recordings(holdout, "holdout", units),
            renames(map),
            names(channels),
            progress,
        )
    )


def simulate(
    model: ModelLike,
    recording: RecordingLike,
    *,
    units: Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
    progress: Progress | None = None,
) -> Simulation:
    """Simulates a model on the inputs of a recording, from the initial state estimated on its first quarter."""
    (one,) = recordings([recording], "recording", units)
    return Simulation(_native.simulate(native(model), one, renames(map), names(channels), progress))


def check(
    data: Recordings,
    model: ModelLike | None = None,
    *,
    inputs: str | Sequence[str] = (),
    units: Mapping[str, str] | None = None,
    map: Mapping[str, str] | None = None,
    channels: str | Sequence[str] = (),
) -> Health:
    """Checks the health of recordings: sampling, gaps, clipping, quantisation, outliers, excitation, delay, clocks.

    Without a model, ``inputs`` names the channels that drive the system.

    >>> import numpy as np, greybox
    >>> t = np.arange(200) / 100
    >>> health = greybox.check({"t": t, "y [m]": np.sin(9 * t)})
    >>> health.recordings[0].rows
    200
    """
    named = [inputs] if isinstance(inputs, str) else list(inputs)
    given = None if model is None else native(model)
    read = recordings(data, "recording", units)
    return Health(*_native.check(read, given, named, renames(map), names(channels)))


def control(
    model: ModelLike | Diagnosis,
    *,
    method: str = "lqr",
    input: str | None = None,
    track: str | None = None,
    to: float = 1.0,
    reference: RecordingLike | None = None,
    feed_forward: str = "dynamic",
    size: Mapping[str, float] | None = None,
    input_size: float = 1.0,
    limit: float | None = None,
    dt: float = 1e-3,
    hold: float = 2.0,
    degree: int = 4,
    bounded: bool = False,
    lambda_: float = 10.0,
    rate: float = 50.0,
    eta: float | None = None,
    ignore_time_terms: bool = False,
    compensate_friction: bool = False,
    feedback: str = "state",
    observer: str = "kalman",
    noise: Mapping[str, float] | None = None,
    resolution: Mapping[str, float] | None = None,
    disturbance: float | None = None,
    bandwidth: float | None = None,
    integral: bool = True,
    integral_at_rest: bool = False,
    delay: float = 0.0,
    report: str | os.PathLike[str] | Diagnosis | Calibration | None = None,
    members: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> Control:
    """Designs a controller, simulates its closed loop, and writes its law as code. All numbers are in SI.

    Args:
        model: the model; of a diagnosis its completed one, and then ``report`` is that diagnosis unless stated.
        method: ``lqr``, ``hjb`` (value function of ``degree``; ``bounded``) or ``smc`` (sliding mode; ``lambda_``, ``rate``,
            ``eta``).
        input: input that commands; the model's only one where it has one.
        track, to: state to bring to the set points ± ``to``.
        reference: trajectory for that state to follow instead, a recording with a channel of it; the law reads its value
            alone (``feed_forward`` is ``static``) or its first two derivatives too (``dynamic``).
        size, input_size: typical sizes of states and command, from which the weights follow.
        limit: the actuator gives ± this at most.
        bounded: hold the limits by the cost, so that the law slows down in time; without this they clip it (hjb).
        dt: sample time of the law, s.
        hold: time for each set point of the simulated square wave, s.
        ignore_time_terms: drop disturbances that depend on the time from the design.
        compensate_friction: take friction, smoothed, out of the motion (smc).
        feedback: what the law is given, ``state`` (all of it) or ``output`` (the estimate of an ``observer``).
        observer: ``kalman`` (``disturbance``: its change in one second, in units of the command) or ``eso``
            (``bandwidth``, 1/s); the law takes the disturbance that it estimates off the command, its ``integral`` action.
        integral_at_rest: the integral action is the error at rest instead, for a machine that sticks and hunts.
        noise, resolution: standard deviations and steps of the measured states' sensors.
        delay: of the simulated loop, s.
        report: how sure the model's parameters are, for the perturbed plants (``members``, ``seed``); the report has
            the worst of them, margins included.
        progress: hears what is being done.

    >>> import greybox
    >>> arm = '''
    ... [inputs]
    ... u = { unit = "N m" }
    ... [states]
    ... q = { unit = "rad" }
    ... [parameters]
    ... J = { value = 0.1, unit = "kg m^2" }
    ... b = { value = 0.2, unit = "N m s/rad" }
    ... [equations]
    ... arm = "J*q'' + b*q' = u"
    ... '''
    >>> law = greybox.control(arm, track="q", to=0.5)
    >>> len(law.gains)
    2
    >>> "control_law" in law.law_c
    True
    """
    if isinstance(model, Diagnosis):
        report = model if report is None else report
        model = model.model
    reported = None
    if isinstance(report, (Diagnosis, Calibration)):
        reported = ("report.json", report.to_json())
    elif report is not None:
        with open(report, encoding="utf-8") as file:
            reported = (os.fspath(report), file.read())
    wanted = {
        "method": method,
        "input": input,
        "track": track,
        "to": to,
        "feed_forward": feed_forward,
        "size": [(name, float(value)) for name, value in (size or {}).items()],
        "input_size": input_size,
        "limit": limit,
        "dt": dt,
        "hold": hold,
        "degree": degree,
        "bounded": bounded,
        "lambda_": lambda_,
        "rate": rate,
        "eta": eta,
        "ignore_time_terms": ignore_time_terms,
        "compensate_friction": compensate_friction,
        "feedback": feedback,
        "observer": observer,
        "noise": [(name, float(value)) for name, value in (noise or {}).items()],
        "resolution": [(name, float(value)) for name, value in (resolution or {}).items()],
        "disturbance": disturbance,
        "bandwidth": bandwidth,
        "integral": integral,
        "integral_at_rest": integral_at_rest,
        "delay": delay,
        "members": members,
        "seed": seed,
    }
    followed = None if reference is None else recordings([reference], "reference", None)[0]
    return Control(_native.control(native(model), wanted, followed, reported, progress))
