"""Checks of a command line before it is parsed, and the paragraphs of its help.

An unknown option is refused, with the nearest ones of that command, or with evflow's counterpart of
an option of v2e.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import itertools
import re
import textwrap
import typing
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import tyro

from evflow.errors import EvflowDataError

LIKE = 0.65  # similarity of names (difflib) from which one is proposed for another
V2E = {  # options of v2e by another name here, in `evflow simulate`
    "pos-thres": "--theta-on", "neg-thres": "--theta-off", "sigma-thres": "--mismatch",
    "refractory-period": "--refractory-s", "leak-rate-hz": "--leak-hz",
    "shot-noise-rate-hz": "--shot-hz", "leak-jitter-fraction": "--leak-jitter",
    "noise-rate-cov-decades": "--leak-fpn-decades", "dvs-params": "--sensor",
    "dvs-emulator-seed": "--seed", "input": "VIDEO without an option",
    "i": "VIDEO without an option", "output-folder": "-o FILE.h5",
    "dvs-h5": "-o FILE.h5", "dvs-text": "-o FILE.txt", "dvs-aedat2": "-o FILE.aedat",
    "dvs-aedat4": "-o FILE.aedat4", "dvs-vid": "--preview FILE.mp4",
    "dvs128": "--sensor-size dvs128", "dvs240": "--sensor-size davis240",
    "dvs346": "--sensor-size davis346", "dvs640": "--sensor-size 640x480",
    "dvs1024": "--sensor-size 1024x768", "output-width": "--sensor-size WxH",
    "output-height": "--sensor-size WxH", "input-frame-rate": "--fps",
    "input-slowmotion-factor": "--slow-motion", "start-time": "--start", "stop-time": "--stop",
    "disable-slomo": "--no-interpolate", "label-signal-noise": "--labels",
    "timestamp-resolution": "--max-motion-px, as far as anything moves,",
    "auto-timestamp-resolution": "--max-motion-px, as far as anything moves,"}
NOT_HERE = {  # options of v2e without a counterpart, though other names are like theirs
    "dvs-exposure", "avi-frame-rate", "batch-size", "hdr", "cs-lambda-pixels", "cs-tau-p-ms",
    "photoreceptor-noise", "scidvs", "slomo-model", "synthetic-input", "skip-video-output",
    "vid-orig", "vid-slomo", "slomo-stats-plot", "show-dvs-model-state",
    "record-single-pixel-states", "save-dvs-model-state", "ddd-output"}


def reflowed(command: type) -> type:
    """The command with every option's help as one paragraph, without the source's line breaks."""
    hints = typing.get_type_hints(command, include_extras=True)
    help_of = {name: text for cls in reversed(command.__mro__) for name, text in _help(cls)
               if not any(getattr(note, "help", None)
                          for note in getattr(hints[name], "__metadata__", ()))}
    types = {name: Annotated[hints[name], tyro.conf.arg(help=text)]
             for name, text in help_of.items()}
    return type(command.__name__, (command,), {
        "__annotations__": types, "__doc__": command.__doc__, "__module__": command.__module__})


def _help(cls: type) -> Iterator[tuple[str, str]]:
    """Each field of a class that a string follows, and that string in one line."""
    if cls.__module__.partition(".")[0] != "evflow":
        return
    try:
        source = inspect.getsource(cls)
    except OSError:  # a class made at run time; its bases have theirs
        return
    body = ast.parse(textwrap.dedent(source)).body[0].body  # type: ignore[attr-defined]
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            yield ast.unparse(field.target), " ".join(ast.literal_eval(text.value).split())


def attributes(cls: type) -> dict[str, str]:
    """The section `Attributes:` of a docstring: each name and its text in one line."""
    section = (inspect.getdoc(cls) or "").partition("\nAttributes:\n")[2].partition("\n\n")[0]
    return {name: " ".join(text.split())
            for name, text in re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", section, re.M)}


def check_options(verb: str, command: type, arguments: Sequence[str]) -> None:
    """Raise EV020 if options among the arguments are none of the command's. Those with a dot are
    left to `with_configuration`."""
    known, wrong = set(_options(command)), {}
    for word in arguments:
        typed = word.partition("=")[0]
        name = typed[:2] + typed[2:].replace("_", "-")
        attached = name[:2] in known and "-" + name not in known  # -oFILE
        if re.match("--?[A-Za-z]", word) and "." not in name and not (name in known or attached):
            wrong[typed] = _instead(verb, typed, name.lstrip("-"), known)
    if wrong:
        raise EvflowDataError(
            "EV020", f"evflow {verb} has no option {', '.join(wrong)}.",
            " ".join([*filter(None, wrong.values()), f"evflow {verb} --help lists all."]))


def _instead(verb: str, typed: str, name: str, known: set[str]) -> str:
    """What to type instead of an option that the command lacks; "" if nothing is near."""
    if verb == "simulate" and name in V2E:
        return f"v2e's {typed} is {V2E[name]} here."
    if verb == "simulate" and name in NOT_HERE:
        return f"v2e's {typed} has no counterpart here."
    names = sorted(option.lstrip("-") for option in known)
    near = [k for k in names if f"-{name}-" in f"-{k}-" or name.startswith(f"{k}-")]
    near = near or difflib.get_close_matches(name, names, n=1, cutoff=LIKE)
    return f"Did you mean {' or '.join(f'--{k}' for k in near)}?" if near else ""


def _options(command: type) -> Iterator[str]:
    """All spellings of a command's options, with hyphens."""
    yield from ("-h", "--help")
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        notes: tuple[Any, ...] = getattr(hint, "__metadata__", ())
        if tyro.conf.Positional in notes:
            continue
        yield "--" + name.replace("_", "-")
        if getattr(hint, "__origin__", hint) is bool:
            yield "--no-" + name.replace("_", "-")
        for note in notes:
            yield from getattr(note, "aliases", None) or ()


def check_rest(verb: str, rest: Sequence[str]) -> None:
    """Raise EV020 if words are left that belong to no option."""
    if rest:
        raise EvflowDataError(
            "EV020", f"evflow {verb} was given one word too many: {rest[0]!r}.",
            "One run takes one file; an option that only switches something on takes no value; "
            "names with spaces need quotes.")
