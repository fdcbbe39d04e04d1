"""The documents keep their word: README.md and docs/*.md run as they are printed.

Every fenced block of bash or python runs, in order, in a folder with a small recording, a video and
a folder of frames; the README's Python also runs in an empty one. On the line above a block may
stand `<!-- not run: reason -->`, `<!-- slow -->`, `<!-- [slow, ]needs PACKAGE -->`; installation is
not run. The quick test leaves out what `SLOW` names and lays a camera ready in its place; the slow
one runs it all, with a small preset for a large one.
"""

from __future__ import annotations

import ast
import builtins
import dataclasses
import importlib
import importlib.util
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
import typing
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest

import evflow as ef
from evflow.cli import command_type, main
from evflow.dataset.sequence import EventSequence
from evflow.downstream.tensor import event_tensor, normalise
from evflow.errors import CODES
from evflow.io import write_recording
from evflow.io.registry import FORMATS, WRITERS
from evflow.notes import NOTES
from evflow.training.config import TrainConfig
from experiments import (
    coverage,
    curves,
    evaluate,
    gallery,
    integrate,
    make_dataset,
    see_better,
    train,
    train_eventgan,
    train_network,
    true_video,
)

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [*DOCUMENTS, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
BLOCK = re.compile(r"(?:<!-- (?P<mark>[^>]+) -->\n)?```(?P<kind>\w*)\n(?P<text>.*?)^```$",
                   re.DOTALL | re.MULTILINE)
MARK = re.compile(r"slow|(slow, )?needs \w+|not run: .+")
SLOW = re.compile(r"evflow (estimate|train|bench)|python -m|estimate_camera")
SMALLER = {"--preset full": "--preset debug", "--preset small": "--preset debug"}
SHAPE = (48, 64)


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block: mark: of the comment above it, or ""; kind: its language, or ""."""

    mark: str
    kind: str
    text: str


def blocks(document: Path) -> list[Block]:
    return [Block(b["mark"] or "", b["kind"], b["text"])
            for b in BLOCK.finditer(document.read_text("utf-8"))]


WITH_CODE = [d for d in DOCUMENTS if any(b.kind for b in blocks(d))]


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """flight.aedat4, ride.mp4, frames/ with times.txt, and the camera that recorded the flight."""
    folder = tmp_path_factory.mktemp("material")
    camera = ef.Camera.sample(jax.random.key(3), SHAPE, ef.CameraPrior(theta=(0.2, 0.3)))
    times = np.arange(281)
    video = np.stack([texture(t / 1e3) for t in times])
    events = ef.simulate(jax.random.key(0), video, 1000 * times, camera)
    kept = slice(20, None, 40)
    frames = np.rint(video[kept]).astype(np.uint8)
    write_recording(folder / "flight.aedat4", ef.Recording(events, frames, 1000 * times[kept]))
    camera.save(folder / "camera.npz")
    film = cv2.VideoWriter(
        str(folder / "ride.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, SHAPE[::-1])
    (folder / "frames").mkdir()
    for i, frame in enumerate(frames):
        film.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
        cv2.imwrite(str(folder / f"frames/{i}.png"), frame)
    film.release()
    (folder / "times.txt").write_text("".join(f"{0.04 * i:.2f}\n" for i in range(len(frames))))
    return folder


def texture(seconds: float) -> np.ndarray:
    """(48, 64) float32 DN: a random pattern that moves by 150 and 60 px/s."""
    noise = np.random.default_rng(0).uniform(0, 1, (160, 260)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    image = 30 + 200 * (smooth - smooth.min()) / np.ptp(smooth)
    shift = np.array([[1, 0, 10 + 150 * seconds], [0, 1, 10 + 60 * seconds]], np.float32)
    return cv2.warpAffine(image, shift, SHAPE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def run_document(document: Path, *, quick: bool) -> int:
    """Run the blocks in the present folder; returns how many commands and Python blocks ran."""
    names: dict[str, Any] = {}
    ran = 0
    for block in blocks(document):
        slow, needed = block.mark.startswith("slow"), block.mark.partition("needs ")[2]
        if (block.mark.startswith("not run") or (quick and slow)
                or (needed and not importlib.util.find_spec(needed))):
            continue
        if block.kind == "bash":
            ran += sum(run_line(line, quick=quick)
                       for line in block.text.replace("\\\n", " ").splitlines())
        elif block.kind == "python" and not (quick and SLOW.search(block.text)):
            exec(compile(block.text, document.name, "exec"), names)
            ran += 1
    return ran


def run_line(line: str, *, quick: bool) -> bool:
    """Run one command, where it is to be run; it must succeed."""
    for large, small in SMALLER.items():
        line = line.replace(large, small)
    words = shlex.split(line, comments=True)
    if not words or words[0] == "pip" or (quick and SLOW.search(line)):
        return False
    assert not {"|", "&&", ";", ">"} & set(words), f"one command a line: {line}"
    if words[0] == "evflow":
        assert main(words[1:]) == 0, line
    else:
        assert words[:2] == ["python", "-m"], f"which program is this? {line}"
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, *words[1:]], check=True, env=environment)
    return True


@pytest.mark.parametrize("document", WITH_CODE, ids=lambda d: d.name)
def test_documents_run(
    document: Path, material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    (tmp_path / "cam").mkdir()
    (tmp_path / "camera.npz").rename(tmp_path / "cam/camera.npz")
    monkeypatch.chdir(tmp_path)
    assert run_document(document, quick=True) >= 3


def test_a_camera_is_cropped_with_all_that_its_file_holds(
    material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recipe,) = (b for b in blocks(ROOT / "docs/networks.md") if "cam/cropped.npz" in b.text)
    (tmp_path / "cam").mkdir()
    monkeypatch.chdir(tmp_path)
    whole = ef.Camera.load(material / "camera.npz")
    whole.save("cam/camera.npz", sensor_cutoff_hz=20.0, sensor_refractory_s=0.02,
               optics_offset_dn=5.0, undetermined=np.array(["theta_on"]),
               valid=np.ones(SHAPE, bool))
    exec(recipe.text, {})
    whole.save("cam/maps.npz")
    events = {}
    for name in ("camera", "cropped", "maps"):
        assert main(["simulate", str(material / "flight.aedat4"), "--camera", f"cam/{name}.npz",
                     "-o", f"{name}.npz"]) == 0
        events[name] = ef.read_events(f"{name}.npz")
    for column in "txyp":
        np.testing.assert_array_equal(getattr(events["camera"], column),
                                      getattr(events["cropped"], column))
    assert len(events["maps"]) > 1.1 * len(events["camera"])
    exec(recipe.text.replace(":48", ":24").replace(":64", ":32"), {})
    with np.load("cam/cropped.npz") as part:
        assert {n: part[n].shape for n in ("theta_off", "valid", "undetermined")} == {
            "theta_off": (24, 32), "valid": (24, 32), "undetermined": (1,)}
    np.testing.assert_array_equal(ef.Camera.load("cam/cropped.npz").eta_on, whole.eta_on[:24, :32])


@pytest.mark.parametrize(("t", "p"), [
    ([], []), ([5], [1]), ([0, 10], [1, 1]), ([5, 5, 5], [1, 1, 1]), ([0, 0, 4, 9], [1, 0, 1, 0])])
def test_tensors_of_the_data_sets_are_those_of_a_network(
    t: list[int], p: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where all their entries are equal: NaN would stay in a network for ever."""
    (recipe,) = (b for b in blocks(ROOT / "docs/networks.md") if "def five_bins" in b.text)
    monkeypatch.setitem(sys.modules, "torch", types.SimpleNamespace(from_numpy=np.asarray))
    names: dict[str, Any] = {}
    exec(recipe.text, names)
    pixels = np.arange(len(t), dtype=np.uint16)
    events = ef.Events(pixels, pixels, np.array(t, np.int64), np.array(p, bool), (8, 6))
    wanted = np.asarray(normalise(event_tensor(events))).transpose(2, 0, 1)
    np.testing.assert_allclose(names["five_bins"](events), wanted, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("document", WITH_CODE, ids=lambda d: d.name)
def test_documents_run_to_the_last_line(
    document: Path, material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    assert run_document(document, quick=False) >= 3


SPEAKING = {"recording": ef.Recording, "events": ef.Events, "window": ef.Window,
            "sequence": EventSequence, "camera": ef.Camera, "found": ef.CameraEstimate}


@pytest.mark.parametrize("document", WITH_CODE, ids=lambda d: d.name)
def test_names_in_python_exist(document: Path) -> None:
    """Also of what is not run where a package is missing: imports, attributes and keywords of
    evflow, and no name without a value."""
    known = {*dir(builtins), "__name__"}
    for block in blocks(document):
        if block.kind != "python":
            continue
        nodes = list(ast.walk(ast.parse(block.text)))
        known |= {name for node in nodes for name in bound(node)}
        assert not {n.id for n in nodes if isinstance(n, ast.Name)} - known, block.text
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("evflow"):
                room = importlib.import_module(node.module or "")
                assert all(hasattr(room, alias.name) or importlib.util.find_spec(
                    f"{node.module}.{alias.name}") for alias in node.names), node.module
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                kind = ef if node.value.id == "ef" else SPEAKING.get(node.value.id)
                assert kind is None or hasattr(kind, node.attr) or node.attr in getattr(
                    kind, "__dataclass_fields__", {}), ast.unparse(node)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("ef."):
                called = ef
                for part in ast.unparse(node.func).split(".")[1:]:
                    called = getattr(called, part)
                taken = inspect.signature(called).parameters  # type: ignore[arg-type]
                assert {k.arg for k in node.keywords if k.arg} <= set(taken), ast.unparse(node)


def bound(node: ast.AST) -> list[str]:
    """Names that a node of a program gives a value."""
    if isinstance(node, ast.Name):
        return [node.id] if isinstance(node.ctx, ast.Store) else []
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [(alias.asname or alias.name).split(".")[0] for alias in node.names]
    if isinstance(node, ast.arg):
        return [node.arg]
    return [node.name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: d.name)
def test_blocks_are_marked_as_agreed(document: Path) -> None:
    text = document.read_text("utf-8")
    assert text.count("```") == 2 * len(blocks(document))
    for block in blocks(document):
        assert block.kind in ("bash", "python", "")
        assert not block.mark or MARK.fullmatch(block.mark)


@pytest.mark.parametrize("document", PAGES, ids=lambda d: d.name)
def test_links_lead_somewhere(document: Path) -> None:
    links = re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", document.read_text("utf-8"))
    for target, heading in links:
        page = document.parent / target if target else document
        assert target.startswith("https://") or page.exists(), target
        assert not heading or heading in anchors(page), f"{target}#{heading}"


def anchors(page: Path) -> set[str]:
    """What GitHub calls the headings of a page in links."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}


def test_the_readme_is_one_page() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 750


def test_the_gallery_is_small_and_whole() -> None:
    shown = re.findall(r"!\[[^]]+\]\((pictures/gallery/[^)]+)\)",
                       (ROOT / "docs/gallery.md").read_text("utf-8"))
    assert sorted(Path(path).stem for path in shown) == sorted(gallery.PICTURES)
    for path in shown:
        assert 2_000 < (ROOT / "docs" / path).stat().st_size <= 150_000, path


@pytest.mark.slow
def test_the_readmes_python_runs_from_a_fresh_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # no recording, no video, no camera
    names: dict[str, Any] = {}
    for block in blocks(ROOT / "README.md"):
        if block.kind == "python":
            exec(compile(block.text, "README.md", "exec"), names)
    assert "estimated" in capsys.readouterr().out
    for name in ("theta_on", "theta_off"):
        true = float(np.median(getattr(names["hidden"], name)))
        assert abs(float(getattr(names["found"].summary, name)) - true) < 0.1 * true
    assert names["camera"].theta_on.shape == SHAPE
    assert not names["found"].hot.any()  # .4 s of steady motion, seen by a camera without


@pytest.mark.parametrize("document", DOCUMENTS[1:], ids=lambda d: d.name)
def test_options_exist(document: Path) -> None:
    known = {"--help", "--xla_force_host_platform_device_count"}  # the second is XLA's
    known |= {f"--{name}" for name in (
        "pos_thres", "neg_thres", "sigma_thres", "cutoff_hz", "refractory_period", "leak_rate_hz",
        "shot_noise_rate_hz")}  # of v2e
    commands = [typing.get_args(c)[0] for c in typing.get_args(command_type())]
    scripts = (coverage, curves, evaluate, integrate, true_video, make_dataset, see_better, train,
               train_eventgan, train_network)
    for options in (*commands, *(script.Options for script in scripts)):
        for field in dataclasses.fields(options):
            flag = field.name.replace("_", "-")
            known |= {f"--{flag}", f"--no-{flag}"}
    known |= {f"--{field.name}".replace("_", "-") for field in dataclasses.fields(TrainConfig)}
    text = document.read_text("utf-8")
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text)) <= known


def rows(document: str) -> list[list[str]]:
    """The cells of every table row."""
    lines = (ROOT / "docs" / document).read_text("utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")]
            for line in lines if line.startswith("|")]


def test_every_code_is_explained() -> None:
    table = [row for row in rows("errors.md") if re.fullmatch(r"EV\d+", row[0])]
    assert [tuple(row[:2]) for row in table] == list(CODES.items())
    assert all(len(row) == 4 and all(row) for row in table)


def test_every_code_of_a_note_is_explained() -> None:
    table = [row for row in rows("errors.md") if re.fullmatch(r"`\w+\.\w+`", row[0])]
    assert [(code.strip("`"), title) for code, title, _ in table] == list(NOTES.items())
    assert all(all(row) for row in table)


def test_every_format_is_listed_with_what_it_can() -> None:
    names = [f"`{format.NAME}`" for format in FORMATS]
    table = {row[0]: row for row in rows("formats.md") if len(row) == 5 and row[0] in names}
    assert list(table) == names
    for format in FORMATS:
        _, read, write, frames, _ = table[f"`{format.NAME}`"]
        writer = WRITERS.get(format.NAME)
        assert (read, write) == ("yes", "yes" if writer else "no")
        assert ("written" in frames) == bool(writer and writer.DEPTHS)
        assert ("uint8 only" in frames) == bool(writer and writer.DEPTHS == ("uint8",))


def test_what_is_said_of_the_experiments_presets_is_so() -> None:
    scripts = [p.stem for p in (ROOT / "experiments").glob("*.py") if "__main__" in p.read_text()]
    options = {name: importlib.import_module(f"experiments.{name}").Options for name in scripts}
    without = {name for name, kind in options.items()
               if "preset" not in {field.name for field in dataclasses.fields(kind)}}
    making = {"calibrate", "combine", "fuse", "tell_apart"}
    assert without == {
        "quickstart", "gallery", "evaluate_network", "guessed_frames", "long_recordings", *making}
    text = (ROOT / "docs/experiments.md").read_text("utf-8")
    assert all(f"`{name}`" in text.partition("| script")[0] for name in without - making)
