"""Numbers of two streams on cases with known answers, and their page and command."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evflow
from evflow import Events, EvflowDataError, Recording, read_recording, write_events
from evflow.cli import main
from evflow.metrics.streams import distances
from evflow.report import figures
from evflow.report.alike import describe_streams, judge_streams
from evflow.report.page import WIDEST, blocks, write_page
from evflow.report.verdict import Judged, advice, sentences, worst

SIZE = (32, 24)


def noise(seed: int, n: int = 4000, span: int = 1_000_000, share_on: float = 0.5) -> Events:
    """Independent events all over the sensor: rates differ from pixel to pixel."""
    rng = np.random.default_rng(seed)
    likely = np.random.default_rng(7).gamma(0.5, size=SIZE[0] * SIZE[1])
    pixel = rng.choice(likely.size, n, p=likely / likely.sum())
    t = np.sort(rng.integers(0, span, n))
    return Events(pixel % SIZE[0], pixel // SIZE[0], t, rng.random(n) < share_on, SIZE)


def edge(width: int = 32, speed_us: int = 1000, turns: int = 20) -> Events:
    """A bright bar that sweeps over the sensor: ON at its front, OFF at its back four pixels
    behind."""
    rows = np.arange(SIZE[1])
    t, x, y, p = [], [], [], []
    for step in range(turns * width):
        for behind, on in ((0, True), (4, False)):
            t.append(np.full(len(rows), step * speed_us) + rows)
            x.append(np.full(len(rows), (step - behind) % width))
            y.append(rows)
            p.append(np.full(len(rows), on))
    t, x, y, p = (np.concatenate(v) for v in (t, x, y, p))
    order = np.argsort(t, kind="stable")
    return Events(x[order], y[order], t[order], p[order], SIZE)


def test_a_stream_is_like_itself() -> None:
    events = noise(0)
    numbers = evflow.compare(events, events)
    assert numbers["aligned_at"] == "clock"
    for p in ("on", "off", "both"):
        assert numbers["counts"]["r"][p] == pytest.approx(1.0)
        assert numbers["rate_hz"]["ratio"][p] == 1.0
    for p in ("on", "off"):
        assert numbers["curve"]["r"][p] == pytest.approx(1.0)
    for kind in ("intervals", "neighbours"):
        assert numbers[kind]["ks"] == 0.0
        assert numbers[kind]["wasserstein_decades"] == 0.0
    assert numbers["active"]["common"] == 1.0
    assert worst(judge_streams(numbers)) == "good"
    assert describe_streams(numbers).startswith("Alike.\n")


def test_a_polarity_that_neither_has_is_not_missing() -> None:
    events = noise(1, share_on=1.0)
    assert worst(judge_streams(evflow.compare(events, events))) == "good"
    lost = evflow.compare(noise(1), events)
    assert worst(judge_streams(lost)) == "poor"


@pytest.mark.parametrize("size", [(640, 1), (1280, 2), (1, 640), (1281, 7)])
def test_a_flat_sensor_has_pictures(size: tuple[int, int]) -> None:
    values = np.arange(size[0] * size[1], dtype=float).reshape(size[::-1])
    small, k = blocks(values)
    assert max(small.shape) <= WIDEST
    assert small.shape == tuple(-(-side // k) for side in values.shape)
    assert small[0, 0] == values[:k, :k].mean() or min(size) < k


def test_shuffled_pixels_keep_the_rates_and_lose_the_places() -> None:
    events = noise(1)
    where = np.random.default_rng(2).permutation(SIZE[0] * SIZE[1])
    pixel = where[events.y.astype(int) * SIZE[0] + events.x]
    numbers = evflow.compare(events, Events(
        pixel % SIZE[0], pixel // SIZE[0], events.t, events.p, SIZE))
    assert numbers["rate_hz"]["ratio"]["both"] == 1.0
    assert numbers["intervals"]["ks"] == 0.0  # a pixel's events moved together
    assert abs(numbers["counts"]["r"]["both"]) < 0.15
    assert worst(judge_streams(numbers)) == "poor"


def test_twice_the_rate() -> None:
    """The same events at half the spacing, and once more: rate 2, every interval halved."""
    events = noise(3, 60_000)
    half = [dataclasses.replace(events, t=(events.t + k * 1_000_000) // 2) for k in (0, 1)]
    numbers = evflow.compare(events, Events.concatenate(half))
    assert numbers["rate_hz"]["ratio"]["both"] == pytest.approx(2.0, rel=0.01)
    assert numbers["counts"]["r"]["both"] > 0.999
    assert numbers["intervals"]["wasserstein_decades"] == pytest.approx(np.log10(2), abs=0.03)


def numbers_of(
    rate: float, own: float, around: float, rate_off: float | None = None
) -> dict[str, Any]:
    """Numbers of streams whose rates and median times have these ratios, 1 s and 10 ms recorded.
    rate_off: that of OFF, if it is another."""
    times = {kind: {"wasserstein_decades": abs(float(np.log10(ratio))), "ks": 0.5,
                    "median_s": {"real": 0.01, "synthetic": 0.01 * ratio}}
             for kind, ratio in (("intervals", own), ("neighbours", around))}
    times["neighbours"]["alone"] = {"real": 0.1, "synthetic": 0.1}
    rates = {"real": {"on": 1.0, "off": 1.0}, "synthetic": {
        "on": rate, "off": rate if rate_off is None else rate_off}}
    return {"events": {"real": 1000, "synthetic": 1000}, "covered": 1.0, "net_r": 0.9,
            "covered_of_longer": 1.0, "rate_hz": {**rates, "ratio": rates["synthetic"]},
            "counts": {"r": {"on": 0.9, "off": 0.9}}, **times}


@pytest.mark.parametrize(("ratios", "said"), [
    ((3.0, 0.3, 0.3), ["Too many synthetic events. If", "quickly (medians: of a pixel 3.00 against "
                       "10.00 ms, after a neighbour 3.00 against 10.00 ms), as there are too many"
                       ]),
    ((0.3, 3.0, 1.0), ["Too few synthetic events. If", "slowly (medians: of a pixel 30.00 against "
                       "10.00 ms), as there are too few"]),
    ((1.0, 0.3, 0.3), ["quickly (medians: of a pixel 3.00 against 10.00 ms, after a neighbour 3.00 "
                       "against 10.00 ms): look at the refractory period"]),
    ((3.0, 3.0, 1.0), ["Too many", "slowly (medians: of a pixel 30.00 against 10.00 ms): look"]),
    ((1.0, 3.0, 0.3), ["otherwise (medians"]), ((1.0, 1.0, 1.0), [])])
def test_each_advice_is_given_once(ratios: tuple[float, float, float], said: list[str]) -> None:
    found = advice(judge_streams(numbers_of(*ratios)))
    assert len(found) == len(said)
    for words, expected in zip(found, said, strict=True):
        assert expected in words


def test_advice_on_rates_names_the_polarity_where_they_contradict() -> None:
    found = advice(judge_streams(numbers_of(0.4, 0.1, 1.0, 3.0)))
    assert len(found) == 3
    for words, expected in zip(found, ("Too few synthetic ON events. If the ON thresholds",
                                       "Too many synthetic OFF events. If the OFF thresholds",
                                       "once the rates of ON and OFF agree"), strict=True):
        assert expected in words
    one = advice(judge_streams(numbers_of(0.5, 1.0, 1.0, 1.0)))
    assert [words[:29] for words in one] == ["Too few synthetic ON events. "]


def test_polarities_are_counted_apart() -> None:
    numbers = evflow.compare(noise(4), noise(4, share_on=0.8))
    assert numbers["on_off"]["real"] == pytest.approx(1.0, abs=0.1)
    assert numbers["on_off"]["synthetic"] == pytest.approx(4.0, rel=0.1)
    assert numbers["rate_hz"]["ratio"]["both"] == pytest.approx(1.0)
    rates = numbers["rate_hz"]["real"]
    total = rates["both"] * numbers["duration_s"] * SIZE[0] * SIZE[1]
    assert total == pytest.approx(numbers["events"]["real"])


def test_noise_comes_alone_and_signal_in_company() -> None:
    numbers = evflow.compare(edge(), noise(5, 4000))
    alone = numbers["neighbours"]["alone"]
    assert alone["real"] < 0.05
    assert alone["synthetic"] > 0.7
    # A bar turns every pixel on, then off.
    assert numbers["same_polarity"]["real"] == 0.0
    assert numbers["same_polarity"]["synthetic"] == pytest.approx(0.5, abs=0.05)
    assert "noise rates" in describe_streams(alike_in_rate(numbers))
    # A thinner stream has fewer neighbours, without any noise.
    assert "noise rates" not in describe_streams(numbers)


def alike_in_rate(numbers: dict[str, Any]) -> dict[str, Any]:
    """A comparison as if both streams had as many events."""
    rates = numbers["rate_hz"] | {"ratio": {"on": 1.0, "off": 1.0}}
    return numbers | {"rate_hz": rates}


def test_labels_of_times_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one at the right edge."""
    kept: list[Any] = []

    def keep(figure: Any, *_: Any) -> bytes:
        kept.append(figure)
        return b""

    monkeypatch.setattr(figures, "printed", keep)
    edges = np.linspace(-6.0, 2.0, 65)
    shares = np.where(edges[1:] <= -1.0, 1 / 40, 0.0)  # up to .1 s
    figures.times({"histogram": {"log10_s_edges": edges, "real": shares, "synthetic": shares}},
                  ("one", "two"), "delay")
    labels = kept[0].axes[0].get_xticklabels()
    assert labels[-1].get_text() == "0.1 s"
    assert max(label.get_window_extent().x1 for label in labels) < kept[0].bbox.x1


