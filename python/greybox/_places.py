"""Files and folders on this machine, and by URL anywhere that fsspec reaches."""

from __future__ import annotations

import contextlib
import importlib
import os
import posixpath
import uuid
from collections.abc import Mapping
from typing import Any, Optional

from . import _native
from ._errors import InputError

#: Arguments of the file system behind a URL: keys, endpoints.
Options = Optional[Mapping[str, Any]]


def is_url(place: str) -> bool:
    return "://" in place


def _system(url: str, options: Options) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    try:
        core = importlib.import_module("fsspec.core")
    except ImportError:
        raise ImportError(f"{url}: a URL needs fsspec: pip install fsspec") from None
    system, path = core.url_to_fs(url, **(options or {}))
    return system, path


def join(folder: str, name: str) -> str:
    return posixpath.join(folder, name) if is_url(folder) else os.path.join(folder, name)


def is_folder(place: str, options: Options) -> bool:
    if not is_url(place):
        return os.path.isdir(place)
    system, path = _system(place, options)
    return bool(system.isdir(path))


def entries(folder: str, options: Options) -> list[str]:
    """What is in a folder, in the order of names."""
    if not is_url(folder):
        return sorted(os.path.join(folder, name) for name in os.listdir(folder))
    system, path = _system(folder, options)
    names = {posixpath.basename(entry.rstrip("/")) for entry in system.ls(path, detail=False)}
    return sorted(posixpath.join(folder, name) for name in names if name)


def matching(pattern: str, options: Options) -> list[str]:
    """The files that a pattern names, in the order of names."""
    if is_url(pattern):
        system, path = _system(pattern, options)
        return sorted(str(system.unstrip_protocol(found)) for found in system.glob(path))
    from glob import glob

    return sorted(glob(pattern, recursive=True))


def apart(place: str) -> tuple[str, str | None]:
    """File and episode of ``data.parquet#3``; a file that is called so comes first."""
    episode = _native.episode(place)
    return (place, None) if episode is None else (place[: -len(episode) - 1], episode)


def content(place: str, options: Options) -> bytes:
    """The bytes of a recording; of an episode, those of the whole file."""
    if not is_url(place):
        return _native.content(place)
    place, _ = apart(place)
    system, path = _system(place, options)
    try:
        return bytes(system.cat_file(path))
    except FileNotFoundError:
        raise InputError(
            f"{place}: no such file", {"message": f"{place}: no such file", "help": "check the path and the spelling"}
        ) from None


class Folder:
    """A folder of results."""

    def __init__(self, place: str, options: Options) -> None:
        self._place = place
        self._system: Any = None
        self._path = place
        if is_url(place):
            self._system, self._path = _system(place, options)

    def read(self, name: str) -> bytes | None:
        """The content of one of its files; none where there is no such file."""
        try:
            if self._system is not None:
                return bytes(self._system.cat_file(posixpath.join(self._path, name)))
            with open(os.path.join(self._path, name), "rb") as file:
                return file.read()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, files: list[tuple[str, bytes]]) -> None:
        """Writes files in their order, each whole or not at all. The folder is made where it is missing."""
        if self._system is not None:
            self._system.makedirs(self._path, exist_ok=True)
            for name, content in files:
                self._system.pipe_file(posixpath.join(self._path, name), content)
            return
        os.makedirs(self._path, exist_ok=True)
        for name, content in files:
            waiting = os.path.join(self._path, f".greybox-{uuid.uuid4().hex}.partial")
            try:
                with open(waiting, "xb") as file:
                    file.write(content)
                os.replace(waiting, os.path.join(self._path, name))
            except BaseException:
                with contextlib.suppress(FileNotFoundError):
                    os.remove(waiting)
                raise
