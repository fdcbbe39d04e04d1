"""Which column is t, x, y and p: by its name, else by its values.

Names may be those of headers, array fields, archive members or data sets. Without names the values
decide: the polarity has two values, the time never decreases, pixels are integers; x is assumed to
stand before y. If two orders fit, `t x y p` is preferred, then `x y p t`, then the one whose times
span most.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Collection, Iterable
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.notes import Note

NAMES = {  # column names, without their units
    **dict.fromkeys(("t", "ts", "time", "times", "timestamp", "timestamps"), "t"),
    **dict.fromkeys(("x", "xs", "col", "column", "u"), "x"),
    **dict.fromkeys(("y", "ys", "row", "v"), "y"),
    **dict.fromkeys(("p", "ps", "pol", "polarity", "polarities", "on"), "p")}
LABEL = "noise"  # which events are, as `evflow simulate --labels` writes it
LABELS_UNREAD = Note("events.unread", f"the labels `{LABEL}`, which events are noise, were not "
                     "read: no other command uses or keeps them")
BRACKETS = re.compile(r"[\[(].*?[\])]")
UNIT = re.compile(r"_(?:[mnuµμ]?s(?:ecs?)?|(?:milli|micro|nano)?seconds?|px|pixels?)$")
SIDE = re.compile(r"@(\d{1,5})$")  # faery's x@640
PAIR = re.compile(r"\b(?:geometry|resolution|size)\b\D{0,3}(\d{1,5})\s*[x,;\s]\s*(\d{1,5})\b", re.I)
SIDES = re.compile(r"\b(width|height)\b\W{0,3}(\d{1,5})\b", re.I)
POLARITIES = {-1.0, 0.0, 1.0}
PAIRS = ("resolution", "sensor_resolution", "sensor_size", "geometry", "size", "wh")
PROPHESEE = "xypt"
KNOWN = ("txyp", PROPHESEE)
OTHERS = tuple(
    "".join(order) for order in itertools.permutations("txyp")
    if order.index("x") < order.index("y") and "".join(order) not in KNOWN)
TELLING = 10  # rows from which fractional coordinates count as undistorted events


def meaning(name: str) -> str:
    """"t", "x", "y" or "p" for a column of this name, "" if unknown."""
    bare = SIDE.sub("", BRACKETS.sub(" ", name.lower()).strip().strip("\"'").strip())
    return NAMES.get(bare) or NAMES.get(UNIT.sub("", bare), "")


def by_name(names: Iterable[str]) -> dict[str, str]:
    """{"t": a name, "x": ...} from names that cover all four; empty if one is missing or two mean
    the same, unless the shorter ones cover all four by themselves."""
    found: dict[str, list[str]] = {}
    for name in names:
        if column := meaning(name):
            found.setdefault(column, []).append(name)
    if len(found) < 4:
        return {}
    best = {column: min(same, key=len) for column, same in found.items()}
    clear = all(sum(len(n) == len(best[c]) for n in same) == 1 for c, same in found.items())
    return best if clear else {}


def written_size(words: str) -> Size | None:
    """(width, height) from a header or comment: "geometry:1280,720", "x@640,y@480"."""
    if pair := PAIR.search(words):
        return int(pair[1]), int(pair[2])
    sides: dict[str, str] = {name.lower(): side for name, side in SIDES.findall(words)}
    for field in words.lower().replace(",", " ").split():
        if (side := SIDE.search(field)) and meaning(field) in ("x", "y"):
            sides["width" if meaning(field) == "x" else "height"] = side[1]
    return (int(sides["width"]), int(sides["height"])) if len(sides) == 2 else None


def stated_size(get: Callable[[str], Any]) -> Size | None:
    """(width, height) from values stored under usual names; get(name): a value, or None."""
    sides = [_numbers(get(name)) for name in ("width", "height")]
    if len(sides[0]) == len(sides[1]) == 1:
        return sides[0][0], sides[1][0]
    for name in PAIRS:
        value = get(name)
        if isinstance(words := text(value), str):
            if size := written_size(f"{name} {words}"):
                return size
        elif len(pair := _numbers(value)) >= 2:
            return max(pair[:2]), min(pair[:2])  # some write the height first; sensors are wide
    return None


def text(value: Any) -> str | None:
    """The string that an attribute holds; None if it holds something else."""
    if isinstance(value, bytes):
        return value.decode("latin-1")
    return str(value) if isinstance(value, str) else None


def _numbers(value: Any) -> list[int]:
    """Positive integers in a value; none if it is something else."""
    found = np.asarray(() if value is None else value).ravel()
    if found.dtype.kind not in "iuf" or not len(found) or len(found) > 4:
        return []
    if not (np.isfinite(found).all() and (found > 0).all() and (found < 1 << 16).all()):
        return []
    return [int(v) for v in found]


def order_of(rows: np.ndarray) -> str:
    """"txyp", "xypt" or another order for rows (n, 4) of unnamed numbers; "" if they cannot be
    events."""
    with np.errstate(invalid="ignore", over="ignore"):
        fits = {order: _fits(rows, order) for order in (*KNOWN, *OTHERS)}
        sound = [order for order, rising in fits.items() if rising]
        span = {order: float(np.ptp(rows[:, order.index("t")])) for order in sound}
    sound.sort(key=lambda order: (-span[order], (*KNOWN, *OTHERS).index(order)))
    return next(iter(sound), next((o for o in KNOWN if fits[o] is not None), ""))


def _fits(rows: np.ndarray, order: str) -> bool | None:
    """Whether the rows can be events in that order: None if not, else whether times never fall."""
    t, x, y, p = (rows[:, order.index(name)] for name in "txyp")
    signs = set(p.tolist())
    if not signs <= POLARITIES or min(x.min(), y.min()) < 0 or set(t.tolist()) <= {0.0, 1.0}:
        return None
    rising, both = bool((np.diff(t) >= 0).all()), len(signs) > 1
    pixels = whole(x) and whole(y)
    if order in KNOWN:
        possible = (pixels and (rising or both)) or (rising and both and len(rows) >= TELLING)
    else:
        possible = pixels and rising and both and len(rows) >= TELLING
    return rising if possible else None


def whole(values: np.ndarray) -> bool:
    with np.errstate(invalid="ignore"):
        return bool((values % 1 == 0).all())


def inferred(order: Collection[str]) -> Note:
    """The note on an order that was inferred from the values."""
    return Note("events.layout", f"the columns have no names: inferred from their values to be "
                f"{', '.join(order)}")