def test_neighbour_delays_agree_with_a_loop() -> None:
    events = noise(6, 300)
    found = evflow.compare(events, events)["neighbours"]
    expected = []
    for i in range(300):
        apart = np.maximum(abs(events.x[:i].astype(int) - int(events.x[i])),
                           abs(events.y[:i].astype(int) - int(events.y[i])))
        near = events.t[:i][apart == 1]
        expected.append(float(events.t[i] - near[-1]) if near.size else np.inf)
    delays = np.array(expected)
    assert found["alone"]["real"] == pytest.approx((delays > 5000).mean())
    near_by = np.maximum(delays[np.isfinite(delays)], 1.0)
    assert found["median_s"]["real"] == pytest.approx(10 ** np.median(np.log10(near_by * 1e-6)))


def test_distances_of_shifted_samples() -> None:
    a = np.sort(np.random.default_rng(0).normal(size=500))
    assert distances(a, a) == (0.0, 0.0)
    ks, wasserstein = distances(a, a + 10.0)
    assert (ks, wasserstein) == (1.0, pytest.approx(10.0))
    assert distances(a, a[:0]) == (None, None)


def test_streams_of_other_clocks_are_laid_at_their_beginnings() -> None:
    events = noise(8)
    later = dataclasses.replace(events, t=events.t + 10**12)
    numbers = evflow.compare(events, later)
    assert numbers["aligned_at"] == "beginnings"
    assert numbers["shift_us"] == -(10**12)
    assert numbers["counts"]["r"]["both"] == pytest.approx(1.0)
    assert "laid at their beginnings" in describe_streams(numbers)
    partly = dataclasses.replace(events, t=events.t + 400_000)
    numbers = evflow.compare(events, partly)
    assert numbers["aligned_at"] == "clock"
    assert numbers["duration_s"] == pytest.approx(0.6, abs=0.01)


