"""Procedural textures and cut-out masks: pure functions of a key, on the device.

Every texture is a float32 square in [0, 1], stretched to its 0.5 and 99.5 percentiles and then
blurred by 0.7 texels, so that bilinear sampling at sub-texel steps moves it smoothly: at the
highest frequency 18 % of the amplitude is left, and at most 55 % of what aliases where two
texels fall on a pixel. Masks are star-convex shapes with an edge one texel wide.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp

Array = jax.Array

BLUR_TEXELS = 0.7
_LEAVES, _SITES, _HARMONICS = 80, 64, 6


def sample_texture(key: Array, size: int) -> Array:
    """One texture (size, size) in [0, 1] of a random kind.

    Draw many with `lax.map`, which computes only the kind drawn; `vmap` would compute all six.
    """
    k_kind, k_texture, k_detail = jax.random.split(key, 3)
    kind, weight = _uniform(k_kind, (2,))
    branches = [functools.partial(texture, size=size) for texture, _ in _KINDS]
    limits = jnp.cumsum(jnp.array([share for _, share in _KINDS[:-1]], jnp.float32))
    base = jax.lax.switch(jnp.sum(kind >= limits), branches, k_texture)
    # Half of the textures carry fine structure on their surfaces, as real ones do.
    weight = 0.6 * jnp.maximum(weight - 0.5, 0.0)
    return finish(base + weight * _fractal(k_detail, size, (0.6, 1.4)))


def finish(image: Array) -> Array:
    """Stretch `image` (S, S) to [0, 1] and band-limit it by `BLUR_TEXELS`.

    The stretch is at most fivefold: a nearly uniform picture stays so, instead of showing its
    compression noise.
    """
    low, high = jnp.percentile(image, jnp.array([0.5, 99.5], image.dtype))
    stretched = (image - (low + high) / 2) / jnp.maximum(high - low, 0.2) + 0.5
    return _blur(jnp.clip(stretched, 0.0, 1.0))


def noise(key: Array, size: int) -> Array:
    """1/f^a noise: a in [0.8, 2] (natural images are near 1), stretched along a random axis."""
    return _fractal(key, size, (0.8, 2.0))


def blobs(key: Array, size: int) -> Array:
    """Two-tone shapes: noise cut at a random level, with edges from hard to soft."""
    k_noise, k_cut = jax.random.split(key)
    level, softness = _uniform(k_cut, (2,))
    image = _fractal(k_noise, size, (1.4, 2.4))
    return jax.nn.sigmoid((image - 1.6 * (level - 0.5)) * 10 ** (2.0 - 1.5 * softness))


def waves(key: Array, size: int) -> Array:
    """A grating or a checkerboard of random orientation, period (6 to 48 texels) and hardness."""
    angle, period_u, period_v, phase_u, phase_v, hard, check = _uniform(key, (7,))
    u, v = _rotated_grid(size, math.pi * angle)
    hardness = 20.0 ** hard
    first = jnp.tanh(hardness * jnp.sin(2 * math.pi * (u / (6 * 8.0 ** period_u) + phase_u)))
    second = jnp.tanh(hardness * jnp.sin(2 * math.pi * (v / (6 * 8.0 ** period_v) + phase_v)))
    return jnp.where(check < 0.5, first, first * second) / 2


def cells(key: Array, size: int) -> Array:
    """Voronoi cells of 8 to 64 random sites, each of one value."""
    draws = _uniform(key, (4, _SITES))
    x, y = _rotated_grid(size, jnp.float32(0.0))
    unused = jnp.where(jnp.arange(_SITES) < 8.0 * 8.0 ** draws[3, 0], 0.0, jnp.inf)

    def claim(nearest: tuple[Array, Array], site: tuple[Array, ...]) -> tuple[tuple, None]:
        px, py, tone, penalty = site
        away = (x - size * (px - 0.5)) ** 2 + (y - size * (py - 0.5)) ** 2 + penalty
        closer = away < nearest[0]
        return (jnp.where(closer, away, nearest[0]), jnp.where(closer, tone, nearest[1])), None

    start = (jnp.full_like(x, jnp.inf), jnp.zeros_like(x))
    return jax.lax.scan(claim, start, (*draws[:3], unused))[0][1]


def leaves(key: Array, size: int) -> Array:
    """Dead leaves: ellipses and rectangles, many small and few large, laid over one another.

    Occlusion and a power law of sizes give the edges and the spectrum of natural images.
    """
    px, py, width, height, turn, tone, box = _uniform(key, (7, _LEAVES))
    # Half-axes from 1.5 texels to 0.35 of the square, of density ~ r^-1/2; large leaves shrink
    # in the order of laying, so that they lie below.
    depth = jnp.linspace(1.0, 0.3, _LEAVES, dtype=jnp.float32)
    largest = 0.35 * size * depth
    half_axes = 1.5 + largest * width ** 2, 1.5 + largest * height ** 2
    x, y = _rotated_grid(size, jnp.float32(0.0))

    def lay(image: Array, leaf: tuple[Array, ...]) -> tuple[Array, None]:
        px, py, a, b, turn, tone, box = leaf
        dx, dy = x - size * (px - 0.5), y - size * (py - 0.5)
        c, s = jnp.cos(math.pi * turn), jnp.sin(math.pi * turn)
        u, v = jnp.abs(c * dx + s * dy) / a, jnp.abs(c * dy - s * dx) / b
        level = jnp.where(box < 0.5, jnp.maximum(u, v), jnp.hypot(u, v))
        cover = jnp.clip(0.5 + (1.0 - level) * jnp.minimum(a, b), 0.0, 1.0)
        return image + cover * (tone - image), None

    start = jnp.full((size, size), 0.5, jnp.float32)
    return jax.lax.scan(lay, start, (px, py, *half_axes, turn, tone, box))[0]


def gradient(key: Array, size: int) -> Array:
    """A smooth shading: a ramp, a bowl and a slow wave of random weights."""
    angle, px, py, phase, ramp, bowl, wave = 2 * _uniform(key, (7,)) - 1
    along, across = _rotated_grid(size, math.pi * angle)
    u, v = along * (2 / size), across * (2 / size)
    hollow = (u - 0.7 * px) ** 2 + (v - 0.7 * py) ** 2
    return ramp * u + bowl * hollow + 0.5 * wave * jnp.sin(4 * v + math.pi * phase)


# How often each kind is drawn: more of those whose statistics are nearest to photographs.
_KINDS = ((noise, 0.25), (blobs, 0.15), (waves, 0.1), (cells, 0.15), (leaves, 0.25),
          (gradient, 0.1))


def cutout_mask(key: Array, size: int) -> tuple[Array, Array]:
    """A mask alpha (size, size) in [0, 1] and its diameter (the largest extent), in texels.

    Diameters are log-uniform in [.25, .9] of `size`; the border of the mask is 0 everywhere.
    """
    kind, extent, turn, *shape = _uniform(key, (3 + 2 * _HARMONICS,))
    diameter = 0.25 * size * 3.6 ** extent
    x, y = _rotated_grid(size, 2 * math.pi * turn)
    phi = jnp.arctan2(y, x)
    outlines = (_blob_outline, _polygon_outline, _ellipse_outline)
    outline = jax.lax.switch((3 * kind).astype(jnp.int32), outlines, jnp.stack(shape), phi)
    outline = outline / jnp.max(outline)
    level = diameter / 2 * outline - jnp.hypot(x, y)
    # level / |grad level| is the distance to the edge to first order: the ramp is one texel
    # wide even where the outline runs steeply towards the centre.
    gy, gx = jnp.gradient(level)
    slope = jnp.maximum(jnp.hypot(gx, gy), 0.5)
    alpha = jnp.clip(0.5 + level / slope, 0.0, 1.0)
    return jnp.pad(alpha[1:-1, 1:-1], 1), diameter


def _blob_outline(units: Array, phi: Array) -> Array:
    """Radius over angle: 1 + a few harmonics, each weaker than the one before."""
    sizes, phases = units.reshape(2, _HARMONICS)
    outline = jnp.ones_like(phi)
    for k in range(_HARMONICS):
        size = 1.5 * (sizes[k] - 0.5) / (k + 2)
        outline += size * jnp.cos((k + 2) * phi + 2 * math.pi * phases[k])
    return jnp.maximum(outline, 0.25)


def _polygon_outline(units: Array, phi: Array) -> Array:
    """A polygon of 3 to 8 corners whose sides' middles are pushed in (a star) or slightly out,
    squeezed by up to 1/2."""
    corners = 3.0 + jnp.floor(6.0 * units[0])
    side = 2 * math.pi / corners
    offset = phi - side * jnp.round(phi / side)  # angle from the nearest corner
    straight = jnp.cos(side / 2) / jnp.cos(side / 2 - jnp.abs(offset))
    push = (0.5 * units[1] - 0.4) * 2 * jnp.abs(offset) / side
    return straight * (1 + push) / jnp.hypot(jnp.cos(phi), jnp.sin(phi) * 2.0 ** units[2])


def _ellipse_outline(units: Array, phi: Array) -> Array:
    """An ellipse of axis ratio 1 down to 1/4."""
    return 1.0 / jnp.hypot(jnp.cos(phi), jnp.sin(phi) * 4.0 ** units[0])


def _rotated_grid(size: int, angle: Array) -> tuple[Array, Array]:
    """Texel coordinates (x, y), centred, turned by `angle`; each (size, size)."""
    axis = jnp.arange(size, dtype=jnp.float32) - (size - 1) / 2
    y, x = jnp.meshgrid(axis, axis, indexing="ij")
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x + s * y, c * y - s * x


def _uniform(key: Array, shape: tuple[int, ...]) -> Array:
    """Draws in [0, 1), float32 under x64 as well."""
    return jax.random.uniform(key, shape, jnp.float32)


def _fractal(key: Array, size: int, exponents: tuple[float, float]) -> Array:
    """Noise of amplitude spectrum 1/f^a, zero mean, unit deviation; a uniform in `exponents`."""
    k_white, k_look = jax.random.split(key)
    steepness, angle, stretch = _uniform(k_look, (3,))
    exponent = exponents[0] + (exponents[1] - exponents[0]) * steepness
    stretch = 3.0 ** stretch
    fy = jnp.fft.fftfreq(size, dtype=jnp.float32)[:, None]
    fx = jnp.fft.rfftfreq(size, dtype=jnp.float32)[None, :]
    c, s = jnp.cos(math.pi * angle), jnp.sin(math.pi * angle)
    f = jnp.hypot((c * fx + s * fy) * stretch, (c * fy - s * fx) / stretch)
    spectrum = jnp.where(f > 0, jnp.maximum(f, 1e-6) ** -exponent, 0.0)
    white = jax.random.normal(k_white, (size, size), jnp.float32)
    image = jnp.fft.irfft2(jnp.fft.rfft2(white) * spectrum, (size, size))
    return image / jnp.std(image)


def _blur(image: Array) -> Array:
    """Gaussian blur by `BLUR_TEXELS`, reflecting at the borders; weights sum to 1."""
    radius = math.ceil(3.5 * BLUR_TEXELS)
    taps = [math.exp(-0.5 * (k / BLUR_TEXELS) ** 2) for k in range(-radius, radius + 1)]
    size = image.shape[0]
    for axis in (0, 1):
        widths = [(radius, radius) if a == axis else (0, 0) for a in (0, 1)]
        padded = jnp.pad(image, widths, mode="reflect")
        slices = [jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(len(taps))]
        weighted = [t / sum(taps) * s for t, s in zip(taps, slices, strict=True)]
        image = functools.reduce(jnp.add, weighted)
    return image
