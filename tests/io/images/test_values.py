"""What the numbers of images mean: response, opacity, and floats that are no DN."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from helpers.recordings import equal
from helpers.sources import message, read
from helpers.videos import SHAPE, code_of, drifting, milliseconds

from evflow import (
    Camera,
    Events,
    Recording,
    simulate,
    simulate_stream,
    simulate_voxels,
    write_events,
)
from evflow.errors import EvflowDataError
from evflow.io.source import open_frames
from evflow.light.colour import luma, mosaic
from evflow.light.log_maps import to_dn

LIGHT = drifting(3, (24, 32))  # DN, linear
KEY, CAMERA = jax.random.key(0), Camera.constant(SHAPE, 0.2, 0.2)


def coded(light: np.ndarray) -> np.ndarray:
    """sRGB bytes (IEC 61966-2-1) of linear DN on 0..255."""
    v = light.astype(np.float64) / 255
    code = np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255 * code).astype(np.uint8)


def images(root: Path, frames: np.ndarray, suffix: str = "png") -> Path:
    root.mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(root / f"{i}.{suffix}"), frame)
    return root


def film(root: Path, frames: np.ndarray) -> Path:
    path = root.with_suffix(".avi")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100.0, (32, 24))
    for frame in frames:
        writer.write(np.stack([frame] * 3, -1))
    writer.release()
    return path


def stack(root: Path, frames: np.ndarray) -> Path:
    np.save(root.with_suffix(".npy"), frames)
    return root.with_suffix(".npy")


def recording(root: Path, frames: np.ndarray) -> Path:
    none = np.zeros(0, int)
    write_events(root.with_suffix(".h5"), Recording(
        Events(none, none, none, none, (32, 24)), frames, milliseconds(len(frames))))
    return root.with_suffix(".h5")


@pytest.mark.parametrize(("make", "values", "usual", "hints"), [
    (images, coded(LIGHT), "srgb", {}), (film, coded(LIGHT), "srgb", {}),
    (stack, LIGHT.astype(np.uint8), "linear", {}), (stack, LIGHT, "linear", {}),
    (recording, LIGHT.astype(np.uint8), "linear", {}),
    (images, np.rint(257 * LIGHT).astype(np.uint16), "linear", {}),
    (images, LIGHT.astype(np.uint8), "linear", {"colour": "rggb"}),
    (images, LIGHT.astype(np.uint8), "linear", {"bayer": "rggb"})])
def test_each_source_is_taken_for_what_it_usually_is(
    tmp_path: Path, make: Any, values: np.ndarray, usual: str, hints: dict[str, str]
) -> None:
    """Left open, the response is the usual one, and said; the light of the scene comes out."""
    path = make(tmp_path / "v", values)
    if make is not recording:
        hints = {**hints, "fps": 1000.0}
    frames, _, notes = read(path, response="auto", **hints)
    said = [note.text for note in notes if note.code == "frames.response"]
    assert len(said) == 1
    assert ("sRGB curve" in said[0]) == (usual == "srgb")
    told, _, _ = read(path, response=usual, **hints)
    np.testing.assert_array_equal(frames, told)
    if "bayer" not in hints:
        off = np.abs(frames.astype(np.float64) - LIGHT)
        assert np.median(off) < (3.0 if make is film else 1.0)
    plain = read(path, **hints)[0]  # unless asked, nothing is changed
    assert plain.dtype == (np.float32 if values.dtype != np.uint8 else np.uint8)


def test_pixels_add_up_light_and_not_code(tmp_path: Path) -> None:
    """The luma of coloured light, whatever it was coded by."""
    rng = np.random.default_rng(1)
    light = rng.uniform(0, 255, (24, 32, 3)).astype(np.float32)
    root = images(tmp_path / "v", coded(light)[None])
    seen = read(root, fps=1, response="srgb")[0][0]
    np.testing.assert_allclose(seen, luma(light), atol=1.5)
    np.testing.assert_allclose(
        mosaic(read(root, fps=1, response="srgb", colour="rggb")[0][0], "rggb"),
        mosaic(light, "rggb"), atol=1.5)
    np.testing.assert_array_equal(  # and one luma for stacks, images and arrays
        read(stack(tmp_path / "s", coded(light)[None, ..., ::-1]), fps=1)[0][0],
        luma(coded(light)))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("background", "level"), [("black", 0.0), ("white", 1.0)])
def test_an_object_in_the_opacity_alone_moves(
    tmp_path: Path, dtype: Any, background: str, level: float
) -> None:
    most = np.iinfo(dtype).max
    frames = np.full((2, 24, 32, 4), most // 2, dtype)
    frames[..., 3] = 0
    for i in range(2):
        frames[i, 8:16, 8 + i : 16 + i, 3] = most
    frames[:, :2, :, 3] = most // 4  # half seen through
    root = images(tmp_path / "v", frames)
    seen, _, notes = read(root, fps=1, background=background)
    assert [note.code for note in notes if note.code == "frames.alpha"] == ["frames.alpha"]
    np.testing.assert_allclose(seen[0, 12, 12], 127.5, atol=1)
    np.testing.assert_allclose(seen[:, 20, 20], 255 * level, atol=1)
    np.testing.assert_allclose(seen[0, 0, 0], 0.25 * 127.5 + 0.75 * 255 * level, atol=1.5)
    assert abs(float(seen[0, 12, 8]) - float(seen[1, 12, 8])) > 100
    frames[..., 3] = most
    assert "frames.alpha" not in [n.code for n in read(images(tmp_path / "w", frames), fps=1)[2]]


LOGS = np.log(drifting(4) + 1)
MISTAKEN = {  # what is no DN, and what is said of it
    "logs": (LOGS, "--response log"), "logs of fractions": (LOGS - 5.6, "--response log"),
    "fractions": (drifting(4) / 255, "--full-scale 1"),
    "radiance": (drifting(4) / 200, "--full-scale 1.2"),
    "more radiance": (5 * (drifting(4) / 255) ** 3, "--full-scale"),
    "normalised": (drifting(4) / 127.5 - 1, "(frames + 1) / 2")}


@pytest.mark.parametrize("kind", MISTAKEN)
def test_floats_that_are_no_dn_are_refused_everywhere(tmp_path: Path, kind: str) -> None:
    frames, fix = MISTAKEN[kind]
    frames = frames.astype(np.float32)
    said = [message(lambda: simulate(KEY, frames, milliseconds(4), CAMERA)),
            message(lambda: list(simulate_stream(KEY, frames, milliseconds(4), CAMERA))),
            message(lambda: read(stack(tmp_path / "s", frames), fps=1))]
    for text in said:
        assert text.startswith("EV003"), text
        assert fix in text, text


def test_what_the_messages_tell_to_do_gives_the_light(tmp_path: Path) -> None:
    light = drifting(4)
    for values, hints in (
            (np.log(light), {"response": "log"}), (light / 255, {"full_scale": 1}),
            (np.log(light / 255), {"response": "log", "full_scale": 1}),
            (light / 50, {"full_scale": 5.1}), (light / 255 * 6, {"full_scale": 6})):
        seen = read(stack(tmp_path / "s", values.astype(np.float32)), fps=1, **hints)[0]
        np.testing.assert_allclose(seen, light, rtol=1e-4)
    dark = (light / 50).astype(np.float32)  # insisted on
    np.testing.assert_allclose(read(stack(tmp_path / "s", dark), fps=1, full_scale=255)[0], dark)
    assert len(simulate(KEY, dark, milliseconds(4), CAMERA, full_scale=255)) >= 0
    with pytest.raises(EvflowDataError, match="EV020"):
        simulate(KEY, dark, milliseconds(4), CAMERA, full_scale=0)
    bright = np.float32(8) * dark
    np.testing.assert_array_equal(
        simulate(KEY, np.float32(0.25) * bright, milliseconds(4), CAMERA, full_scale=63.75).t,
        simulate(KEY, bright, milliseconds(4), CAMERA).t)
    deep = np.rint(light * 16).astype(np.uint16)  # twelve bits
    for white in (4095, 65535):
        events, same = (simulate(KEY, frames, milliseconds(4), CAMERA, full_scale=full)
                        for frames, full in ((deep, white), (to_dn(deep, white), 255)))
        equal(events, same)
    equal(simulate(KEY, 16 * deep, milliseconds(4), CAMERA),
          simulate(KEY, 16 * deep, milliseconds(4), CAMERA, full_scale=65535))
    simulate(KEY, light.astype(np.uint8), milliseconds(4), CAMERA, full_scale=255)
    black = np.zeros((4, *SHAPE), np.float32)  # and nothing is wrong with the night
    assert len(simulate(KEY, black, milliseconds(4), CAMERA)) == 0
    late = np.concatenate([dark[:2], light[2:]])  # nor with a video that begins in the dark
    assert len(simulate(KEY, late, milliseconds(4), CAMERA)) > 0
    seen = read(stack(tmp_path / "s", late), fps=1)[0]
    np.testing.assert_allclose(seen, late)
    assert "--full-scale" in message(  # but not after a hundred dark frames
        lambda: read(stack(tmp_path / "s", np.concatenate([*[dark] * 25, light])), fps=1))
    assert "--response log" in message(  # bytes are no logarithms
        lambda: read(stack(tmp_path / "s", light.astype(np.uint8)), fps=1, response="log"))
    assert code_of(lambda: open_frames(tmp_path / "s.npy", fps=1, response="log2")) == "EV020"


@pytest.mark.parametrize(("white", "told"), [(1, "1 "), (7, "7 "), (30, "30?"), (100, "")])
@pytest.mark.parametrize("logs", [False, True])
def test_light_whose_white_lies_elsewhere_is_told(
    tmp_path: Path, white: float, told: str, logs: bool
) -> None:
    light = np.repeat(white / drifting(1).max() * drifting(1) + 1e-6, 2, 0)
    path = stack(tmp_path / "s", (np.log(light) if logs else light).astype(np.float32))
    hints: dict = {"fps": 1, "response": "log" if logs else "linear"}

    def noted(**more: Any) -> str:
        return "".join(n.text for n in read(path, **hints, **more)[2] if n.code == "frames.depth")

    said = message(noted) if white < 8 else noted()
    assert f"--full-scale {told}" in said if told else said == ""
    assert noted(full_scale=255) == ""


@pytest.mark.parametrize(("white", "peak"), [(0.6, 0.6), (1.0, 1.0005), (4095, 4095)])
def test_white_is_255_however_it_is_rounded(tmp_path: Path, white: float, peak: float) -> None:
    light = np.linspace(0.1, 1, 3 * 9 * 16).reshape(3, 9, 16)
    path = stack(tmp_path / "s", (peak * light).astype(np.float32))
    seen = read(path, fps=10, full_scale=white)[0]
    assert seen.max() == 255
    np.testing.assert_allclose(seen, np.minimum(255 * peak / white * light, 255), rtol=1e-6)
    logs = stack(tmp_path / "l", np.log(peak * light).astype(np.float32))
    assert read(logs, fps=10, full_scale=white, response="log")[0].max() == pytest.approx(255)
    assert read(logs, fps=10, full_scale=white, response="log")[0].max() <= 255


@pytest.mark.parametrize(("values", "code"), [
    (drifting(4) / 255, "EV003"), (drifting(4), "EV003"), (drifting(4) / 16, "EV003"),
    (drifting(4) * np.nan, "EV007"), (np.log(drifting(4)), "")])
def test_voxels_of_what_are_no_logarithms(values: np.ndarray, code: str) -> None:
    assert code_of(lambda: simulate_voxels(
        KEY, values.astype(np.float32), CAMERA, frame_dt_s=1e-3)) == code


@pytest.mark.parametrize(("bits", "white"), [(8, 255), (10, 1023), (12, 4095)])
def test_integers_of_few_bits_in_sixteen_need_their_white(
    tmp_path: Path, bits: int, white: int
) -> None:
    frames = np.linspace(0, 2**bits - 9, 3 * 9 * 16).reshape(3, 9, 16).astype(np.uint16)
    np.save(tmp_path / "a.npy", frames)
    with pytest.raises(EvflowDataError, match=f"EV003.*--full-scale {white} "):
        list(open_frames(tmp_path / "a.npy", fps=30).open())
    with pytest.raises(EvflowDataError, match=f"EV003.*--full-scale {white} "):
        simulate(KEY, frames, milliseconds(3), Camera.constant((9, 16)))
    simulate(KEY, frames, milliseconds(3), Camera.constant((9, 16)), full_scale=65535)
    seen = [frame for frame, _ in open_frames(tmp_path / "a.npy", fps=30, full_scale=white).open()]
    np.testing.assert_allclose(seen, frames * (255 / white), rtol=1e-6)
    late = np.concatenate([frames, 65535 // frames.max() * frames])  # begins in the dark
    np.save(tmp_path / "a.npy", late)
    assert len(list(open_frames(tmp_path / "a.npy", fps=30).open())) == 6


def netpbm(path: Path, kind: str, codes: np.ndarray, white: int) -> None:
    """Codes (H, W, 3) in R, G, B, or (H, W), of a file whose maxval is `white`."""
    body = (" ".join(map(str, codes.ravel())).encode() + b"\n" if kind in ("P2", "P3") else
            codes.astype("u1" if white < 256 else ">u2").tobytes())
    height, width = codes.shape[:2]
    path.write_bytes(f"{kind}\n# by hand\n{width} {height}\n{white}\n".encode() + body)


@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
@pytest.mark.parametrize(("white", "told"), [
    (100, True), (255, False), (1023, True), (16383, True), (65535, False)])
def test_a_pgm_names_its_white(tmp_path: Path, kind: str, white: int, told: bool) -> None:
    for i, light in enumerate(LIGHT / LIGHT.max()):
        code = np.rint(white * light).astype(int)
        netpbm(tmp_path / f"{i}.pgm", kind,
               np.stack([code] * 3, -1) if kind in ("P3", "P6") else code, white)
    frames, _, notes = read(tmp_path, fps=10)
    np.testing.assert_allclose(frames, 255 * LIGHT / LIGHT.max(), atol=1 + 255 / white / 2)
    said = [note.text for note in notes if note.code == "frames.white"]
    text_of_bytes = white == 100 and kind in ("P2", "P3")  # which OpenCV scales
    assert said == ([f"{white} is white, as the images say (maxval); --full-scale sets another "
                     "value."] if told and not text_of_bytes else [])
    if white > 255:
        other = read(tmp_path, fps=10, full_scale=2.0 * white)[0]
        np.testing.assert_allclose(other, frames / 2, atol=1e-4)


def test_pgms_that_name_two_whites_are_refused(tmp_path: Path) -> None:
    for i, white in enumerate((1023, 4095)):
        netpbm(tmp_path / f"{i}.pgm", "P5", np.full((4, 6), 500), white)
    assert "0.pgm names 1023 as white (maxval), 1.pgm 4095" in message(
        lambda: read(tmp_path, fps=10))
    assert read(tmp_path, fps=10, full_scale=4095)[0].max() == pytest.approx(31.1, abs=0.1)


def test_stacks_of_the_other_byte_order_are_the_same(tmp_path: Path) -> None:
    """Of 12 bits in 16, they have to be given their white as well."""
    deep = (LIGHT * 15).astype("<u2")
    for order in "<>":
        np.save(tmp_path / "s.npy", deep.astype(f"{order}u2"))
        np.savez(tmp_path / "s.npz", frames=deep.astype(f"{order}u2"))
        for name in ("s.npy", "s.npz"):
            with pytest.raises(EvflowDataError, match=r"EV003.*full-scale 4095"):
                read(tmp_path / name, fps=30)
            frames = read(tmp_path / name, fps=30, full_scale=4095)[0]
            np.testing.assert_allclose(frames, LIGHT * 15 * 255 / 4095, atol=0.07)