def test_streams_that_touch_are_of_other_clocks() -> None:
    events = noise(8)
    after = dataclasses.replace(events, t=events.t - events.t[0] + events.t[-1])
    numbers = evflow.compare(events, after)
    assert numbers["aligned_at"] == "beginnings"
    assert numbers["events"]["real"] == numbers["events"]["synthetic"] == len(events)


def test_what_cannot_be_compared() -> None:
    events = noise(9)
    for span in ((100, 100), (100, 50)):
        with pytest.raises(EvflowDataError, match="EV020"):
            evflow.compare(events, events, span_us=span)
    other = dataclasses.replace(events, size=(40, 24))
    silent = events.slice(0, 0)
    for code, pair in (("EV015", (events, other)), ("EV001", (events, silent))):
        with pytest.raises(EvflowDataError) as raised:
            evflow.compare(*pair)
        assert raised.value.code == code
    one = events.slice(int(events.t[0]), int(events.t[0]) + 1)
    numbers = evflow.compare(one, one)  # nothing varies, nothing follows: undefined, not wrong
    assert numbers["intervals"]["ks"] is None
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers
    assert "decades" not in describe_streams(numbers)


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("streams")
    paths = folder / "real.npz", folder / "synthetic.npz"
    for seed, path in enumerate(paths):
        write_events(path, Recording.of_events(noise(seed)), format="npz")
    return paths


