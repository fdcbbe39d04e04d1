"""Recordings larger than memory: their columns lie on disk, and are the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.io import spool
from evflow.io.spool import Spool

EVENTS = 3_000_000


@pytest.mark.parametrize("limit", [0, 100, 10_000])
def test_rows_come_back_from_memory_and_from_disk(limit: int) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.integers(0, 1000, n) for n in (0, 7, 40, 1, 300)]
    column = Spool(np.int64, limit)
    for part in parts:
        column.append(part)
    joined = column.array()
    assert isinstance(joined, np.memmap) == (limit < 8 * 348)
    np.testing.assert_array_equal(joined, np.concatenate(parts))
    assert joined.dtype == np.int64


def test_nothing_is_an_empty_array() -> None:
    assert Spool(bool).array().shape == (0,)


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    monkeypatch.setattr(spool.tempfile, "TemporaryFile",
                        lambda prefix: open("/dev/full", "wb", buffering=0))  # noqa: SIM115
    column = Spool(np.int64, 0)
    with pytest.raises(EvflowDataError, match=r"EV019.*TMPDIR"):
        column.append(np.arange(10))


READING = """
import resource, sys
from pathlib import Path
import numpy as np
from evflow import io
from evflow.io import spool

path, limit, room = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
io.read_recording(path, stop_s=0.01)  # all that reading imports
spool.LIMIT = limit
used = int(Path("/proc/self/status").read_text().split("VmData:")[1].split()[0]) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (used + room,) * 2)
events = io.read_recording(path).events
windows = (events.slice(t, t + 100_000) for t in range(0, 3_000_000, 100_000))
print(len(events), sum(int(window.count_map().sum()) for window in windows))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs RLIMIT_DATA")
@pytest.mark.parametrize(("limit", "fits"), [(1 << 20, True), (1 << 29, False)])
def test_windows_of_a_file_larger_than_memory(tmp_path: Path, limit: int, fits: bool) -> None:
    """Three million events, whose columns take 39 MB, in 20 MB (RLIMIT_DATA does not count what is
    mapped from disk)."""
    rng = np.random.default_rng(0)
    table = np.zeros(EVENTS, [("t", "<u4"), ("data", "<u4")])
    table["t"] = np.sort(rng.integers(0, 3_000_000, EVENTS))
    table["data"] = rng.integers(0, 240, EVENTS) << 14 | rng.integers(0, 320, EVENTS)
    path = tmp_path / "large.dat"
    header = b"% Data file containing CD events\n% Width 320\n% Height 240\n"
    path.write_bytes(header + bytes([12, 8]) + table.tobytes())
    done = subprocess.run(
        [sys.executable, "-c", READING, str(path), str(limit), str(20_000_000)],
        capture_output=True, text=True, timeout=120)
    if fits:
        assert done.stdout.split() == [str(EVENTS)] * 2, done.stderr
    else:
        assert "memory" in done.stderr.lower()
