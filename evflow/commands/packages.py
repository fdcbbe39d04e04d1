"""Optional packages that a command needs: all missing ones are named at once, before any long work.
"""

from __future__ import annotations

from pathlib import Path

from evflow.errors import EvflowDataError

# The package that reads a format.
READERS = {"dsec": "h5py", "v2e": "h5py", "mvsec": "h5py", "event_utils": "h5py",
           "aedat4": "aedat", "rosbag": "rosbags", "rosbag2": "rosbags"}
EXTRAS = {"h5py": "io", "aedat": "io", "rosbags": "ros", "matplotlib": "viz"}


def need_packages(*recordings: Path, pictures: bool, no_pictures: str) -> None:
    """Raise EV010 with all packages missing for these recordings and, if wanted, for pictures;
    before it EV008, EV009, EV016 if a path is not a recording. no_pictures: options that turn
    pictures off."""
    from evflow.io.registry import find_format

    uses = {READERS[name]: f"to read {path}" for path in recordings
            if (name := find_format(path).NAME) in READERS}
    if pictures:
        uses["matplotlib"] = "for pictures"
    missing = [name for name in uses if not _installed(name)]
    if missing:
        extras = ",".join(sorted({EXTRAS[name] for name in missing}))
        without = f", or pass {no_pictures}" if missing == ["matplotlib"] else ""
        raise EvflowDataError(
            "EV010", f"needed: {'; '.join(f'{name} {uses[name]}' for name in missing)}.",
            f'pip install "evflow-jax[{extras}]"{without}.')


def _installed(name: str) -> bool:
    try:
        __import__(name)
    except ImportError:
        return False
    return True
