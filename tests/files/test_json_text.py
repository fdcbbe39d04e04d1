"""JSON that nests without end is refused by the depth of its brackets, however it is written."""

from __future__ import annotations

import json

import pytest

from evflow.files import json_text
from evflow.files.json_text import DEEPEST, parse_json


@pytest.mark.parametrize("opened", ["[", "[ ", '{"a": ', '[{"a": ', "[[], "])
def test_deeper_than_any_file_is(opened: str) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(opened * (DEEPEST + 1))


def test_what_json_says_of_all_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_text, "BLOCK", 64)
    wide = {"many": [[[1, 2]]] * 100, "brackets": "[" * (DEEPEST // 2)}
    text = json.dumps(wide)
    assert parse_json(text) == parse_json(text.encode()) == wide
    assert parse_json("[" * DEEPEST + "]" * DEEPEST) == json.loads("[" * DEEPEST + "]" * DEEPEST)
    for damaged in (b"", "", "[1,", b"\xff\xfe", "{]"):
        with pytest.raises(ValueError, match=r"."):
            parse_json(damaged)
