"""The mutations of tests/mutations.py still apply; whether tests catch them, it says itself."""

from __future__ import annotations

from pathlib import Path

import pytest

import evflow

from . import mutations

SOURCE = Path(evflow.__file__).parent


@pytest.mark.parametrize("mutation", mutations.MUTATIONS, ids=lambda m: m.name)
def test_the_text_of_a_mutation_stands_once_in_its_file(mutation):
    assert (SOURCE / mutation.file).read_text().count(mutation.old) == 1
