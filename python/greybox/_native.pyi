from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Source = Recording | str | PathLike[str]
Progress = Callable[[str], object] | None

__version__: str

class Recording:
    def __init__(
        self, name: str, time: Floats, channels: Sequence[tuple[str, str | None, Floats]]
    ) -> None: ...
    @staticmethod
    def read(path: str | PathLike[str]) -> Recording: ...
    @property
    def name(self) -> str: ...
    @property
    def t(self) -> Floats: ...
    @property
    def channels(self) -> list[tuple[str, str | None, Floats]]: ...

class Model:
    def __init__(self, text: str, file: str) -> None: ...
    @staticmethod
    def read(path: str | PathLike[str]) -> Model: ...
    @property
    def name(self) -> str: ...
    @property
    def file(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def inputs(self) -> list[str]: ...
    @property
    def states(self) -> list[str]: ...
    @property
    def equations(self) -> dict[str, str]: ...
    @property
    def parameters(self) -> dict[str, dict[str, Any]]: ...
    def with_parameters(self, values: Sequence[tuple[str, float]]) -> Model: ...

Studied = tuple[str, str, str | None, str, list[dict[str, Any]]]

def diagnose(
    model: Model,
    train: Sequence[Source],
    holdout: Sequence[Source],
    map: Sequence[str],
    seed: int,
    work: int | None,
    mechanisms: str | PathLike[str] | None,
    progress: Progress,
) -> Studied: ...
def identify(
    train: Sequence[Source],
    holdout: Sequence[Source],
    map: Sequence[str],
    wanted: dict[str, Any],
    progress: Progress,
) -> Studied: ...
def calibrate(
    model: Model,
    train: Sequence[Source],
    holdout: Sequence[Source],
    map: Sequence[str],
    progress: Progress,
) -> Studied: ...
def simulate(
    model: Model, recording: Source, map: Sequence[str], progress: Progress
) -> tuple[str, str, Floats, list[tuple[str, Floats]]]: ...
def check(
    recordings: Sequence[Source], model: Model | None, inputs: Sequence[str], map: Sequence[str]
) -> tuple[str, str]: ...
def control(
    model: Model, wanted: dict[str, Any], report: tuple[str, str] | None, progress: Progress
) -> tuple[
    str, str, list[tuple[str, bytes]], tuple[Floats, Floats, Floats, list[tuple[str, Floats]]]
]: ...
