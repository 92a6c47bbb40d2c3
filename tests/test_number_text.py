"""Tokens: every motion text comes back byte for byte, and its numbers are what they should be."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxmocap.codecs.number_text.text import NumberText, format_numbers, parse_numbers
from jaxmocap.errors import CorruptStream, JaxmocapError
from jaxmocap.formats import read_motion

LENIENT = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


def header(joints: int, frames: int, end: str = "\n", frame_time: str = ".0083333") -> str:
    """A chain of joints: 6 channels at the root, 3 at the others."""
    lines = ["HIERARCHY", "ROOT Hips", "{", "\tOFFSET 0 0 0"]
    lines += ["\tCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"]
    for j in range(1, joints):
        lines += [f"\tJOINT J{j}", "\t{", "\tOFFSET 0 1 0", "\tCHANNELS 3 Zrotation Yrotation Xrotation"]
    lines += ["\tEnd Site", "\t{", "\tOFFSET 0 1 0", "\t}", *["}"] * joints]
    return end.join([*lines, "MOTION", f"Frames: {frames}", f"Frame Time: {frame_time}", ""])


def bvh(rows: list[list[str]], end: str = "\n", separator: str = " ", behind: str = "") -> bytes:
    joints = (len(rows[0]) - 3) // 3
    return (header(joints, len(rows), end) + "".join(separator.join(row) + behind + end for row in rows)).encode()


def trimmed(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def with_point(value: float) -> str:
    text = f"{value:.6g}"
    return text if "." in text or "e" in text else text + ".0"


def windows(value: float) -> str:
    text = f"{value:.6g}"
    return text[:-2] + "0" + text[-2:] if "e" in text else text


WRITERS = {
    "%.4f": "{:.4f}".format,
    "%.6f": "{:.6f}".format,
    "%.0f": "{:.0f}".format,
    "%.9f": "{:.9f}".format,
    "trimmed": trimmed,
    "%.6g": "{:.6g}".format,
    "%.9g": "{:.9g}".format,
    "with .0": with_point,
    "three digits of exponent": windows,
}


def motion(frames: int = 40, columns: int = 12, seed: int = 0) -> np.ndarray:
    """Smooth columns, constant ones, exact zeros and noise far below any grid."""
    rng = np.random.default_rng(seed)
    values = np.cumsum(rng.normal(size=(frames, columns)), axis=0) * 10.0 ** rng.integers(-2, 2, columns)
    values[:, 3] = 7.73091
    values[:, 4] = -0.0
    values[:, 5] = rng.normal(size=frames) * 1e-13
    values[:, 6] = values[:, 5] * (1 + rng.normal(size=frames) * 1e-5)
    return values


def parsed(data: bytes) -> NumberText:
    found = parse_numbers(data)
    assert found is not None and format_numbers(found) == data
    return found


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize(("end", "separator", "behind"), [("\n", " ", ""), ("\r\n", "\t", " "), ("\r", "  ", "")])
def test_every_number_format_and_line_end(writer: str, end: str, separator: str, behind: str):
    values = motion()
    data = bvh([[WRITERS[writer](v) for v in row] for row in values], end, separator, behind)
    table = parsed(data).table
    assert table.columns[:4] == ("Hips Xposition", "Hips Yposition", "Hips Zposition", "Hips Zrotation")
    assert np.abs(table.integers / 10.0**table.decimals - values).max() <= 1.01 * 10.0**-table.decimals
    for cut in (1, 2, 7):
        parsed(data[:-cut])


@pytest.mark.parametrize("writer", ["%.4f", "%.6f", "trimmed"])
def test_regular_texts_cost_no_layout(writer: str):
    rows = [[WRITERS[writer](v) for v in row] for row in motion()]
    found = parsed(bvh(rows))
    assert len(found.layout) == 1
    assert found.template == parsed(bvh(rows[:11])).template, "files of other lengths share a template"
    wanted = np.rint(motion() * 10.0**found.table.decimals)
    np.testing.assert_array_equal(found.table.integers, wanted)
    assert found.table.negative_zeros[:, 4].all() and not found.table.negative_zeros[:, 3].any()


def test_a_pose_in_front_without_decimals_costs_few_bytes():
    rows = [["0", "17.6356", "-28.2214", "0", "0", "-21"] * 2, *([f"{v:.4f}" for v in row] for row in motion())]
    found = parsed(bvh(rows))
    assert len(found.layout) == 4
    np.testing.assert_array_equal(found.table.integers[0, :6], [0, 176356, -282214, 0, 0, -210000])


def test_odd_tokens_cost_themselves_and_leave_sensible_integers():
    rows = [[f"{v:.4f}" for v in row] for row in motion()]
    odd = {(3, 0): "+1.0", (3, 1): "1e5", (9, 2): "99999999999999", (9, 11): "007.5000", (20, 4): "nan", (39, 11): "-.5"}
    for (row, column), text in odd.items():
        rows[row][column] = text
    found = parsed(bvh(rows))
    assert len(found.layout) < 100
    table = found.table.integers
    assert table[3, 0] == 10000 and table[3, 1] == 10**9 and table[9, 11] == 75000 and table[39, 11] == -5000
    assert table[9, 2] == table[8, 2] and table[20, 4] == 0


@pytest.mark.parametrize("writer", sorted(WRITERS))
def test_numbers_beyond_all_bounds(writer: str):
    rows = [[WRITERS[writer](v) for v in row] for row in motion()]
    odd = ["1e308", "-1e-299", "1e-305", "1e999", "-0", "5e-324", "2147483648", "1e+07", "0.00000000000000000001"]
    for row, text in enumerate(odd):
        rows[row][row] = text
    parsed(bvh(rows))


def test_odd_lines_cost_themselves():
    data = bvh([[f"{v:.4f}" for v in row] for row in motion()])
    lines = data.split(b"\n")
    first = lines.index(b"Frame Time: .0083333") + 1
    lines[first + 2] = lines[first + 2].replace(b" ", b"  ", 1)
    lines[first + 5] += b"\r"
    lines.insert(first + 9, b"# a comment")
    lines.insert(first + 20, b"")
    lines[first + 30] = lines[first + 30].rsplit(b" ", 1)[0]
    found = parsed(b"\n".join(lines) + b"\n\n")
    assert len(found.table.integers) == 39 and len(found.layout) < 400


def test_numbers_too_large_for_the_table_take_fewer_decimals():
    rows = [["123456.123456789", *[f"{v:.9f}" for v in row[1:]]] for row in motion()]
    found = parsed(bvh(rows))
    assert found.table.decimals == 3 and (found.table.integers[:, 0] == 123456123).all()


def amc(values: np.ndarray, end: str = "\n", first: int = 1) -> bytes:
    lines = ["#!OML:ASF F:\\somewhere.ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for n, row in enumerate(values):
        said = [windows(v) for v in row]
        lines += [str(first + n), " ".join(["root", *said[:6]]), " ".join(["lowerback", *said[6:9]]), f"lradius {said[9]}"]
    return (end.join(lines) + end).encode()


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_amc(end: str):
    values = motion(60, 10)
    data = amc(values, end)
    found = parsed(data)
    assert found.table.columns[5:8] == ("root 6", "lowerback 1", "lowerback 2") and found.table.columns[-1] == "lradius 1"
    assert found.table.decimals == 4
    assert np.abs(found.table.integers / 1e4 - values).max() < 1.01e-4
    assert parsed(amc(values, end, first=77)).layout[1:4] == bytes([1, 0, 77]), "frames that count up cost nothing"
    jump = parsed(data.replace(f"{end}31{end}".encode(), f"{end}44{end}".encode()))
    assert len(jump.layout) < len(found.layout) + 8
    parsed(data.replace(f"{end}31{end}".encode(), f"{end}9999999999{end}".encode()))
    parsed(data.replace(f"{end}31{end}".encode(), f"{end}99999999999{end}".encode()))
    odd = parsed(data.replace(b"lowerback", b"lowerback ", 3).replace(b"lradius", b"rradius", 2)[:-40])
    assert len(odd.layout) < len(found.layout) + 1000


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello",
        b"\0" * 100,
        b"HIERARCHY\n",
        header(3, 0).encode(),
        header(3, 5).encode() + b"1 2 3\n" * 9,
        b"1\n2\n3\n",
        b"1\nroot\n2\nroot\n",
        bvh([["1.0"] * 12] * 5).replace(b"OFFSET", b"OFF\1SET"),
    ],
)
def test_other_bytes_are_no_numbers(data: bytes):
    assert parse_numbers(data) is None


@LENIENT
@given(st.data())
def test_any_text_comes_back_or_is_none(draw: st.DataObject):
    write = WRITERS[draw.draw(st.sampled_from(sorted(WRITERS)))]
    values = motion(draw.draw(st.integers(1, 30)), 9 + 3 * draw.draw(st.integers(0, 2)), draw.draw(st.integers(0, 99)))
    end, behind = draw.draw(st.sampled_from(["\n", "\r\n", "\r"])), draw.draw(st.sampled_from(["", " ", "\t"]))
    data = bytearray(bvh([[write(v) for v in row] for row in values], end, behind=behind))
    for _ in range(draw.draw(st.integers(0, 4))):
        at = draw.draw(st.integers(len(data) // 2, len(data)))
        junk = draw.draw(st.sampled_from([b"x", b"\n", b"\r", b" ", b"9", b".", b"-", b"e", b"\n\n1 2\n", b"1e999", b"\xff"]))
        data[at : at + draw.draw(st.integers(0, 3))] = junk
    found = parse_numbers(bytes(data))
    assert found is None or format_numbers(found) == data


@LENIENT
@given(st.binary(max_size=300), st.integers(0, 5))
def test_arbitrary_bytes_behind_a_header(body: bytes, joints: int):
    data = header(joints + 1, 3).encode() + body
    found = parse_numbers(data)
    assert found is None or format_numbers(found) == data


@LENIENT
@given(st.data())
def test_damaged_layouts_are_refused_or_give_other_text(draw: st.DataObject):
    rows = [[with_point(v) for v in row] for row in motion(20)]
    rows[4][4] = "odd"
    found = parsed(bvh(rows))
    layout, template = bytearray(found.layout), bytearray(found.template)
    target = draw.draw(st.sampled_from([layout, template]))
    target[draw.draw(st.integers(0, len(target) - 1))] ^= draw.draw(st.integers(1, 255))
    del target[draw.draw(st.integers(len(target) // 2, len(target))) :]
    try:
        format_numbers(NumberText(bytes(template), bytes(layout), found.table))
    except JaxmocapError:
        pass


def test_a_table_of_other_columns_is_refused():
    few, many = (parsed(bvh([[f"{v:.4f}" for v in row] for row in motion(9, n)])) for n in (9, 12))
    with pytest.raises(CorruptStream, match="12 columns for a row of 9"):
        format_numbers(NumberText(few.template, few.layout, many.table))


@pytest.mark.parametrize("name", ["cmu_bvh/09/09_06.bvh", "cmu_daz/martial/04.bvh"])
def test_real_bvh(data_dir: Path, name: str):
    found = parsed((data_dir / name).read_bytes())
    values = np.asarray(read_motion(data_dir / name).values)
    assert np.abs(found.table.integers / 10.0**found.table.decimals - values).max() < 1.01e-4


def test_real_subjects_have_one_template_and_no_layout(data_dir: Path):
    texts = [parsed(file.read_bytes()) for file in sorted((data_dir / "cmu_bvh/09").glob("*.bvh"))]
    assert len({text.template for text in texts}) == 1
    assert sum(len(text.layout) for text in texts) < 150


def test_real_amc(data_dir: Path):
    for file in sorted((data_dir / "cmu_amc/16").glob("*.amc")):
        text = parsed(file.read_bytes())
        assert len(text.layout) < 3 * text.table.integers.size // 8, "extra digits are not packed"
