"""BVH: byte exactness, exact numbers, forward kinematics against pybvh, odd but valid texts, and refusals by line."""

import re
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pybvh
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmocap.errors import FormatError
from jaxmocap.formats import bvh, read_motion, text, write_motion
from jaxmocap.kinematics import pose
from jaxmocap.motion import Motion
from jaxmocap.skeleton import Skeleton

SMALL = b"""HIERARCHY
ROOT Hips
{
\tOFFSET 0 0 0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
\tJOINT Arm
\t{
\t\tOFFSET 1 2 3
\t\tCHANNELS 3 Zrotation Yrotation Xrotation
\t\tEnd Site
\t\t{
\t\t\tOFFSET 0 1 0
\t\t}
\t}
}
MOTION
Frames: 2
Frame Time: .0083333
1.5 -0.0000 3 4 5 6 7 8 9
1e1 2 3 4.25 5 -6.5E-1 7 8 9
"""


def parse(data: bytes) -> Motion:
    return bvh.parse_bvh(data, "odd.bvh")


def assert_same_motion(a: Motion, b: Motion, tolerance: float) -> None:
    assert a.skeleton.same_rig(b.skeleton)
    np.testing.assert_allclose(a.skeleton.offsets, b.skeleton.offsets, rtol=1e-15)
    np.testing.assert_allclose(a.skeleton.end_offsets, b.skeleton.end_offsets, rtol=1e-15)
    np.testing.assert_allclose(a.values, b.values, rtol=0, atol=tolerance)
    assert a.frame_time == b.frame_time


@pytest.mark.parametrize("folder", ["cmu_bvh", "cmu_daz"])
def test_every_real_file_writes_back_byte_for_byte_with_exact_numbers(data_dir: Path, folder: str):
    files = sorted((data_dir / folder).rglob("*.bvh"))
    assert files
    for file in files:
        data = file.read_bytes()
        motion = bvh.parse_bvh(data, str(file))
        assert bvh.format_bvh(motion) == data
        body = re.search(rb"Frame Time:\s*\S+", data)
        assert body is not None
        expected = np.array(list(map(float, data[body.end() :].split())))
        assert np.array_equal(expected.view(np.int64), motion.values.ravel().view(np.int64)), file


