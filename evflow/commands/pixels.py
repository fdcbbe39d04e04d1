"""Options on the simulated camera: a measured camera or a known sensor, its circuit, thresholds and
noise."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from evflow.commands.options import refuse, value, warn_of_prior
from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    from evflow.camera import Camera
    from evflow.camera.optics import Optics
    from evflow.camera.sensors import SensorModel
    from evflow.simulator.photoreceptor import Photoreceptor

THRESHOLDS = ("theta_on", "theta_off", "mismatch", "eta_on", "eta_off")
CIRCUIT = ("cutoff_hz", "refractory_s", "leak_hz", "leak_jitter", "leak_fpn_decades", "shot_hz")
MOST_THETA = 2.0  # log units; no sensor has a median above
BEYOND_CONTRAST = 20.0  # log units
CHOICES = ("cutoff_by_light", "noise_resets_memory")
MISMATCH = 1000  # folded into the seed's key; the simulation splits that same key into 0, 1, 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pixels:
    """Options on the camera, inherited by commands that simulate."""

    camera: Annotated[Path | None, value("FILE")] = None
    """camera.npz from evflow estimate, with its cutoff, dead time, leak and shot noise and, if
    VIDEO is a recording, the light that its frames lack; by default the thresholds below, or the
    sensor's own."""
    draw: bool = False
    """Draw the camera's pixels from their estimates and errors, which makes them as uneven as the
    real ones; the most likely values are too uniform. The error that all pixels share is drawn once
    for each map: with another --seed, the whole camera differs by as much."""
    sensor: Literal["clean", "noisy", "v2e", "esim", "dvs346", "dvs240", "paper"] = "clean"
    """Pixel circuit. clean, noisy: v2e's presets; v2e: its defaults; esim; dvs346, dvs240:
    DVS-Voltmeter's; paper: the paper's. The options below change parts of it. With --camera, clean
    is the measured circuit; any other replaces it, and its noise, if it has some, comes on top of
    the camera's."""
    theta_on: Annotated[float | None, value("THETA")] = None
    """ON threshold of every pixel (natural log); by default the sensor's, with its mismatch."""
    theta_off: Annotated[float | None, value("THETA")] = None
    """OFF threshold of every pixel."""
    mismatch: Annotated[float | None, value("SIGMA")] = None
    """Standard deviation of both thresholds over pixels; v2e's default is .03."""
    eta_on: Annotated[float | None, value("HZ")] = None
    """ON noise events per second and pixel, added to the sensor's own."""
    eta_off: Annotated[float | None, value("HZ")] = None
    """The same, OFF."""
    cutoff_hz: Annotated[float | None, value("HZ", "--cutoff")] = None
    """Corner frequency of the photoreceptor's low-pass at white; 0: none."""
    cutoff_by_light: bool = True
    """The corner is proportional to intensity, as in v2e; otherwise it is the same at any light."""
    photoreceptor: Literal["first-order", "second-order"] = "first-order"
    """How the photoreceptor follows light: v2e's low-pass, or that of Deblur e-NeRF, which may ring
    in bright light, with a source follower and an amplifier that events reset. Its corner in the
    dark is --cutoff-hz, or the camera's, or 199 Hz."""
    refractory_s: Annotated[float | None, value("SECONDS", "--refractory")] = None
    """Time after an event of light or leak during which a pixel sends no other (v2e: .0005); noise
    events ignore it."""
    dead_contrast: Literal["auto", "keeps", "drops", "resets"] = "auto"
    """What becomes of contrast that changes in that time. keeps: it fires later (v2e); drops:
    events that fall into it are lost (ESIM); resets: the pixel begins anew at its end. auto: as
    measured with --camera, else the sensor's own; clean and noisy keep it."""
    leak_hz: Annotated[float | None, value("HZ", "--leak")] = None
    """ON leak events per second and pixel, without light changes; for a measured camera they come
    on top of all its noise."""
    leak_jitter: Annotated[float | None, value("SHARE")] = None
    """Relative jitter of the leak (v2e: .1)."""
    leak_fpn_decades: Annotated[float | None, value("DECADES")] = None
    """Spread of the leak over pixels (v2e: .1)."""
    shot_hz: Annotated[float | None, value("HZ", "--shot")] = None
    """Shot noise of v2e's pixel in the dark, both polarities together; a quarter of it at white."""
    noise_resets_memory: bool = True
    """A noise event resets the pixel's memory to the present intensity, as in real pixels (and in
    v2e's sensors)."""
    seed: int = 0
    """Seed of noise and of drawn parameters: the same seed gives the same events."""

    def model(self) -> SensorModel:
        """The pixels' circuit; EV020 if it has no such part."""
        from evflow.camera.sensors import SENSORS, WITHOUT, known_sensor
        from evflow.simulator.photoreceptor import as_measured

        model = (as_measured(*self._circuit())[1] if self._is_measured
                 else known_sensor(self.sensor).model)
        if self._is_measured and (self.leak_hz, self.shot_hz) != (None, None):
            model = dataclasses.replace(model, leak_hz=0.0, shot_hz=0.0, eta_is_all=False)
        given: dict[str, Any] = {name: number for name in CIRCUIT
                                if (number := getattr(self, name)) is not None}
        if model.kind == "v2e":
            given |= {name: getattr(self, name) for name in CHOICES}
        else:
            refuse(self, CHOICES, f"--sensor {self.sensor} has no such choice")
        lacking = [name for name in WITHOUT[model.kind] if given.get(name)]
        have = [name for name, sensor in SENSORS.items()
                if not set(lacking) & set(WITHOUT[sensor.model.kind])]
        refuse(self, lacking, f"--sensor {self.sensor} has no such part; "
               f"{', '.join(have[:-1])} and {have[-1]} do")
        if self.dead_contrast != "auto":
            if model.kind != "v2e" or model.timestamps != "crossing":
                refuse(self, ("dead_contrast",), f"--sensor {self.sensor} has no such choice")
            given["dead_contrast"] = self.dead_contrast
        model = dataclasses.replace(model, **given)
        if not model.refractory_s:
            refuse(self, ("dead_contrast",), "there is no dead time without --refractory-s")
        if not model.leak_hz:
            refuse(self, ("leak_jitter", "leak_fpn_decades"), "there is no leak without --leak-hz")
        if not model.cutoff_hz and self.photoreceptor == "first-order":
            refuse(self, ("cutoff_by_light",), "the camera's own cutoff keeps its measured law"
                   if self._circuit()[0].cutoff_hz and self.cutoff_hz is None else
                   "there is no cutoff without --cutoff-hz")
        return model if self.photoreceptor == "first-order" else self._second_order(model)

    def _second_order(self, model: SensorModel) -> SensorModel:
        from evflow.camera.sensors import SecondOrder

        refuse(self, ("cutoff_by_light",), "a second-order photoreceptor always depends on light")
        if self.dead_contrast != "resets":
            refuse(self, ("dead_contrast",), "a second-order pixel begins anew after its dead time")
        if self.cutoff_hz == 0:
            raise EvflowDataError("EV020", "--photoreceptor second-order and --cutoff-hz 0.",
                                  "Give the corner frequency in the dark, or leave it out.")
        cutoff_hz = model.cutoff_hz or self._circuit()[0].cutoff_hz
        receptor = SecondOrder().at(cutoff_hz) if cutoff_hz else SecondOrder()
        return dataclasses.replace(
            model, cutoff_hz=0.0, photoreceptor=receptor, dead_contrast="auto")

    def seen_by(self, recorded: bool) -> Photoreceptor:
        """The measured camera's photoreceptor, unless options choose another; its light and clock
        are used only for frames that the camera recorded with its events."""
        from evflow.camera.optics import Optics
        from evflow.simulator.photoreceptor import Photoreceptor

        sensor, optics = self._circuit()
        if self.cutoff_hz is not None or self.photoreceptor != "first-order":
            sensor = dataclasses.replace(sensor, cutoff_hz=0.0)
        return Photoreceptor.of(sensor, optics if recorded else Optics())

    def exposure_seen_ms(self, recorded: bool) -> float:
        """Exposure of frames that the measured camera recorded with its events, as its estimate saw
        it; 0 where it saw none, and for other frames."""
        return 1e3 * self._circuit()[1].exposure_s if recorded else 0.0

    def _circuit(self) -> tuple[SensorModel, Optics]:
        """The measured camera's circuit; ideal without a camera, or with another sensor."""
        from evflow.camera.optics import Optics, read_sensor
        from evflow.camera.sensors import SensorModel

        if self.camera is None or not self._is_measured:
            return SensorModel(), Optics()
        return read_sensor(self.camera)

    @property
    def _is_measured(self) -> bool:
        """Whether the circuit is that of --camera."""
        return self.camera is not None and self.sensor == "clean"

    def pixels(self, size: tuple[int, int]) -> Camera:
        """The camera to simulate; EV015 if its size is not (width, height) of the video."""
        if self.draw and not self.camera:
            raise EvflowDataError("EV020", "--draw without --camera.",
                                  "It draws the pixels of a measured camera.")
        camera = self._measured(self.camera) if self.camera else self._drawn((size[1], size[0]))
        if len(camera.shape) > 2:
            raise EvflowDataError(
                "EV002", f"{self.camera} holds maps of shape {camera.shape}.",
                "Save one camera, of maps (H, W): jax.tree.map(lambda m: m[0], camera).save(path).")
        if camera.shape != size[::-1]:
            width, height = camera.shape[::-1]
            turned = ("Were its maps saved as (W, H)? Transpose them. Else pass" if
                      camera.shape == size and width != height else "Pass")
            raise EvflowDataError(
                "EV015", f"the video is {size[0]}x{size[1]}, the camera {width}x{height}.",
                f"{turned} --sensor-size {width}x{height} to scale and crop the video.")
        _doubt(camera)
        return camera

    def _measured(self, path: Path) -> Camera:
        import jax

        from evflow.camera import Camera
        from evflow.camera.optics import read_shared, read_undetermined

        refuse(self, THRESHOLDS, "--camera has its own")
        if self.sensor != "clean":
            print(f"note: {self._replaced(path)}", file=sys.stderr)
        camera, std = Camera.load_with_std(path)
        warn_of_prior(read_undetermined(path), "simulated")
        if self.draw:
            if std is None:
                raise EvflowDataError("EV020", f"{path} holds no standard deviations.",
                                      "--draw needs the camera.npz of evflow estimate.")
            camera = camera.drawn(jax.random.key(self.seed), std, read_shared(path))
        return camera

    def _replaced(self, path: Path) -> str:
        """What a sensor other than the measured one takes from the camera at `path`, and keeps."""
        from evflow.camera.optics import LOSS_WORDS, read_sensor

        (measured, optics), theirs = read_sensor(path), self.model()
        parts = [f"cutoff {measured.cutoff_hz:.0f} Hz"] * bool(measured.cutoff_hz)
        parts += [f"dead time {1e3 * measured.refractory_s:.2f} ms"
                  f"{LOSS_WORDS[measured.in_dead_time]}"] * bool(measured.refractory_s)
        parts += [f"{optics.offset_dn:+.1f} DN of light"] * bool(optics.offset_dn)
        lost = (f"Its measured circuit ({', '.join(parts)}) is replaced by" if parts else
                "The circuit is")
        own = ("whose own noise comes on top" if theirs.kind == "voltmeter" else
               "whose leak and shot noise come on top" if theirs.leak_hz or theirs.shot_hz else
               "which adds no noise")
        return (f"the thresholds and noise rates of every pixel are the camera's. {lost} that of "
                f"--sensor {self.sensor}, {own}.")

    def _drawn(self, shape: tuple[int, int]) -> Camera:
        """The sensor's thresholds with its mismatch; given thresholds are the same at every pixel,
        unless --mismatch is given."""
        import jax
        import jax.numpy as jnp

        from evflow.camera import PARAMETERS, Camera, CameraPrior
        from evflow.camera.camera import sample_pixels
        from evflow.camera.prior import Summary
        from evflow.camera.sensors import known_sensor

        key, known = jax.random.key(self.seed), known_sensor(self.sensor)
        given: dict[str, float] = {
            name: number for name in PARAMETERS if (number := getattr(self, name)) is not None}
        even = {name: jnp.full(shape, number, jnp.float32) for name, number in given.items()}
        if self.mismatch is None:
            drawn = Camera.sample(key, shape, CameraPrior(
                (known.theta,) * 2, (known.mismatch,) * 2, noise="none"))
            return dataclasses.replace(drawn, **even).validate()
        if not self.mismatch >= 0:
            raise EvflowDataError("EV020", f"--mismatch {self.mismatch}.", "It must be >= 0.")
        Camera.constant((1, 1), **given)  # raises EV014 for the values themselves
        values = {"theta_on": known.theta, "theta_off": known.theta, "eta_on": 0.0, "eta_off": 0.0,
                  **given, "sigma_on": self.mismatch, "sigma_off": self.mismatch}
        nominal = Summary(**{name: jnp.float32(number) for name, number in values.items()})
        # Thresholds of the simulation's own key would be its leak pattern and its noise again.
        return sample_pixels(jax.random.fold_in(key, MISMATCH), nominal, shape).validate()


def _doubt(camera: Camera) -> None:
    """Warn on stderr of thresholds that no sensor has."""
    theta = float(max(np.median(camera.theta_on), np.median(camera.theta_off)))
    if theta > MOST_THETA:
        contrast = 100 * np.expm1(min(theta, BEYOND_CONTRAST))
        print(f"warning: a threshold of {theta:.3g} log units is {contrast:,.0f} % of contrast"
              f"{' and more' * (theta > BEYOND_CONTRAST)}: was it given in percent? 20 % is "
              "log(1.2) = 0.18.", file=sys.stderr)