def test_compare_on_the_command_line(
    streams: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cmp"
    command = ["compare", *map(str, streams), "-o", str(out)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[0] in ("Alike.", "Alike in part.", "Not alike.")
    facts = json.loads((out / "compare.json").read_text())
    assert facts["rate_hz"]["ratio"]["both"] == pytest.approx(1.0, abs=0.05)
    assert facts["verdict"] == printed.splitlines()
    page = (out / "compare.html").read_text()
    for name in ("verdict", "rates", "images", "counts", "intervals", "facts"):
        assert f'<section id="{name}">' in page
    assert page.count("sha256") == 2
    assert main(command) == 1
    assert "EV013" in capsys.readouterr().err
    assert main(["compare", *map(str, streams), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["grade"] == facts["grade"]


def test_a_span_is_the_same_of_both_streams(
    streams: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where one begins later; on another clock it is as many seconds from the beginning."""
    whole = read_recording(streams[0]).events
    first, length = int(whole.t[0]), whole.duration_us
    later = whole.slice(first + length // 4, int(whole.t[-1]) + 1)
    apart = dataclasses.replace(whole, t=whole.t + 10**12)
    span = ("--start", f"{0.5e-6 * length}", "--stop", f"{0.75e-6 * length}")
    for other in (later, apart):
        path = tmp_path / f"{other.t[0]}.npz"
        write_events(path, Recording.of_events(other), format="npz")
        assert main(["compare", str(streams[0]), str(path), "--json", *span]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["rate_hz"]["ratio"]["both"] == pytest.approx(1.0, abs=0.01)
        assert facts["duration_s"] == pytest.approx(0.25e-6 * length, rel=0.02)


def test_a_stream_that_is_silent_in_a_span_is_not_compared_with_another_time(
    streams: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = read_recording(streams[0]).events
    first, length = int(whole.t[0]), whole.duration_us
    quiet = tmp_path / "quiet.npz"  # only its last quarter
    write_events(quiet, Recording.of_events(whole.slice(first + 3 * length // 4, first + length)),
                 format="npz")
    assert main(["compare", str(streams[0]), str(quiet), "-o", str(tmp_path / "out"),
                 "--stop", f"{0.5e-6 * length}"]) == 0
    said = capsys.readouterr().out
    assert "No synthetic ON events" in said
    assert "share no time" not in said
    facts = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert (facts["events"]["synthetic"], facts["aligned_at"]) == (0, "clock")


def test_compare_refuses_other_sizes(
    streams: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = tmp_path / "wide.npz"
    write_events(wide, dataclasses.replace(noise(0), size=(64, 24)), format="npz")
    assert main(["compare", str(streams[0]), str(wide), "-o", str(tmp_path / "no")]) == 1
    assert "EV015" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_a_span_of_numpys_numbers_is_ready_for_json() -> None:
    span = np.array([1000, 500_000])
    numbers = evflow.compare(noise(0), noise(1), span_us=(span[0], span[1]))
    assert json.loads(json.dumps(numbers))["span_us"] == [1000, 500_000]


def test_names_that_are_not_utf8_are_written(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", "fl\udcff.h5", "of fl\udcff.h5", [], {"file": "fl\udcff.h5"})
    assert "fl\\udcff.h5" in (tmp_path / "page.html").read_text("utf-8")


def test_too_little_is_not_called_alike() -> None:
    """As few events, or as little time, agree with much."""
    events = edge()
    few = dataclasses.replace(events, **{n: getattr(events, n)[:60] for n in "xytp"})
    numbers = evflow.compare(events, few)
    assert worst(judge_streams(numbers)) == "fair"
    assert "has only 60 events in" in describe_streams(numbers)
    later = dataclasses.replace(events, t=events.t + int(0.97 * events.duration_us))
    numbers = evflow.compare(events, later)
    assert numbers["covered"] == pytest.approx(0.03, rel=0.01)
    assert "Only 3.0% of the shorter stream's time" in describe_streams(numbers)


def test_silence_has_no_share_of_isolated_events() -> None:
    first, second = edge(), dataclasses.replace(edge(), t=edge().t + 1)
    numbers = evflow.compare(first, second, span_us=(0, 1))
    assert numbers["events"] == {"real": 2, "synthetic": 0}
    assert "Isolated events" not in describe_streams(numbers)


def test_swapped_polarity_is_named() -> None:
    """Counts per pixel are the same, and so are all times."""
    events = edge()
    numbers = evflow.compare(events, dataclasses.replace(events, p=~events.p))
    assert numbers["net_r"] == pytest.approx(-1.0)
    assert worst(judge_streams(numbers)) == "poor"
    assert "swapped" in describe_streams(numbers)
    numbers["rate_hz"]["ratio"] |= {"on": 0.3, "off": 3.0}  # as where ON and OFF differ
    numbers["counts"]["r"]["on"] = 0.1
    only, = advice(judge_streams(numbers))
    assert "evflow convert IN OUT --polarity invert" in only
    assert "swapped" not in describe_streams(evflow.compare(events, events))


def test_sentences_begin_with_a_capital_but_symbols_stay() -> None:
    seen = ("θ ON is known to 3%.", "η is.", "intervals differ.")
    assert sentences([Judged("good", "", 0.0, words) for words in seen]) == [
        "θ ON is known to 3%.", "η is.", "Intervals differ."]


@pytest.mark.parametrize(("share", "verdict"), [(0.004, "Alike in part."), (0.3, "Alike.")])
def test_a_stream_that_ends_soon_is_not_called_alike(share: float, verdict: str) -> None:
    """The first 4 ms of a second say nothing of the rest."""
    numbers = numbers_of(1.0, 1.0, 1.0) | {
        "aligned_at": "clock", "duration_s": 1.0, "space_time_r": None, "covered_of_longer": share}
    words = describe_streams(numbers)
    assert words.startswith(verdict)
    assert ("0.4% of the longer stream's time" in words) == (share < 0.05)
