"""Figures in the documents' tables are those of experiments/results, number by number."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
from helpers.figures import cells, mean, numbers, span, values, wrong

from evflow.network.weights import model_card

Figures = list[float]
ACCURACY = "docs/accuracy.md"


def columns(rows: str, column: str, plus_minus: bool = True) -> Figures:
    """ON and OFF of `evaluate`, mismatches of .03 and .15 and v2e's, with their intervals."""
    found: Figures = []
    for mismatch in ("0.03", "0.15", "0.03 v2e"):
        for k in range(1 + plus_minus):
            found.append(mean("evaluate", rf"{mismatch}\|{rows}", column, k))
    return found


def readme() -> dict[str, Figures]:
    def of(rows: str, column: str) -> Figures:
        return [mean("evaluate", rf"{mismatch}\|{rows}", column) for mismatch in ("0.03", "0.15")]

    return {
        "threshold of the camera": [*of("theta", "refined"), mean(
            "evaluate", r"0.03\|theta", "constant prior")],
        "the same, the paper's": [
            *of("theta", "mae_sequence"), *of("theta", "constant truth"),
            mean("evaluate", r"0.03\|theta", "paper")],
        "threshold of each pixel": [*of("theta", "mae_pixel"), *of("theta", "constant truth")],
        "noise rate that follows θ, Eq. 12": [
            *of("eta", "refined"), mean("evaluate", r"0.03\|eta", "constant prior"),
            mean("evaluate", r"0.03\|eta", "paper")],
        "noise rate independent of θ": [
            mean("evaluate", r"0.03 free noise\|eta", column)
            for column in ("refined", "constant prior")],
        "68 % / 95 % intervals of θ": [*held_of_theta(), *all_cameras()],
    }


def held_of_theta() -> Figures:
    return [end for column in ("within 68", "within 95")
            for end in span("evaluate", r"0.\d+( v2e| free noise)?\|theta", column)]


def all_cameras() -> Figures:
    """Share of the thresholds inside both intervals, by the fusion's cross-validation."""
    found = model_card("default")["fusion"]["figures"]
    return [50.0 * sum(found[f"inside_{share}/theta_{side}"] for side in ("on", "off"))
            for share in (68, 95)]


def evaluate() -> dict[str, Figures]:
    free = [mean("evaluate", r"0.03 free noise\|eta", "refined", k) for k in range(2)]
    return {
        "threshold of the camera, ": [*columns("theta", "refined"), mean(
            "evaluate", r"0.03\|theta", "constant prior")],
        "θ map against the camera's one": [
            *columns("theta", "mae_sequence", plus_minus=False),
            *(mean("evaluate", rf"{m}\|theta", "constant truth") for m in ("0.03", "0.15")),
            mean("evaluate", r"0.03\|theta", "paper")],
        "the same, set network alone": columns("theta", "network", plus_minus=False),
        "noise rate that follows Eq. 12": [*columns("eta", "refined"), mean(
            "evaluate", r"0.03\|eta", "constant prior"), mean("evaluate", r"0.03\|eta", "paper")],
        "noise rate independent of θ": [*free, mean(
            "evaluate", r"0.03 free noise\|eta", "median"), mean(
            "evaluate", r"0.03 free noise\|eta", "constant prior")],
        "θ map against each pixel's own θ": [
            *columns("theta", "mae_pixel", plus_minus=False),
            *(mean("evaluate", rf"{m}\|theta", "constant truth") for m in ("0.03", "0.15")),
            .03, .15],
        "the same, pixels with events": columns("theta", "fired", plus_minus=False),
        "how much better the θ map": columns("theta", "map beats"),
    }


