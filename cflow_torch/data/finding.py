"""One line of the check of a log."""

from __future__ import annotations

from typing import NamedTuple

RIGHT, FOUND, WRONG = "right", "found and used", "wrong"
CHOOSE, UNREAD = "choose data.poses=", "we read no poses from"
"""Parts of the notes of readers about poses that they do not use, which the check repeats if the sensor moves."""


class Finding(NamedTuple):
    """What a check, or a wrapper of a log, found."""

    topic: str  # sensor, points, frame, ground, poses, times, ...
    status: str  # RIGHT, FOUND or WRONG
    text: str  # what was found; if it is wrong, with the fix
    is_quick: bool = False  # commands print it if it is not right
