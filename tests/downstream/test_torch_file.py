"""PyTorch checkpoints without PyTorch: both containers, and nothing but weights from them."""

from __future__ import annotations

import argparse
import collections
import contextlib
import functools
import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.published_networks import Raw, pickled, write_legacy, write_zip
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.downstream import Checkpoint, read_checkpoint
from evflow.errors import EvflowDataError

DATA = Path(__file__).parents[1] / "data"
FILES = ("torch_legacy.pt", "torch_zip.pt")
writers = pytest.mark.parametrize("write", [write_legacy, write_zip])


def state(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {"a.weight": rng.standard_normal((2, 3, 1, 1)).astype(np.float32),
            "a.bias": rng.standard_normal(2).astype(np.float32), "count": np.array(3, np.int64)}


def check_oddities(checkpoint: Checkpoint) -> None:
    """What tests/helpers/torch_reference.py saved."""
    whole = np.arange(24.0, dtype=np.float32).reshape(4, 6)
    expected = {
        "whole": whole, "turned": whole.T, "part": whole[1:3, ::2],
        "half": whole[0].astype(np.float16), "bfloat": whole[1],
        "double": whole[2].astype(np.float64), "long": np.array(7), "bool": whole[0] > 2,
        "empty": np.zeros((0, 3), np.float32), "parameter": np.ones(2, np.float32)}
    assert checkpoint.arrays.keys() == expected.keys()  # "module." taken off
    for name, array in checkpoint.arrays.items():
        assert array.dtype == expected[name].dtype, name
        np.testing.assert_array_equal(array, expected[name])
    assert checkpoint.settings == {"epoch": 3, "model": {"num_bins": 5, "norm": "BN"}}


@pytest.mark.parametrize("name", FILES)
def test_files_of_pytorch_itself(name: str) -> None:
    check_oddities(read_checkpoint(DATA / name))


def test_files_of_the_installed_pytorch(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from helpers import torch_reference
    for zipped in (True, False):
        torch.save(torch_reference.oddities(), tmp_path / "x.pt",
                   _use_new_zipfile_serialization=zipped)
        check_oddities(read_checkpoint(tmp_path / "x.pt"))


@writers
def test_written_files_come_back(write: Any, tmp_path: Path) -> None:
    write(tmp_path / "x.pth", {"state_dict": state(), "epoch": 2, "best": 0.5})
    checkpoint = read_checkpoint(tmp_path / "x.pth")
    assert checkpoint.settings == {"epoch": 2, "best": 0.5}
    for name, array in state().items():
        np.testing.assert_array_equal(checkpoint.arrays[name], array)
    write(tmp_path / "bare.pth", state())
    assert read_checkpoint(tmp_path / "bare.pth").arrays.keys() == state().keys()


@writers
@pytest.mark.parametrize("key", ["model", "model_state_dict", "net", "params"])
def test_the_one_nested_state_is_taken(write: Any, key: str, tmp_path: Path) -> None:
    optimiser = {"state": {0: {"exp_avg": np.zeros(2, np.float32)}}}
    whole = {"rng": np.zeros(9, np.uint8), "epoch": 3, "optimizer": optimiser, key: state()}
    write(tmp_path / "x.pth", whole)
    checkpoint = read_checkpoint(tmp_path / "x.pth")
    assert checkpoint.arrays.keys() == state().keys()
    assert key not in checkpoint.settings
    write(tmp_path / "x.pth", {key: state(), "ema": state()})
    with pytest.raises(EvflowDataError, match=r"EV018.*'ema'"):
        read_checkpoint(tmp_path / "x.pth")


@writers
@pytest.mark.parametrize("prefix", [
    "model.", "module.", "module.model.", "_orig_mod.", "module._orig_mod.", "model._orig_mod."])
def test_prefixes_of_wrappers_are_cut(write: Any, prefix: str, tmp_path: Path) -> None:
    write(tmp_path / "x.pth", {prefix + name: array for name, array in state().items()})
    assert read_checkpoint(tmp_path / "x.pth").arrays.keys() == state().keys()
    write(tmp_path / "x.pth", {"model.a": state()["a.bias"], "b": state()["a.bias"]})
    assert read_checkpoint(tmp_path / "x.pth").arrays.keys() == {"model.a", "b"}


@pytest.mark.parametrize("kept", [4, 60, 0.5, -30])
def test_zips_that_lack_their_end_are_damaged(kept: float, tmp_path: Path) -> None:
    write_zip(tmp_path / "x.pth", {"state_dict": state()})
    data = (tmp_path / "x.pth").read_bytes()
    (tmp_path / "x.pth").write_bytes(data[:int(kept * len(data)) if kept == 0.5 else int(kept)])
    with pytest.raises(EvflowDataError, match="EV009"):
        read_checkpoint(tmp_path / "x.pth")


@writers
def test_objects_of_the_training_code_are_dropped(write: Any, tmp_path: Path) -> None:
    config = Raw(b"ccopy_reg\n_reconstructor\n(cparse_config\nConfigParser\nc__builtin__\nobject\n"
                 b"NtR}(X\x03\x00\x00\x00dircpathlib\nPosixPath\n(X\x01\x00\x00\x00/tRub")
    write(tmp_path / "x.pth", {"state_dict": state(), "config": config})
    checkpoint = read_checkpoint(tmp_path / "x.pth")
    assert "config" not in checkpoint.settings
    assert len(checkpoint.arrays) == 3


@writers
@pytest.mark.parametrize("beside", [
    argparse.Namespace(a=1), np.arange(3.0), np.random.RandomState(0).get_state(), np.float64(3.0),
    {1, 2}, frozenset("ab"), collections.Counter("aba"), collections.defaultdict(list, a=[1]),
    {0.5: 1, None: 2, (1, "a"): 3, b"c": 4}, 1j], ids=lambda value: type(value).__name__)
def test_values_beside_weights_are_no_hindrance(write: Any, beside: Any, tmp_path: Path) -> None:
    as_torch_pickles = Raw(pickle.dumps(beside, 2)[2:-1])
    write(tmp_path / "x.pth", {"state_dict": state(), "extra": as_torch_pickles,
                               "dtypes": [Raw(b"ctorch\nfloat32\n"), Raw(b"ctorch\nbfloat16\n")]})
    assert read_checkpoint(tmp_path / "x.pth").arrays.keys() == state().keys()


@writers
@pytest.mark.parametrize("beside", [
    Raw(b"ctorch.nn.modules.conv\nConv2d\n)\x81"), Raw(b"}(K\x01\x85\x85K\x01u"), Raw(b"\x8f")],
    ids=["module", "keys", "instruction"])
def test_what_is_not_read_is_no_damage(write: Any, beside: Raw, tmp_path: Path) -> None:
    write(tmp_path / "x.pth", {"state_dict": state(), "extra": beside})
    with pytest.raises(EvflowDataError, match=r"EV009.*model\.state_dict\(\)") as e:
        read_checkpoint(tmp_path / "x.pth")
    assert "again" not in str(e.value)


@writers
@pytest.mark.parametrize("attack", [
    b"cos\nsystem\n(X\x10\x00\x00\x00touch /tmp/evilxtR", b"cbuiltins\neval\n(X\x01\x00\x00\x001tR",
    b"c__builtin__\ngetattr\n(}X\x03\x00\x00\x00popt\x81", b"cnumpy\nload\n(tR",
    b"(cos\nsystem\nX\x01\x00\x00\x00xo", b"(X\x01\x00\x00\x00xios\nsystem\n", b"\x82\x01",
    b"ctorch\nload\n(tR", b"ctorch._utils\n_rebuild_tensor_v2.__globals__\n",
], ids=["reduce", "eval", "newobj", "load", "obj", "inst", "extension", "torch", "attribute"])
def test_nothing_in_a_file_is_run(write: Any, attack: bytes, tmp_path: Path) -> None:
    write(tmp_path / "x.pth", {"state_dict": state(), "extra": Raw(attack)})
    with pytest.raises(EvflowDataError, match=r"refused|no weights need") as e:
        read_checkpoint(tmp_path / "x.pth")
    assert e.value.code == "EV009"
    assert not Path("/tmp/evilx").exists()


def tensor(
    shape: str, strides: str, *, offset: int = 0, count: int = 4, kind: str = "Float"
) -> Raw:
    """A tensor described by hand, over the storage "0"."""
    return Raw(b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storage"
               + f"ctorch\n{kind}Storage\n".encode() + b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpu"
               + f"I{count}\ntQI{offset}\n({shape}t({strides}tI00\nNtR".encode())


def write_by_hand(path: Path, value: Raw) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", pickled({"w": value}, [], legacy=False))
        archive.writestr("a/data/0", np.arange(4, dtype=np.float32).tobytes())


@pytest.mark.parametrize(("value", "expected"), [
    (tensor("I3\nI4\n", "I0\nI1\n"), [[0, 1, 2, 3]] * 3),
    (tensor("I6\n", "I0\n", offset=2), [2] * 6),
    (tensor("I3\nI2\n", "I1\nI1\n"), [[0, 1], [1, 2], [2, 3]])], ids=["rows", "one", "windows"])
def test_tensors_may_show_an_element_repeatedly(value: Raw, expected: list, tmp_path: Path) -> None:
    write_by_hand(tmp_path / "x.pt", value)
    np.testing.assert_array_equal(read_checkpoint(tmp_path / "x.pt").arrays["w"], expected)


@pytest.mark.parametrize("bad", [
    tensor("I5\n", "I1\n"), tensor("I4\n", "I2\n"), tensor("I4\n", "I1\n", offset=1),
    tensor("I-1\n", "I1\n"), tensor("I2\n", "I-1\n", offset=2), tensor("I4\n", "I1\nI1\n"),
    tensor("I99999999\n", "I0\n"), tensor("I1\n" * 9, "I1\n" * 9),
    tensor("I4\n", "I1\n", count=10**12), tensor("I4\n", "I1\n", kind="ComplexFloat"),
], ids=["long", "strides", "offset", "negative", "backwards", "axes", "expanded", "deep", "claim",
        "kind"])
def test_tensors_outside_of_their_storage_are_refused(bad: Raw, tmp_path: Path) -> None:
    write_by_hand(tmp_path / "x.pt", bad)
    with pytest.raises(EvflowDataError) as e:
        read_checkpoint(tmp_path / "x.pt")
    assert e.value.code == "EV009"


def test_other_files_are_named_for_what_they_are(tmp_path: Path) -> None:
    path = tmp_path / "x.pth"
    with pytest.raises(EvflowDataError, match="EV016"):
        read_checkpoint(path)
    for content in (b"", b"<html>", pickle.dumps({"a": 1})):
        path.write_bytes(content)
        with pytest.raises(EvflowDataError, match="EV008"):
            read_checkpoint(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "no weights")
    with pytest.raises(EvflowDataError, match="EV008"):
        read_checkpoint(path)
    write_legacy(path, {"epoch": 1})
    with pytest.raises(EvflowDataError, match=r"EV018.*epoch"):
        read_checkpoint(path)


@functools.cache
def files() -> tuple[bytes, ...]:
    return tuple((DATA / name).read_bytes() for name in FILES)


@given(data=st.data(), which=st.integers(0, 1))
@settings(max_examples=150, deadline=None)
def test_damage_is_an_error_and_no_other(data: st.DataObject, which: int, tmp_path_factory) -> None:
    content = bytearray(files()[which])
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)):]
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damage") / "x.pt"
    path.write_bytes(content)
    with contextlib.suppress(EvflowDataError):
        assert read_checkpoint(path).arrays


