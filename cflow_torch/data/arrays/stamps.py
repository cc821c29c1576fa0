"""Times as files and names of files state them: numbers of any usual unit, or dates."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from decimal import Decimal
from typing import Sequence

# Nanoseconds in ns, us, ms and s, and the shortest step from one time to the next that tells the unit. Some poses are a
# few seconds apart, hardly any a few milliseconds.
_UNITS = {1: 1_200_000, 10**3: 1_200_000, 10**6: 5_000_000, 10**9: 0}
_LONGEST = 10**11  # the same, of unix times
_LIMIT = 1 << 63  # nanoseconds that an int64 cannot hold
_UNIX = range(10**18, 41 * 10**17)  # nanoseconds since 1970: from 2001 to 2099
# After colons, "-08:00" and "-0800" are a time zone, else "-123456" is a fraction.
_DATE = re.compile(
    r"(?<!\d)(\d{4})\D?(\d\d)\D?(\d\d)\D(\d\d)\D?(\d\d)\D?(\d\d)"
    r"(?:(?:[.,_]|(?<!:\d\d)[^\d+])(\d+)(?![\d:]))?(?:([+-])(\d\d):?(\d\d)(?!\d))?"
)
# A date of 14 digits, with milli-, micro- or nanoseconds or without.
_DIGITS = re.compile(r"(?<!\d)((?:19|20)\d\d)([01]\d)([0-3]\d)([0-2]\d)([0-5]\d)([0-5]\d)(\d{3}|\d{6}|\d{9}|)(?!\d)")
_CLOCK = re.compile(r"(?<![\d:])(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))?(?![\d:])")
_STAMP = re.compile(r"(?<!\d)([1-9]\d{12}|[1-9]\d{15,17}|[1-8]\d{18})(?!\d)")  # no numbers with zeros in front
# Seconds and a fraction: unix seconds anywhere in a name, or the only number of a name.
_SECONDS = (re.compile(r"(?<!\d)(\d{9,10})[._](\d+)(?!\d)"), re.compile(r"^\D*(\d{1,10})\.(\d+)$"))
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def nanoseconds_of_numbers(words: Sequence[str]) -> list[int]:
    """Convert texts of times to nanoseconds exactly: unix times need 19 digits, a float has 16.

    They may be in s, ms, us or ns. The unit is the one in which they are unix times with a median step of at most
    100 s. Times from another start have the smallest unit in which the step is at least 1.2 ms, of milliseconds 5 ms.
    Numbers that all have nine decimals are seconds.
    """
    numbers = [Decimal(word) for word in words]
    distinct = sorted(set(numbers))
    steps = sorted(after - before for before, after in zip(distinct, distinct[1:])) or [Decimal(0)]
    step = steps[len(steps) // 2]
    units = [10**9] if all(number.as_tuple().exponent == -9 for number in numbers) else []
    units += [unit for unit in _UNITS if int(distinct[-1] * unit) in _UNIX and step * unit <= _LONGEST]
    units += [unit for unit, shortest in _UNITS.items() if step * unit >= shortest]
    return [int((number * units[0]).to_integral_value()) for number in numbers]


def nanoseconds_of_dates(texts: Sequence[str]) -> list[int] | None:
    """Convert texts that contain a date such as 2011-09-26 13:02:25.594360375 to nanoseconds since 1970 (UTC).

    Year to second have all digits, with one separator or none, and may have a time zone behind. Of a time without a
    date (13:02:25.594), we return the nanoseconds since midnight. None = a text contains neither.
    """
    times = []
    for text in texts:
        date = _DATE.search(text)
        clock = _CLOCK.search(text) if date is None else None
        if date is None and clock is None:
            return None
        *numbers, fraction = date.groups()[:7] if date else (1970, 1, 1, *clock.groups())  # type: ignore[union-attr]
        try:
            time = datetime(*map(int, numbers), tzinfo=timezone.utc)  # type: ignore[arg-type,misc]
        except ValueError:
            return None
        sign, hours, minutes = date.groups()[7:] if date and date[8] else ("+", 0, 0)
        east = int(f"{sign}{60 * int(hours) + int(minutes)}") * 60
        times.append((int((time - _EPOCH).total_seconds()) - east) * 10**9 + int((fraction or "0")[:9].ljust(9, "0")))
    return times


def times_of_names(names: Sequence[str]) -> list[int] | None:
    """Return the nanoseconds that names of files state; None if they do not state times, or repeat one.

    Names contain a unix time in milliseconds (13 digits), microseconds (16, 17) or nanoseconds (18, 19), unix seconds
    and a fraction ("1700000000.05", "1700000000_050000000"), or a date, also without separators; or their only number
    is seconds ("0.05"). Fractions are decimals, unless their numbers of digits differ and the longest has nine: then
    they are nanoseconds without leading zeros. A last number that counts the files is ignored.
    """
    times = None
    if not names:
        return None
    names = _without_counters(names)
    if all(map(_DIGITS.search, names)):
        date = r"\1-\2-\3T\4:\5:\6"
        names = [_DIGITS.sub(lambda found: found.expand(date + (r".\7" if found[7] else "")), name) for name in names]
    stamps = [_STAMP.search(name) for name in names]
    seconds = [[pattern.search(name) for name in names] for pattern in _SECONDS]
    if all(stamps):
        times = nanoseconds_of_numbers([stamp[1] for stamp in stamps if stamp])
    for matches in seconds:
        if times is None and all(matches):
            pairs = [(match[1], match[2]) for match in matches if match]
            digits = {len(fraction) for _, fraction in pairs}
            are_decimals = max(digits) != 9 or len(digits) == 1
            fractions = [int(fraction[:9].ljust(9, "0") if are_decimals else fraction) for _, fraction in pairs]
            times = [int(second) * 10**9 + fraction for (second, _), fraction in zip(pairs, fractions)]
    times = times or nanoseconds_of_dates(names)
    are_times = times is not None and max(times) < _LIMIT and len(set(times)) == len(times)
    return times if are_times else None


def _without_counters(names: Sequence[str]) -> Sequence[str]:
    """Cut off the last number if it counts the files.

    A counter has three digits or more in all names, always grows, and mostly by less than 10. It begins below 1000, or
    the names before it state times.
    """
    last = [match for match in (re.search(r"(\d{3,})\D*$", name) for name in names) if match]
    numbers = [int(match[1]) for match in last]
    steps = sorted(after - before for before, after in zip(numbers, numbers[1:]))
    are_alike = len(last) == len(names) > 1 == len({len(match[1]) for match in last})
    is_counter = are_alike and steps[0] > 0 and steps[len(steps) // 2] < 10
    cut = [name[: match.start()] for name, match in zip(names, last)]
    has_times = any(all(map(pattern.search, cut)) for pattern in (_STAMP, _DATE, _CLOCK, *_SECONDS))
    return cut if is_counter and (has_times or numbers[0] < 1000) else names