@pytest.mark.parametrize("name", ["cmu_bvh/05/05_01.bvh", "cmu_bvh/09/09_10.bvh", "cmu_daz/martial/03.bvh"])
def test_kinematics_of_real_files_agree_with_pybvh(data_dir: Path, name: str):
    with jax.enable_x64(True):
        motion = bvh.read_bvh(data_dir / name)
        found = pose(motion)
        theirs = pybvh.read_bvh_file(data_dir / name, world_up="+y")
        wanted = theirs.node_positions()
        is_end = np.array([n.is_end_site() for n in theirs.nodes])
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(found.positions, wanted[:, ~is_end], rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(found.ends, wanted[:, is_end], rtol=0, atol=1e-9 * scale)


coordinate = st.integers(-2_000_000, 2_000_000).map(lambda n: n / 10_000)
order = st.permutations(["Xrotation", "Yrotation", "Zrotation"])


@st.composite
def plain_motions(draw: st.DrawFn) -> Motion:
    """Motions that pybvh can read: one root with six channels, three rotations a joint, joints in depth-first order."""
    joints = draw(st.integers(2, 7))
    parents, path = [-1], [0]
    for j in range(1, joints):
        path = path[: draw(st.integers(1, len(path)))]
        parents.append(path[-1])
        path.append(j)
    leaves = [j for j in range(joints) if j not in parents]
    channels = [["Xposition", "Yposition", "Zposition", *draw(order)], *(draw(order) for _ in range(joints - 1))]
    vectors = draw(st.lists(st.tuples(*[coordinate] * 3), min_size=joints + len(leaves), max_size=joints + len(leaves)))
    vectors[0] = (0.0, 0.0, 0.0)  # pybvh adds the root's offset to its position channels
    names = [f"j{j}" for j in range(joints)]
    offsets, ends = np.array(vectors[:joints]), np.array(vectors[joints:])
    skeleton = Skeleton(names, parents, offsets, channels, leaves, ends)
    width = skeleton.channel_count
    rows = draw(st.lists(st.lists(coordinate, min_size=width, max_size=width), min_size=1, max_size=3))
    return Motion(skeleton, np.array(rows), 0.0125)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(plain_motions())
def test_a_new_file_reads_back(motion: Motion):
    assert_same_motion(motion, parse(bvh.format_bvh(motion)), 1e-12)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(plain_motions())
def test_kinematics_of_a_new_file_agree_with_pybvh(tmp_path_factory: pytest.TempPathFactory, motion: Motion):
    path = tmp_path_factory.mktemp("bvh") / "new.bvh"
    write_motion(motion, path)
    theirs = pybvh.read_bvh_file(path, world_up="+y").joint_positions()
    with jax.enable_x64(True):
        found = pose(read_motion(path)).positions
    np.testing.assert_allclose(found, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max() + 1e-12)


def test_small_file():
    motion = parse(SMALL)
    assert motion.skeleton.names == ("Hips", "Arm")
    assert motion.skeleton.parents == (-1, 0)
    assert motion.skeleton.end_joints == (1,)
    assert motion.skeleton.offsets.tolist() == [[0, 0, 0], [1, 2, 3]]
    assert motion.frame_time == 0.0083333
    assert motion.values[1].tolist() == [10, 2, 3, 4.25, 5, -0.65, 7, 8, 9]
    assert np.signbit(motion.values[0, 1])
    assert bvh.format_bvh(motion) == SMALL
    assert bvh.parse_bvh(SMALL, "x", unit_cm=2.5).unit_cm == 2.5


ODD = {
    "CRLF": SMALL.replace(b"\n", b"\r\n"),
    "CR": SMALL.replace(b"\n", b"\r"),
    "mixed line ends": SMALL.replace(b"\n", b"\r\n", 7),
    "byte order mark": b"\xef\xbb\xbf" + SMALL,
    "no final line end": SMALL.rstrip(),
    "trailing blank lines": SMALL + b"\n \t\n\n",
    "leading blank lines": b"\n\n" + SMALL,
    "blank lines and spaces": SMALL.replace(b"\n", b"  \n\n"),
    "tabs between values": SMALL.replace(b"7 8 9", b"7\t8\t\t9"),
    "frames wrapped": SMALL.replace(b"3 4 5", b"3\n4 5"),
    "frames on one line": SMALL.replace(b"9\n1e1", b"9 1e1"),
    "a value a line": SMALL.replace(b" 8 9", b"\n8\n9"),
    "lower case": SMALL.replace(b"MOTION", b"motion").replace(b"Frames:", b"frames:").replace(b"ROOT", b"Root"),
    "lower-case channels": SMALL.replace(b"Zrotation", b"zrotation").replace(b"Xposition", b"XPOSITION"),
    "upper-case labels": SMALL.replace(b"Frame Time:", b"FRAME TIME:").replace(b"End Site", b"END SITE"),
    "no space behind labels": SMALL.replace(b"Frames: ", b"Frames:").replace(b"Time: ", b"Time:\t"),
    "named end site": SMALL.replace(b"End Site", b"End Site tip of arm"),
    "braces on the line": SMALL.replace(b"Hips\n{", b"Hips {").replace(b"Arm\n\t{", b"Arm{"),
    "brace of an end site on the line": SMALL.replace(b"Site\n\t\t{", b"Site{"),
    "one line": SMALL.split(b"MOTION")[0].replace(b"\n", b" ") + b"MOTION" + SMALL.split(b"MOTION")[1],
    "signs": SMALL.replace(b" 8 9", b" +8 9."),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_texts_say_the_same_motion(kind: str):
    motion = parse(ODD[kind])
    assert_same_motion(parse(SMALL), motion, 0)
    assert bvh.format_bvh(motion) == ODD[kind]


def test_names_with_spaces_and_twice():
    motion = parse(SMALL.replace(b"ROOT Hips", b"ROOT  Left hip 1 ").replace(b"JOINT Arm", b"JOINT Left hip 1"))
    assert motion.skeleton.names == ("Left hip 1", "Left hip 1")
    assert bvh.parse_bvh(SMALL.replace(b"Arm", "\xc9paule".encode()), "x").skeleton.names[1] == "\xc9paule"
    assert bvh.parse_bvh(SMALL.replace(b"Arm", b"\xc9paule"), "x").skeleton.names[1] == "\xc9paule"


def test_any_channels_on_any_joint_and_several_roots():
    data = b"""HIERARCHY
ROOT A
{
OFFSET 0 0 0
CHANNELS 1 Yrotation
JOINT B
{
OFFSET 1 0 0
JOINT C
{
OFFSET 0 1 0
CHANNELS 6 Xrotation Zposition Yrotation Xposition Zrotation Yposition
End Site
{
OFFSET 0 0 1
}
End Site
{
OFFSET 0 0 2
}
}
}
End Site
{
OFFSET 5 5 5
}
}
ROOT D
{
CHANNELS 2 Xrotation Xposition
OFFSET 7 8 9
}
MOTION
Frames: 1
Frame Time: 1
1 2 3 4 5 6 7 8 9
"""
    motion = parse(data)
    skeleton = motion.skeleton
    assert skeleton.parents == (-1, 0, 1, -1)
    assert skeleton.roots == (0, 3)
    assert [len(c) for c in skeleton.channels] == [1, 0, 6, 2]
    assert skeleton.channels[2] == ("Xrotation", "Zposition", "Yrotation", "Xposition", "Zrotation", "Yposition")
    assert skeleton.end_joints == (0, 2, 2)
    assert skeleton.end_offsets.tolist() == [[5, 5, 5], [0, 0, 1], [0, 0, 2]]
    assert bvh.format_bvh(motion) == data
    rebuilt = Motion(skeleton, motion.values, motion.frame_time)
    assert_same_motion(motion, parse(bvh.format_bvh(rebuilt)), 0)
    positions = np.asarray(pose(motion).positions[0])
    np.testing.assert_allclose(positions[3], [9, 8, 9], rtol=1e-6)  # Xposition replaces that component of the offset
    turn = np.deg2rad(1)
    local = np.array([5 + 1, 7, 3])
    wanted = [np.cos(turn) * local[0] + np.sin(turn) * local[2], 7, np.cos(turn) * local[2] - np.sin(turn) * local[0]]
    np.testing.assert_allclose(positions[2], wanted, rtol=1e-6)


def test_only_changed_tokens_change():
    motion = parse(SMALL.replace(b"\n", b"\r\n"))
    values = motion.values.copy()
    values[0, 1] = 0.0  # was -0.0000: another number
    values[1, 5] = 12.3456789
    written = bvh.format_bvh(motion.with_values(values))
    wanted = SMALL.replace(b"-0.0000", b"0.0000").replace(b"-6.5E-1", b"12.3457").replace(b"\n", b"\r\n")
    assert written == wanted
    assert bvh.format_bvh(parse(written)) == written


def test_changed_frame_count_and_frame_time_keep_the_header():
    motion = parse(SMALL)
    longer = Motion(motion.skeleton, np.vstack([motion.values] * 2), 0.25, None, motion.source)
    written = bvh.format_bvh(longer)
    assert written.startswith(SMALL.split(b"Frames")[0] + b"Frames: 4\nFrame Time: 0.25\n")
    assert_same_motion(longer, parse(written), 0)


def test_changed_offsets_and_float32_values_are_written():
    motion = parse(SMALL)
    moved = eqx.tree_at(lambda m: m.skeleton.offsets, motion, motion.skeleton.offsets * 2)
    assert parse(bvh.format_bvh(moved)).skeleton.offsets[1].tolist() == [2, 4, 6]
    single = motion.with_values(motion.values.astype(np.float32))
    assert_same_motion(motion, parse(bvh.format_bvh(single)), 1e-6)


def test_values_that_no_reader_takes_are_not_written(tmp_path: Path):
    motion = parse(SMALL)
    (tmp_path / "out.bvh").write_bytes(b"before")
    with pytest.raises(FormatError, match="value 3 of frame 1 is not finite"):
        values = motion.values.copy()
        values[1, 3] = np.nan
        write_motion(motion.with_values(values), tmp_path / "out.bvh")
    assert [p.name for p in tmp_path.iterdir()] == ["out.bvh"]
    assert (tmp_path / "out.bvh").read_bytes() == b"before"


def test_what_was_read_cannot_be_overwritten_in_place():
    with pytest.raises(ValueError, match="read-only"):
        parse(SMALL).values[0, 0] = 1.0


def lines_of(**changes: str) -> bytes:
    """SMALL with line N replaced, for each argument `lN`."""
    lines = SMALL.decode().split("\n")
    for key, line in changes.items():
        lines[int(key[1:]) - 1] = line
    return "\n".join(lines).encode()


@pytest.mark.parametrize(
    ("data", "line", "message"),
    [
        (b"HELLO" + SMALL, 1, "begins with HIERARCHY"),
        (lines_of(l2="JOINT Hips"), 2, "ROOT or MOTION"),
        (lines_of(l3=""), 4, "'{' belongs"),
        (lines_of(l4="OFFSET 0 0"), 5, "'CHANNELS' is not a finite number"),
        (lines_of(l4="OFFSET 0 0 0 0"), 4, "where OFFSET"),
        (lines_of(l4=""), 15, "no OFFSET"),
        (lines_of(l4="OFFSET nan 0 0"), 4, "not a finite number"),
        (lines_of(l4="OFFSET 1e999 0 0"), 4, "too large"),
        (lines_of(l9="CHANNELS 3 Zrotation Zrotation Xrotation"), 9, "Zrotation twice"),
        (lines_of(l9="CHANNELS 3 Zrotation Xrotation"), 10, "'End' is no channel"),
        (lines_of(l9="CHANNELS 2 Zrotation Yrotation Xrotation"), 9, "'Xrotation' where"),
        (lines_of(l9="CHANNELS 3 Zrotation Yrotation Wrotation"), 9, "'Wrotation' is no channel"),
        (lines_of(l9="CHANNELS -1"), 9, "not a whole number"),
        (lines_of(l9="CHANNELS 99999999999999"), 9, "not a whole number"),
        (lines_of(l10="End Site", l12="CHANNELS 0"), 12, "one OFFSET"),
        (lines_of(l15="}\n}"), 16, "ROOT or MOTION"),
        (lines_of(l15=""), 16, "'MOTION' where"),
        (lines_of(l16=""), 17, "'Frames:' where"),
        (lines_of(l17=""), 18, "'Frames:' with its number"),
        (lines_of(l17="Frames: two"), 17, "not a whole number"),
        (lines_of(l17="Frames: 0"), 17, "at least one frame"),
        (lines_of(l17="Frames: 3"), 17, "says 3, but 2 frames"),
        (lines_of(l17="Frames: 1"), 17, "says 1, but 2 frames"),
        (lines_of(l17="Frames: 999999999999"), 17, "but 2 frames"),
        (lines_of(l17="Frames: 9999999999999"), 17, "not a whole number"),
        (lines_of(l18="1 2 3"), 18, "'Frame Time:'"),
        (lines_of(l18="Frame Time: 0"), 18, "above 0"),
        (lines_of(l18="Frame Time: -1"), 18, "above 0"),
        (lines_of(l18="Frame Time: inf"), 18, "not a finite number"),
        (lines_of(l18="Frame Time:"), 18, "'' is not a finite number"),
        (lines_of(l19="1 2 3 4 5 6 7 8"), 20, "ends after 17 values"),
        (lines_of(l20="1 2 3 4 5 6 7 8"), 20, "ends after 17 values"),
        (lines_of(l20="1 2 3 4 5 6 7 8 9 10"), 20, "behind the last"),
        (lines_of(l17="Frames: 3", l20="1 2 3 4 5 6 7 8 9\n1 2 3"), 21, "3 values, wanted 9, .*is the file cut"),
        (lines_of(l20="1 2 3 4 nan 6 7 8 9"), 20, "'nan' is not a finite number"),
        (lines_of(l20="1 2 3 4 -inf 6 7 8 9"), 20, "'-inf' is not"),
        (lines_of(l20="1 2 3 4 1e999 6 7 8 9"), 20, "too large"),
        (lines_of(l20="1 2 3 4 1_0 6 7 8 9"), 20, "'1_0' is not"),
        (lines_of(l20="1 2 3 4 1,5 6 7 8 9"), 20, "'1,5' is not"),
        (lines_of(l20="1 2 3 4 0x1p3 6 7 8 9"), 20, "is not"),
        (lines_of(l20="1 2 3 4 . 6 7 8 9"), 20, "'.' is not"),
        (lines_of(l20="1 2 3 4 - 6 7 8 9"), 20, "'-' is not"),
        (lines_of(l20="1 2 3 4 1.2.3 6 7 8 9"), 20, "'1.2.3' is not"),
        (lines_of(l20="1 2 3 4 5-6 7 8 9 1"), 20, "'5-6' is not"),
        (lines_of(l20="1 2 3 4 " + "5" * 100_000 + "x 6 7 8 9"), 20, "is not a finite number"),
        (SMALL[:90], 5, "no channel"),
        (SMALL[: SMALL.index(b"End Site")], 9, "cut short"),
        (SMALL[: SMALL.index(b"1.5")], 18, "ends after 0 values"),
        (SMALL.replace(b"Hips", b"Hi\0s"), 2, "binary"),
        (SMALL.replace(b"\n", b"\r\n").replace(b"4.25", b"x"), 20, "'x' is not"),
        (SMALL.replace(b"\n", b"\r").replace(b"4.25", b"x"), 20, "'x' is not"),
    ],
)
def test_refusals_name_file_line_and_mend(data: bytes, line: int, message: str):
    with pytest.raises(FormatError, match=rf"^odd\.bvh, line {line}: .*{message}"):
        parse(data)


@pytest.mark.parametrize("data", [b"", b" \n\n\t"])
def test_empty_files(data: bytes):
    with pytest.raises(FormatError, match="odd.bvh: the file is empty"):
        parse(data)


def test_motion_without_channels_or_joints():
    with pytest.raises(FormatError, match="line 1: MOTION before any ROOT"):
        parse(b"HIERARCHY MOTION\nFrames: 1\nFrame Time: 1\n")
    with pytest.raises(FormatError, match="line 2: no joint has a channel"):
        parse(b"HIERARCHY ROOT a\n{ OFFSET 0 0 0 } MOTION\nFrames: 1\nFrame Time: 1\n")


def test_channels_behind_a_child():
    with pytest.raises(FormatError, match="line 5: CHANNELS behind a child"):
        parse(b"HIERARCHY\nROOT a\n{ OFFSET 0 0 0 JOINT b\n{ OFFSET 0 0 0 }\nCHANNELS 1 Xrotation }")


@pytest.mark.parametrize("depth", [1000, 1001, 50_000])
def test_deep_nesting(depth: int):
    block = b"{ OFFSET 0 1 0 CHANNELS 1 Xrotation\n"
    data = b"HIERARCHY\nROOT a\n" + block + (b"JOINT b\n" + block) * (depth - 1) + b"}" * depth
    data += b"\nMOTION\nFrames: 1\nFrame Time: 1\n" + b"1 " * depth
    if depth > bvh.MAX_DEPTH:
        with pytest.raises(FormatError, match="more than 1000 deep"):
            parse(data)
    else:
        motion = parse(data)
        assert_same_motion(motion, parse(bvh.format_bvh(Motion(motion.skeleton, motion.values, 1.0))), 0)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False) | coordinate, min_size=1), st.sampled_from("gfre"))
def test_bulk_numbers_are_what_float_says(values: list[float], style: str):
    spelt = [repr(v) if style == "r" else f"{v:{style}}" for v in values]
    data = " ".join(spelt).encode()
    expected = np.array([float(s) for s in spelt])
    assert np.array_equal(text.numbers(data, 0, "x").view(np.int64), expected.view(np.int64))
    starts, ends = text.token_spans(data, 0)
    assert [data[s:e].decode() for s, e in zip(starts, ends, strict=True)] == spelt


def test_bulk_numbers_across_blocks():
    rng = np.random.default_rng(1)
    spelt = [f"{v:.{d}f}" for v, d in zip(rng.normal(size=60_000) * 100, rng.integers(0, 9, 60_000), strict=True)]
    data = "\n".join(spelt).encode()
    expected = np.array([float(s) for s in spelt])
    assert np.array_equal(text.numbers(data, 0, "x").view(np.int64), expected.view(np.int64))
    starts, ends = text.token_spans(data, 0)
    assert [data[s:e].decode() for s, e in zip(starts.tolist(), ends.tolist(), strict=True)] == spelt
