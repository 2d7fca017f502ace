"""Tensors read without torch are those that torch reads, and nothing else is accepted."""

from __future__ import annotations

import io
import random

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.importers.torch_file import read_tensor

torch = pytest.importorskip("torch")


@pytest.mark.parametrize("new_format", [True, False])
@pytest.mark.parametrize("kind", ["float64", "float32", "float16", "int64", "int32", "int16", "int8", "uint8", "bool"])
def test_every_kind_of_number_comes_back_as_torch_wrote_it(tmp_path, kind, new_format):
    tensor = (torch.arange(24).reshape(1, 4, 6) % 5).to(getattr(torch, kind))
    torch.save(tensor, tmp_path / "a.pt", _use_new_zipfile_serialization=new_format)
    found = read_tensor(tmp_path / "a.pt")
    assert found.dtype == tensor.numpy().dtype
    np.testing.assert_array_equal(found, tensor.numpy())


@pytest.mark.parametrize("new_format", [True, False])
def test_a_view_is_read_through_its_strides(tmp_path, new_format):
    tensor = torch.arange(60.0, dtype=torch.float64).reshape(6, 10)[1:5, 2:9:2].T
    torch.save(tensor, tmp_path / "a.pt", _use_new_zipfile_serialization=new_format)
    np.testing.assert_array_equal(read_tensor(tmp_path / "a.pt"), tensor.numpy())


def test_the_recorded_tosses_are_read_as_torch_reads_them(data):
    files = [
        *(data("contactnets") / "tosses_processed").glob("*.pt"),
        *(data("contactnets") / "dair_pll_format").glob("*.pt"),
    ]
    for path in files:
        np.testing.assert_array_equal(read_tensor(path), torch.load(path, weights_only=True).numpy())


class _Evil:
    def __reduce__(self):
        return (print, ("executed",))


@pytest.mark.parametrize(
    "thing",
    [{"a": torch.zeros(2)}, [torch.zeros(2)], _Evil(), "text", torch.nn.Linear(2, 2), torch.zeros(2).to_sparse()],
)
@pytest.mark.parametrize("new_format", [True, False])
def test_anything_but_a_plain_tensor_is_refused(tmp_path, capsys, thing, new_format):
    torch.save(thing, tmp_path / "a.pt", _use_new_zipfile_serialization=new_format)
    with pytest.raises(BadInput, match="plain tensor"):
        read_tensor(tmp_path / "a.pt")
    assert "executed" not in capsys.readouterr().out


def test_a_pickle_that_would_run_something_is_refused_and_does_not_run(tmp_path, capsys):
    (tmp_path / "a.pt").write_bytes(b"\x80\x02cbuiltins\nprint\nX\x08\x00\x00\x00executed\x85R.")
    with pytest.raises(BadInput, match="print"):
        read_tensor(tmp_path / "a.pt")
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize("new_format", [True, False])
def test_cut_off_or_altered_files_raise_nothing_but_bad_input(tmp_path, new_format):
    out = io.BytesIO()
    torch.save(torch.arange(26.0, dtype=torch.float64).reshape(2, 13), out, _use_new_zipfile_serialization=new_format)
    whole, path, chance = out.getvalue(), tmp_path / "a.pt", random.Random(0)
    for end in range(0, len(whole), 7):
        path.write_bytes(whole[:end])
        with pytest.raises(BadInput):
            read_tensor(path)
    for _ in range(500):
        altered = bytearray(whole)
        altered[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(altered)
        try:
            read_tensor(path)
        except BadInput:
            pass
