"""docs/paper.md: the paper's figures as it prints them, ours as experiments/results has them."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from helpers.figures import cells, numbers, values, wrong

Figures = list[float]

def table_two() -> dict[str, Figures]:
    def of(which: str) -> list[Figures]:
        return [values("noise", "0", column, 0, which) for column in (which, 2, "paper (law")]

    on, off = of("θ ON"), of("θ OFF")
    return {f"{theta:.3f}"[1:]: row for theta, *row in zip(*on, *off, strict=True)}


def table_three() -> dict[str, Figures]:
    rows = {"ECC |": "ecc", "S2R": "s2r", "JAER": "jaer", "LGAN": "lgan", "paper's flow": "ours"}
    real = {"ECC |": (.053, .089), "S2R": (.078, .063), "JAER": (.043, .149),
            "LGAN": (.089, .108), "paper's flow": (.018, .024)}

    def of(system: str, *columns: str | int) -> Figures:
        return [values("compare_systems", rf"{mismatch}, \.2 s \(\d+\)\|{system}\|", column)[0]
                for mismatch in (0.03, 0.15) for column in columns]

    def paper(system: str) -> Figures:
        return [values("compare_systems", rf"0.03, \.2 s \(\d+\)\|{system}\|", column)[0]
                for column in ("paper", 13)]

    found = {label: [*paper(name), *of(name, 4, 5), *real[label]] for label, name in rows.items()}
    ours = {"ECC, median": "ecc median", "the paper's network": "paper's flow, all windows",
            "the flow": "flow, all windows", "constant": r"constant \.3"}
    return found | {label: of(name, 4, 5) for label, name in ours.items()}


def table_four() -> dict[str, Figures]:
    rows = {"V2E": "v2e", "DVS-Voltmeter |": "evolt", "the same, given": "evolt, θ",
            "paper's flow": "ours"}

    def of(system: str, sensor: str, head: str) -> Figures:
        row = rf"{sensor}\|flat .*?\|{system}\|"
        paper = numbers(cells("noise_rates", row, head)[0])
        return [*map(float, paper), *(values("noise_rates", row, k)[0] for k in (3, 4))]

    return {label: [*of(name, "eq12", "paper CeleX5"), *of(name, "dvs346", "paper DAVIS346")]
            for label, name in rows.items()}


def table_five() -> dict[str, Figures]:
    rows = {"default": ("default", "see_better"), "thresholds uniform": ("wide", "see_better"),
            "S2R": ("s2r", "see_better"),
            "EventGAN": ("eventgan", "see_better_eventgan"), "LGAN": ("lgan", "see_better"),
            "paper's events": ("evflow", "see_better"), "the true": ("oracle", "see_better")}
    paper = {"default": "Original E2V", "S2R": r"GE \(S2R", "EventGAN": r"GE \(EGAN",
             "LGAN": r"GE \(LGAN", "paper's events": r"GE \(Ours"}

    def of(label: str, name: str, source: str) -> Figures:
        theirs = cells("see_better_eventgan", rf".*\|{paper[label]}", "IJRR")[0].split("/") if (
            label in paper) else []
        return [*map(float, theirs), *(values(source, rf"{measure}\|{name} \([35]\)", "mean")[0]
                                       for measure in ("MSE", "SSIM", "LPIPS"))]

    return {label: of(label, *at) for label, at in rows.items()}


def table_seven() -> dict[str, Figures]:
    paper = (.630, .676, .703, .680, .672)
    return {f"{steps} |": [value, values("see_better_steps", rf"SSIM\|{steps} steps", "mean")[0],
                         *(values("ablate_steps", f"{steps} steps", "theta, sequence", k)[0]
                           for k in range(2))]
            for steps, value in zip((8, 12, 16, 20, 24), paper, strict=True)}


LOSSES = ("L_P |", "L_P + L_F + L_F' |", "L_P + L_E", "L_P + L_F + L_F' + L_E",
          "the same, weights")


def table_eight() -> dict[str, Figures]:
    def of(row: str, *columns: int) -> Figures:
        return [values("ablate_losses", re.escape(row.replace(" |", "|")), column, k)[0]
                for column in columns for k in range(2)]

    return {**{label: of(label, 2, 1, 4, 3) for label in LOSSES},
            "L_P + L_F |": of("L_P + L_F |", 1, 3), "a constant": of("constant", 1, 3)}


def table_nine() -> dict[str, Figures]:
    paper = (.665, .674, .688, .684, .703)
    rows = ("L_P (", "L_P + L_F + L_F' (", "L_P + L_E", "L_P + L_F + L_F' + L_E",
            "the same, weights")

    def here(row: str) -> Figures:
        return [values("see_better_losses", rf"{measure}\|{re.escape(row)}", "mean")[0]
                for measure in ("MSE", "SSIM", "LPIPS")]

    return {**{label: [value, *here(row)]
               for label, row, value in zip(LOSSES, rows, paper, strict=True)},
            "default parameters": here("default"), "the true camera": here("oracle")}


def table_ten() -> dict[str, Figures]:
    rows = {"ECC |": "ecc", "ECC with": "ecc offset 40", "S2R": "s2r", "JAER": "jaer",
            "paper's flow": "ours, maps", "count matching": "match", ".2 everywhere": "default .2"}

    def of(name: str, table: str) -> Figures:
        paper = numbers(cells("integrate", rf"{name}\|", "paper", table)[0])
        return [*map(float, paper), *(values("integrate", rf"{name}\|", column, 0, table)[0]
                                      for column in ("RMSE", "PSNR", "SSIM"))]

    return {label: [*of(name, "ijrr_slider_depth"), *of(name, "newton_cradle_davis346, DAVIS346, 1 "
                                                        "frame")] for label, name in rows.items()}


def table_eleven() -> dict[str, Figures]:
    rows = {"Kalman": ("AKF", .10, .18), "encoder": ("encoder", .06, .13)}
    return {label: [*paper, *(values("changes", rf"{name}\|", "MAE, log_255", 0, title)[0]
                              for title in ("ijrr_slider_depth, up to the held-out",
                                            "newton_cradle_davis346, up to the held-out"))]
            for label, (name, *paper) in rows.items()}


TABLES: dict[str, Callable[[], dict[str, Figures]]] = {
    "## Table II,": table_two,
    "## Table III": table_three,
    "## Table IV": table_four,
    "## Table V:": table_five,
    "## Table VII,": table_seven,
    "## Table VIII": table_eight,
    "## Table IX": table_nine,
    "## Table X:": table_ten,
    "## Table XI": table_eleven,
}


@pytest.mark.parametrize(("heading", "figures"), TABLES.items(), ids=[*TABLES])
def test_a_table_of_the_paper_beside_ours(
    heading: str, figures: Callable[[], dict[str, Figures]]
) -> None:
    assert not wrong("docs/paper.md", heading, figures())