def intervals() -> dict[str, Figures]:
    def of(source: str, *parameters: str) -> Figures:
        return [end for rows in parameters for column in ("in 68", "in 95")
                for end in span(source, rows, column)]

    theta = held_of_theta()
    eta, free = ([end for column in ("within 68", "within 95")
                  for end in span("evaluate", rows, column)]
                 for rows in (r"0.\d+( v2e)?\|eta", r"0.03 free noise\|eta"))
    whole = ("theta_on, summary|theta_off, summary", "eta_on, summary|eta_off, summary",
             "theta_on, pixels|theta_off, pixels", "eta_on, pixels|eta_off, pixels")
    return {
        "1000 cameras of the whole": of("coverage_photos", *whole),
        "the same, grouped": of("coverage_photos", r"theta_\w+, s[ie]", r"eta_\w+, s[ie]"),
        "the same without": of("coverage", *whole[:2]),
        "40 recordings of 2 to 8 s": of("coverage_long", *whole),
        "30 recordings of .2 s": of("coverage_0.2s", *whole),
        "30 recordings of 1 s": of("coverage_1s", *whole),
        "50 recordings of 5 s": of("coverage_5s", *whole),
        "16 recordings of 30 s": of("coverage_30s", *whole),
        "the held-out recordings": [*theta, 12, *eta, *free],  # 12: Eq. 12
    }


def others() -> dict[str, Figures]:
    def of(row: str) -> Figures:
        errors = [values(source, rf"{row}\|theta_{side}", "refined")[0]
                  for source in ("evaluate_other", "evaluate_images") for side in ("on", "off")]
        return [*errors, *(end for column in ("within 68", "within 95")
                           for end in span("evaluate_other", rf"{row}\|theta", column))]

    return {"θ .06–.6": of("other prior"), "pixels of DVS-Voltmeter": of("Voltmeter")}


def true_video() -> dict[str, Figures]:
    ways = (3, 6, 7, 8, 4)  # ours; without fusion on our path, a straight one, a fade; true video

    def errors(rows: str, columns: Sequence[int] = ways) -> Figures:
        return [mean("true_video", rows, column) for column in columns]

    return {"threshold of the camera, mismatch .03": errors(r"0.03\|theta_\w+, all"),
            "the same, recordings of": errors(r"0.03\|theta_\w+, speed 6-inf"),
            "the same with v2e's time slots": errors(r"0.03 v2e\|theta_\w+, all"),
            "the same at mismatch .15": errors(r"0.15\|theta_\w+, all"),
            "thresholds of pixels with events": errors(
                r"0.15\|theta_\w+ of pixels that fired, all"),
            "η independent of θ": errors(r"0.03 free noise\|eta_\w+, all", (3, 4))}


def curves() -> dict[str, Figures]:
    def of(rows: str) -> list[float]:
        return values("curves", rows, "theta, refined")

    events = [of(rf"signal events\|{most}\|")[0]
              for most in (200, 1000, 3000, 10_000, 1_000_000)]
    return {"mean error of θ |": events, "frame interval": [5, 100, *sorted(
        (max(of("frame interval")), min(of("frame interval"))), reverse=True)],
        "duration": [50, 800, *sorted(
            (max(of("duration")), min(of("duration"))), reverse=True)]}


def one_polarity() -> dict[str, Figures]:
    cases = {"brightness only rises": "brighter", "brightness only falls": "darker",
             "OFF thresholds that no": "OFF unreached", "OFF events left out": "OFF left out"}
    wanted = ((3, 0), (5, 0), (5, 1), (7, 0), (8, 0), (8, 1))
    return {label: [values("one_polarity", rf"{rows}\|", *at)[0] for at in wanted]
            for label, rows in cases.items()}


def noise_rates() -> dict[str, Figures]:
    def of(scene: str, *systems: str) -> Figures:
        return [values("noise_rates", rf"eq12\|{scene} .*?\|{system}\|", column)[0]
                for system in systems for column in (3, 4)]

    return {"flat field": of("flat", "ours"), "texture at rest": of("still", "ours"),
            "moving disc |": of("moving", "ours", "v2e", "counting")}


def real_recordings() -> dict[str, Figures]:
    rows = {"DAVIS346, Newton's cradle": "newton", "DAVIS240C, slider_depth": "ijrr"}

    def of(name: str, pixel: str) -> Figures:
        found = [cells("real_recordings", rf"{name}.*?\|{pixel}\|", column)[0] for column in (
            "θ ON", "light", "r of", "r in", "events", "explained")]
        return [float(number) for cell in found for number in numbers(cell)]

    return {f"{label}, {pixel} ": of(name, pixel)
            for label, name in rows.items() for pixel in ("measured", "ideal", "maps alone")}


