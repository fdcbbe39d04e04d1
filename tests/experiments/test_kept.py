"""Rows of a long run: an interrupted one is gone on with, and no other is taken for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from evflow import EvflowDataError
from experiments.shared.kept import resumed


def test_what_is_there_is_not_made_again(tmp_path: Path) -> None:
    path, asked = tmp_path / "rows.json", []

    def make(left: list[int]) -> list[dict[str, int]]:
        asked.append(left)
        return [{"value": 10 * i} for i in left]

    def broken(left: list[int]):  # type: ignore[no-untyped-def]
        yield {"value": 10 * left[0]}
        raise KeyboardInterrupt

    names = ["a", "b", "c"]
    with pytest.raises(KeyboardInterrupt):
        resumed(path, ["seed", 1], names, broken, "rows")
    assert resumed(path, ["seed", 1], names, make, "rows") == [
        {"value": 0}, {"value": 10}, {"value": 20}]
    assert resumed(path, ["seed", 1], ["c"], make, "rows") == [{"value": 20}]
    assert resumed(None, ["seed", 1], ["c"], make, "rows") == [{"value": 0}]
    assert asked == [[1, 2], [], [0]]


@pytest.mark.parametrize(("held", "code"), [
    ('{"of": ["seed", 2], "rows": {}}', "EV013"), ("[1, 2]", "EV009"), ("{", "EV009"),
    ('{"rows": {}}', "EV009")])
def test_rows_of_something_else_are_refused(tmp_path: Path, held: str, code: str) -> None:
    path = tmp_path / "rows.json"
    path.write_text(held)
    with pytest.raises(EvflowDataError, match=code):
        resumed(path, ["seed", 1], ["a"], lambda left: [{} for _ in left], "rows")
    assert path.read_text() == held
    with pytest.raises(EvflowDataError, match="EV009"):
        resumed(tmp_path, ["seed", 1], ["a"], lambda left: [{} for _ in left], "rows")
