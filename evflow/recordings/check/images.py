"""Rules on the frames: exposure, repeats, bit depth, colour."""

from __future__ import annotations

import numpy as np

from evflow.light.colour import LUMA
from evflow.recordings.check.findings import Finding
from evflow.recordings.contradictions import FRAMES
from evflow.recordings.mosaics import mosaic_planes
from evflow.recordings.repeats import repeated_frames
from evflow.types import Recording, release

WHITE_DN, BLACK_DN = 254.5, 0.5
FRAME_SHARE, ALL_SHARE = 0.5, 0.25  # of the pixels of one frame, and of all frames
DEPTHS = {255: 8, 1023: 10, 4095: 12, 16383: 14, 65535: 16}


def images(recording: Recording) -> list[Finding]:
    """EV027 (saturated, black), EV028 (repeated), EV031 (depth), EV032 (colour)."""
    if not recording.has_frames:
        return []
    return [*_exposure(recording), *_repeated(recording), *_depth(recording)]


def _exposure(recording: Recording) -> list[Finding]:
    shares = []
    for i in range(len(recording.frame_times)):
        if i % FRAMES == 0:
            release(recording)
        frame = recording.frame_dn(i)
        shares.append(((frame >= WHITE_DN).mean(), (frame <= BLACK_DN).mean()))
    found = []
    for share, name, fix in zip(
        np.array(shares).T, ("saturated", "black"), ("Expose shorter", "Expose longer"),
        strict=True,
    ):
        bad = np.flatnonzero(share > FRAME_SHARE)
        if len(bad) or share.mean() > ALL_SHARE:
            which = f"; frame {bad[0]} by {share[bad[0]]:.0%}" if len(bad) else ""
            found.append(Finding(
                "EV027", "warning", f"{share.mean():.1%} of the frames' pixels are {name}{which} "
                f"({len(bad)} of {len(share)} frames by more than half): they determine no "
                "thresholds.",
                f"{fix}; such pixels are left out."))
    return found


def _repeated(recording: Recording) -> list[Finding]:
    same = repeated_frames(recording)
    if not len(same):
        return []
    return [Finding(
        "EV028", "warning", f"{len(same)} of {len(recording.frames)} frames repeat the one "
        f"before while pixels fire, first frame {same[0]}: shown twice by a converter?",
        "An estimate leaves them out; better export at the camera's own frame rate.")]


def _depth(recording: Recording) -> list[Finding]:
    found = []
    if recording.frames.dtype == np.uint16:
        white = recording.full_scale
        kind = f"as of {DEPTHS[white]}-bit data, " if white in DEPTHS else ""
        found.append(Finding(
            "EV031", "note", "16-bit frames, kept at full depth; their largest value is "
            f"{recording.frames.max():,}: {kind}white is taken as {white:,}.",
            "If white lies elsewhere, rescale them."))
    colour = [note.text for note in recording.notes if note.code in LUMA]
    if colour:
        found.append(Finding(
            "EV032", "note", f"{colour[0].rstrip('.')}.", "A pixel behind a colour filter sees "
            "only its own colour: expect larger errors of its thresholds."))
    balanced = any(note.code == "frames.balanced" for note in recording.notes)
    if not (colour or balanced) and (medians := mosaic_planes(recording)) is not None:
        shown = ", ".join(f"{v:.0f}" for v in medians)
        found.append(Finding(
            "EV032", "warning", f"every other pixel of the frames is unlike bright (medians of the "
            f"four planes {shown} DN): a raw colour mosaic?", "Pass its pattern: --colour rggb if "
            "the events come from behind it too (a colour DAVIS), else --bayer rggb (or bggr, "
            "grbg, gbrg)."))
    return found