def compare_systems() -> dict[str, Figures]:
    names = {"`estimate_camera` |": "ours", "simulating the scene": "match", "JAER": "jaer",
             "the same with the true": "match, true video", "least squares (ECC)": "ecc median",
             "ECC as": "ecc", "LGAN": "lgan", "S2R |": "s2r", "S2R with": "s2r same, per polarity"}
    wanted = [rf"{mismatch}, {length} s" for length in (r"\.2", "1") for mismatch in (.03, .15)]
    return {label: [values("compare_systems", rf"{length} \(\d+\)\|{system}\|", column)[0]
                    for length in wanted for column in (2, 3)] for label, system in names.items()}


def sequences() -> dict[str, Figures]:
    def of(length: str, *columns: int) -> Figures:
        return [values("compare_systems", rf"0.15, {length} s \(30\)\|{system}\|", column)[0]
                for system in ("ours", "match") for column in columns]

    return {"`mae_sequence`, .2 s": of(r"\.2", 4, 5), "`mae_sequence`, 1 s": of("1", 4, 5),
            "`mae_pixel`": of(r"\.2", 6, 7)}


def ablations() -> dict[str, Figures]:
    return {label: [values("ablate_networks", rf"{name}\|", f"{of}, sequence", k)[0]
                    for of in ("theta", "eta") for k in range(2)]
            for label, name in (("a constant", "constant"), ("`paper`", "paper"),
                                ("`default`", "default"))}


def generate() -> dict[str, Figures]:
    whole = r"(as it is|halved|doubled|(ON|OFF) (halved|doubled))\|"

    def ends(rows: str, *columns: int) -> Figures:
        found = [v for column in columns for v in values("generate", rows, column)]
        return sorted({min(found), max(found)})

    every = rf"({whole}|single)"
    return {"events relative to the simulator": ends(whole, 1, 2),
            "the same, thresholds of single pixels halved": ends("single pixels halved", 1, 2),
            "the same, thresholds of single pixels doubled": ends("single pixels doubled", 1, 2),
            "correlation with a simulation": [*ends(every, 6), *ends(".*from the first", 6)]}


def changes() -> dict[str, Figures]:
    def of(rows: str, *titles: str) -> Figures:
        return [values("changes", rf"{rows}\|", "MAE, log units", 0, title)[0] for title in titles]

    middle = ("ijrr_slider_depth, up to the held-out", "newton_cradle_davis346, up to the held-out")
    names = {"encoder |": "encoder", "Kalman": "AKF", "integration": "integration",
             "complementary": "complementary", "frames alone": "frames alone"}
    return {label: of(rows, *middle) for label, rows in names.items()}


def video() -> dict[str, Figures]:
    names = {"default parameters": "default", "thresholds uniform": "wide",
             "thresholds log-uniform": "wide-log", "estimate": "evflow", "truth": "oracle",
             "LGAN": "lgan", "ECC median": "ecc median", "count matching": "match", "S2R": "s2r",
             "JAER": "jaer"}

    def of(name: str) -> Figures:
        gain = [] if name == "default" else [
            values("see_better", rf"SSIM\|{name} \(3\)", "to default", k)[0] for k in range(2)]
        return [*([0.0] if name == "default" else gain), *(
            values("see_better", rf"{measure}\|{name} \(3\)", column)[0]
            for measure, column in (("LPIPS", 2), ("MSE", 2)))]

    return {label: of(name) for label, name in names.items()}


def other_cameras() -> dict[str, Figures]:
    names = {"default parameters": "default", "thresholds uniform": "wide", "estimate": "evflow",
             "truth": "oracle", "LGAN": "lgan"}

    def of(name: str, target: str) -> Figures:
        at = "see_better_cameras"
        gain = [0.0] if name == "default" else [
            values(at, rf"SSIM\|{name} \(3\)", "to default", k, target)[0] for k in range(2)]
        return gain + [values(at, rf"{measure}\|{name} \(3\)", "mean", 0, target)[0]
                       for measure in ("LPIPS", "MSE")]

    return {label: [*of(name, "middle noisy"), *of(name, "low noisy")]
            for label, name in names.items()}