@writers
def test_no_memory_is_taken_for_storages_that_are_not_there(write: Any, tmp_path: Path) -> None:
    """A hundred million numbers, of which the file has four."""
    storage = tensor("I4\n", "I1\n", count=10**8)
    write(tmp_path / "x.pt", {"w": storage})
    tracemalloc.start()
    try:
        with pytest.raises(EvflowDataError, match=r"EV009.*that are there"):
            read_checkpoint(tmp_path / "x.pt")
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
    finally:
        tracemalloc.stop()


def test_tensors_of_one_storage_are_arrays_of_their_own(tmp_path: Path) -> None:
    shown = tensor("I2\nI2\n", "I2\nI1\n")
    with zipfile.ZipFile(tmp_path / "x.pt", "w") as archive:
        archive.writestr("a/data.pkl", pickled({"v": shown, "w": shown}, [], legacy=False))
        archive.writestr("a/data/0", np.arange(4, dtype=np.float32).tobytes())
    arrays = read_checkpoint(tmp_path / "x.pt").arrays
    arrays["v"][:] = -1
    np.testing.assert_array_equal(arrays["w"], [[0, 1], [2, 3]])


@pytest.mark.parametrize("content", [
    {0: np.zeros(2, np.float32)}, {"state_dict": {0: np.zeros(2, np.float32)}}], ids=str)
def test_weights_without_names_are_no_weights(content: dict, tmp_path: Path) -> None:
    write_legacy(tmp_path / "x.pt", content)
    with pytest.raises(EvflowDataError, match="EV018"):
        read_checkpoint(tmp_path / "x.pt")


def test_a_zip_that_claims_several_disks_is_damaged(tmp_path: Path) -> None:
    """Python raises while it only asks whether this is a zip."""
    content = files()[1]
    end = content.rindex(b"PK\x05\x06")
    locator = b"PK\x06\x07" + struct.pack("<LQL", 1, 0, 2)
    path = tmp_path / "x.pt"
    path.write_bytes(content[:end] + locator + content[end:])
    with pytest.raises(EvflowDataError, match="EV009"):
        read_checkpoint(path)
