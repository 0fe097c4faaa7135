"""The one kind of error that is the user's to mend."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class InputError(Exception):
    """The input or the command line is wrong: one sentence says what was given, what is allowed and what to type.

    Entry points print the sentence on stderr and exit with 2; any other exception is a bug and exits with 1.
    """


class Damaged(InputError):
    """A file that was kept for later is cut off or changed: whoever can make it again drops it and does."""

    def __init__(self, path: object) -> None:
        super().__init__(f"{path} is damaged: give the same command again, and it is made anew.")


def unknown(what: str, given: object, allowed: Iterable[object], fix: str = "") -> InputError:
    """An :class:`InputError` for a name that does not exist, with the nearest one that does."""
    names = sorted(str(name) for name in allowed)
    near = get_close_matches(str(given), names, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else "."
    return InputError(f"{what} {given!r} is unknown{hint} Allowed: {', '.join(names)}.{' ' + fix if fix else ''}")