def longer() -> dict[str, Figures]:
    files = {"default parameters": ("default", ""), "estimate": ("evflow", ""),
             "truth": ("oracle", ""), "LGAN": ("lgan", ""),
             "thresholds uniform": ("wide", "_wide")}

    def of(name: str, file: str) -> Figures:
        at, row = f"see_better_long{file}", rf"{name} \(3\)"
        gain = [0.0] if name == "default" else [
            values(at, rf"SSIM\|{row}", "to default", k)[0] for k in range(2)]
        return [*gain, *(values(at, rf"{measure}\|{row}", "mean")[0]
                         for measure in ("LPIPS", "MSE"))]

    return {label: of(*file) for label, file in files.items()}


def circuit() -> dict[str, Figures]:
    names = {"default parameters": "default", "estimate |": "evflow",
             "estimate, with": r"evflow\+circuit", "truth |": "oracle",
             "truth, with": r"oracle\+circuit"}

    def of(name: str) -> Figures:
        gain = [0.0] if name == "default" else [
            values("see_better_circuit", rf"SSIM\|{name} \(3\)", "to default", k)[0]
            for k in range(2)]
        return [*gain, *(values("see_better_circuit", rf"{measure}\|{name} \(3\)", "mean")[0]
                         for measure in ("LPIPS", "MSE"))]

    return {label: of(name) for label, name in names.items()}


def recorded_video() -> dict[str, Figures]:
    names = {"thresholds log-uniform": "wide-log", "estimate, maps": "evflow",
             "estimate, with": r"evflow\+circuit", "LGAN": "lgan"}
    return {label: [values("see_better_recordings", rf"{measure}\|{name} \(3\)", "to default", k,
                           target)[0]
                    for target in ("slider_depth", "cradle") for measure in ("SSIM", "LPIPS", "MSE")
                    for k in range(2)] for label, name in names.items()}


def flow() -> dict[str, Figures]:
    names = {"thresholds uniform": "wide", "thresholds log-uniform": "wide-log",
             "estimate": "evflow", "truth": "oracle", "LGAN": "lgan", "the camera's own": "raw"}
    return {label: [values("see_better_flow", rf"AEE \[px\]\|{name} \(3\)", *at)[0]
                    for at in ((2, 0), (3, 0), (3, 1))] for label, name in names.items()}


def flow_of(source: str, measure: str, names: dict[str, str], *targets: str) -> dict[str, Figures]:
    """For each target the mean, and the difference from default parameters with its interval."""
    def of(name: str, target: str) -> Figures:
        row = rf"{measure}\|{name} \(3\)"
        return [values(source, row, "mean", 0, target)[0], *([0.0] if name == "default" else (
            values(source, row, "to default", k, target)[0] for k in range(2)))]

    return {label: [figure for target in targets for figure in of(name, target)]
            for label, name in names.items()}


def other_flow() -> dict[str, Figures]:
    names = {"default parameters": "default", "thresholds uniform": "wide", "estimate": "evflow",
             "truth": "oracle", "LGAN": "lgan"}
    return flow_of("see_better_flow_cameras", r"AEE \[px\]", names, "middle noisy", "low noisy")


def recorded_flow() -> dict[str, Figures]:
    names = {"default parameters": "default", "thresholds log-uniform": "wide-log",
             "estimate, with": r"evflow\+circuit"}
    return flow_of("see_better_flow_recordings", "FWL", names, "slider_depth", "cradle")


def eventgan() -> dict[str, Figures]:
    def of(source: str, measure: str, column: str, without: str) -> Figures:
        return [*(values(source, rf"{measure}\|{name} \(3\)", "mean")[0]
                  for name in ("eventgan", "default", "oracle")),
                values(source, without, column)[0]]

    return {"SSIM": of("see_better_eventgan", "SSIM", "SSIM", "even grey"),
            "LPIPS": of("see_better_eventgan", "LPIPS", "LPIPS", "even grey"),
            "AEE": of("see_better_flow_eventgan", r"AEE \[px\]", "AEE", "no flow"),
            "FWL": of("see_better_flow_eventgan", "FWL", "FWL", "no flow"),
            "correlation": values("eventgan", "6000", "correlation")}


