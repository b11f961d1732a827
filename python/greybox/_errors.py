"""What goes wrong, in the words of the command."""

from __future__ import annotations

import json


class GreyboxError(Exception):
    """Why a call did not finish. ``str(error)`` is what the command prints behind ``error:``.

    Flags that the help names are arguments here: ``--map`` is ``map=``.
    """

    #: What is wrong.
    message: str
    #: What to do about it, where the message does not say.
    help: str | None
    #: Where: the parts that are known.
    file: str | None
    line: int | None
    column: int | None
    channel: str | None

    def __init__(self, text: str, place: dict[str, object] | None = None) -> None:
        super().__init__(text)
        place = place or {}
        self.message = str(place.get("message", text))
        for name in ("help", "file", "line", "column", "channel"):
            setattr(self, name, place.get(name))


class InputError(GreyboxError, ValueError):
    """A model, a recording or an argument is wrong."""


class InternalError(GreyboxError, RuntimeError):
    """A fault of greybox or of the machine."""


def of(text: str, failure: str) -> GreyboxError:
    """The exception of a failure: its text, and what the command prints with ``--json``."""
    place = json.loads(failure)["error"]
    kind = InputError if place["kind"] == "bad_input" else InternalError
    return kind(text, place)
