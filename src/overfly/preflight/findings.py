"""What a check has to say: findings, each one sentence with its cause and its remedy, worst first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

LEVELS = ("stop", "bad", "warn", "note")
"""No map can be made; a part of the map will be missing or wrong; the map will be weaker; good to know."""


@dataclass(frozen=True)
class Finding:
    """Something that the user can mend before anything is computed.

    Attributes:
        level: one of :data:`LEVELS`.
        topic: one word for programs: overlap, gps, blur, ...
        cause, remedy: the two halves of the sentence, without the colon between them and the point at its end.
        images: names of the images that it is about.
    """

    level: str
    topic: str
    cause: str
    remedy: str
    images: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.cause}: {self.remedy}."

    def to_dict(self) -> dict[str, Any]:
        return {"level": self.level, "topic": self.topic, "sentence": str(self), "images": list(self.images)}


def ranked(findings: Iterable[Finding]) -> list[Finding]:
    """Worst first; those of one level stay in their order."""
    return sorted(findings, key=lambda finding: LEVELS.index(finding.level))


def some(names: Iterable[str], most: int = 3) -> str:
    """The first names and how many more, for the middle of a sentence."""
    names = list(names)
    text = ", ".join(names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"


def count(number: int, noun: str) -> str:
    """1 image, 2 images."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