def losses() -> dict[str, Figures]:
    rows = {"L_P |": ("L_P", 8), "L_P + L_F": (r"L_P \+ L_F \+ L_F'", 12),
            "L_P + L_E": (r"L_P \+ L_E", 16), "all |": (r"L_P \+ L_F \+ L_F' \+ L_E", 20),
            "all, weights": ("the same, weights adapted", 24)}

    def gain(source: str, name: str) -> Figures:
        return [values(source, rf"{measure}\|{name} \(3\)", "to default", k)[0]
                for measure in ("SSIM", "MSE") for k in range(2)]

    return {label: [*gain("see_better_losses", name), steps,
                    *gain("see_better_steps", f"{steps} steps")]
            for label, (name, steps) in rows.items()}


def cradle() -> dict[str, Figures]:
    names = {"no events": "no events", ".2 everywhere": "default .2", "ECC median": "ecc median",
             "ECC with an offset": "ecc offset 40", "JAER": "jaer",
             "`estimate_camera`, summary": "ours, summary", "`estimate_camera`, maps": "ours, maps"}
    found = {label: values("integrate", rf"{name}\|", "RMSE", 0, "newton_cradle")
             for label, name in names.items()}
    return found | {"LGAN": values("integrate_lgan", r"lgan\|", "RMSE", 0, "newton_cradle")}


def sizes() -> dict[str, Figures]:
    names = {"`estimate_camera`, maps": "ours, maps", "true maps": "true, maps",
             "true medians": "true, nominal"}
    return {label: [values("integrate", rf"{name}\|", "RMSE", 0, f"simulated {size}")[k]
                    for size in ("240x180", "346x260", "640x480") for k in range(2)]
            for label, name in names.items()}


TABLES: dict[tuple[str, str], Callable[[], dict[str, Figures]]] = {
    ("README.md", "## Accuracy"): readme,
    (ACCURACY, "## `estimate_camera` on held-out"): evaluate,
    (ACCURACY, "### Intervals"): intervals,
    (ACCURACY, "### Other cameras and other scenes"): others,
    (ACCURACY, "### What the frames cost"): true_video,
    (ACCURACY, "### How the error falls"): curves,
    (ACCURACY, "### When one polarity"): one_polarity,
    (ACCURACY, "### Noise rates"): noise_rates,
    (ACCURACY, "### Real recordings"): real_recordings,
    (ACCURACY, "beside the compared systems"): compare_systems,
    (ACCURACY, "That measure asks for a map"): sequences,
    (ACCURACY, "### Ablations"): ablations,
    (ACCURACY, "### The inverse direction"): generate,
    (ACCURACY, "The middle one of three frames"): changes,
    (ACCURACY, "### Video"): video,
    (ACCURACY, "oracle oracle+circuit"): circuit,
    (ACCURACY, "### Video of two other cameras"): other_cameras,
    (ACCURACY, "### Longer trainings"): longer,
    (ACCURACY, "### Video of real recordings"): recorded_video,
    (ACCURACY, "### Flow of real recordings"): recorded_flow,
    (ACCURACY, "### Flow of two other cameras"): other_flow,
    (ACCURACY, "### Flow"): flow,
    (ACCURACY, "### EventGAN"): eventgan,
    (ACCURACY, "### Losses and flow steps"): losses,
    (ACCURACY, "A Newton's cradle, thresholds from"): cradle,
    (ACCURACY, "Simulated cameras, five of each size"): sizes,
}


@pytest.mark.parametrize(("where", "figures"), TABLES.items(), ids=[str(k[1]) for k in TABLES])
def test_a_table_says_what_its_experiment_found(
    where: tuple[str, str], figures: Callable[[], dict[str, Figures]]
) -> None:
    assert not wrong(*where, figures())
