from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]
_Source = Recording | str | PathLike[str]
_Progress = Callable[[str], object] | None

__all__ = [
    "EXTENSIONS",
    "Fleet",
    "Model",
    "READS_PARQUET",
    "Recording",
    "__version__",
    "calibrate",
    "check",
    "check_table",
    "conclude",
    "content",
    "control",
    "diagnose",
    "episode",
    "episodes",
    "episodes_of",
    "failed",
    "identify",
    "mechanisms",
    "reduce",
    "simulate",
    "statistics",
]

__version__: str
#: Endings of the files that may hold a recording.
EXTENSIONS: list[str]
#: Whether this build reads Parquet files by itself.
READS_PARQUET: bool

@final
class Recording:
    def __new__(
        cls, name: str, time: _Floats, channels: Sequence[tuple[str, str | None, _Floats]]
    ) -> Recording: ...
    @staticmethod
    def from_clocks(
        name: str, clocks: Sequence[tuple[_Floats, Sequence[tuple[str, str | None, bool, _Floats]]]]
    ) -> Recording: ...
    @staticmethod
    def read(path: str | PathLike[str]) -> Recording: ...
    @property
    def name(self) -> str: ...
    @property
    def t(self) -> _Floats: ...
    @property
    def channels(self) -> list[tuple[str, str | None, _Floats]]: ...

@final
class Model:
    def __new__(cls, text: str, file: str) -> Model: ...
    @staticmethod
    def read(path: str | PathLike[str]) -> Model: ...
    @property
    def name(self) -> str: ...
    @property
    def file(self) -> str: ...
    @property
    def path(self) -> PathLike[str]: ...
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

_Studied = tuple[str, str, str | None, str, list[dict[str, Any]]]

def diagnose(
    model: Model,
    train: Sequence[_Source],
    holdout: Sequence[_Source],
    map: Sequence[str],
    channels: Sequence[str],
    seed: int,
    work: int | None,
    mechanisms: str | PathLike[str] | None,
    terms_only: bool,
    progress: _Progress,
) -> _Studied: ...
def identify(
    train: Sequence[_Source],
    holdout: Sequence[_Source],
    map: Sequence[str],
    channels: Sequence[str],
    wanted: dict[str, Any],
    progress: _Progress,
) -> _Studied: ...
def calibrate(
    model: Model,
    train: Sequence[_Source],
    holdout: Sequence[_Source],
    map: Sequence[str],
    channels: Sequence[str],
    progress: _Progress,
) -> _Studied: ...
def simulate(
    model: Model, recording: _Source, map: Sequence[str], channels: Sequence[str], progress: _Progress
) -> tuple[str, str, _Floats, list[tuple[str, _Floats]]]: ...
def check(
    recordings: Sequence[_Source],
    model: Model | None,
    inputs: Sequence[str],
    map: Sequence[str],
    channels: Sequence[str],
) -> tuple[str, str]: ...
def control(
    model: Model,
    wanted: dict[str, Any],
    reference: _Source | None,
    report: tuple[str, str] | None,
    progress: _Progress,
) -> tuple[
    str, str, list[tuple[str, bytes]], tuple[_Floats, _Floats, _Floats, list[tuple[str, _Floats]]]
]: ...

@final
class Fleet:
    def __new__(
        cls,
        model: Model,
        holdout: Sequence[tuple[str, bytes]],
        map: Sequence[str],
        channels: Sequence[str],
        seed: int,
        work: int | None,
        mechanisms: Sequence[tuple[str, str]],
    ) -> Fleet: ...
    def finished(
        self, path: str, content: bytes, name: str, folder: str, read: Callable[[str], bytes | None]
    ) -> str | None: ...
    def diagnose(
        self, path: str, content: bytes, name: str, folder: str, recording: Recording | None, threads: int
    ) -> tuple[list[tuple[str, bytes]], str]: ...

def content(path: str) -> bytes: ...
def episode(place: str) -> str | None: ...
def episodes(path: str) -> list[int]: ...
def episodes_of(content: bytes) -> list[int]: ...
def mechanisms(folder: str | PathLike[str]) -> list[tuple[str, str]]: ...
def statistics(name: str, page: str | None, report: str) -> str: ...
def failed(name: str, message: str, help: str | None) -> str: ...
def reduce(parts: Sequence[str]) -> str: ...
def check_table(text: str, file: str, recordings: Sequence[str]) -> None: ...
def conclude(
    parts: Sequence[str], table: tuple[str, str] | None, name: str, file: str, seed: int
) -> tuple[str, str, str]: ...
