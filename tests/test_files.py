"""A file is either the old one or the whole new one, and JSON keeps every bit of a float64."""

import json
import math
import os
import struct

import numpy as np
import pytest

from imr_torch.files import write_atomically, write_json


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_that_a_writer_that_raises_leaves_the_old_file_and_no_debris(tmp_path, error):
    target = tmp_path / "belief.json"
    target.write_text("old")

    def half(stream) -> None:
        stream.write(b"ne")
        stream.flush()
        raise error("disk full")

    with pytest.raises(error, match="disk full"):
        write_atomically(target, half)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["belief.json"]


def test_that_the_old_file_is_there_while_the_new_one_is_written(tmp_path):
    target = tmp_path / "belief.json"
    target.write_text("old")
    seen = []

    def look(stream) -> None:
        stream.write(b"new")
        stream.flush()
        seen.append(target.read_text())

    write_atomically(target, look)
    assert seen == ["old"]
    assert target.read_text() == "new"


def test_that_json_keeps_every_bit_of_a_float64(tmp_path):
    bits = np.random.default_rng(0).integers(0, 2**64, 4000, dtype=np.uint64)
    values = [v for v in bits.view(np.float64).tolist() if math.isfinite(v)]
    values += [0.1, 1.0 / 3.0, 5e-324, -0.0, 1.7976931348623157e308, 2.0**53 + 1.0, math.pi]
    write_json(tmp_path / "x.json", values)
    back = json.loads((tmp_path / "x.json").read_text())
    assert struct.pack(f"{len(values)}d", *back) == struct.pack(f"{len(values)}d", *values)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_that_json_refuses_a_number_that_it_has_no_word_for_and_keeps_the_old_file(
    tmp_path, value
):
    target = tmp_path / "x.json"
    write_json(target, {"x": 1.0})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(target, {"x": [1.0, value]})
    assert json.loads(target.read_text()) == {"x": 1.0}
    assert os.listdir(tmp_path) == ["x.json"]
