"""ASF and AMC: byte exactness, the motion of the CMU conversion to BVH, the order of dofs, and refusals by line."""

from pathlib import Path

import jax
import numpy as np
import pytest

from jaxmocap.errors import FormatError
from jaxmocap.formats import acclaim, asf, bvh, read_motion, write_motion
from jaxmocap.kinematics import pose
from jaxmocap.motion import Motion

ASF = b"""# a comment
:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name hand
     direction 0 0 1
     length 0.5
     axis 0 0 0 XYZ
    dof rz
  end
  begin
     id 2
     name arm
     direction 1 0 0
     length 2
     axis 0 90 0 XYZ
    dof rx ry
    limits (-10.0 170.0)
           (-10.0 170.0)
  end
  begin
     id 3
     name hip
     direction 0 -1 0
     length 3
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root arm hip
    arm hand
  end
"""

AMC = b"""#!OML:ASF
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
arm 40 50
hand -0.0
2
hand 6e1
root 1.5 2 3 10 20 3.25
arm 40.5 -50
"""


def parse(data: bytes, skeleton: bytes = ASF) -> Motion:
    return acclaim.parse_amc(data, "odd.amc", asf.parse_asf(skeleton, "odd.asf"))


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def test_every_real_file_writes_back_byte_for_byte(data_dir: Path):
    files = sorted((data_dir / "cmu_amc").rglob("*.amc"))
    assert files
    for file in files:
        motion = acclaim.read_amc(file)
        assert acclaim.format_amc(motion) == file.read_bytes(), file
        assert isinstance(motion.source, acclaim.AmcSource)
        assert motion.source.asf.data == acclaim.find_asf(file).read_bytes()


def test_real_numbers_are_what_float_says(data_dir: Path):
    file = data_dir / "cmu_amc" / "05" / "05_01.amc"
    motion = acclaim.read_amc(file)
    names, first = motion.skeleton.names, motion.skeleton.first_column
    frame = -1
    for line in file.read_text().splitlines()[3:]:
        name, *numbers = line.split()
        if not numbers:
            frame += 1
            continue
        start, count = first[names.index(name)], len(numbers)
        values = [float(v) for v in numbers]
        wanted = values[:3] + values[:2:-1] if name == "root" else values[::-1]
        assert motion.values[frame, start : start + count].tolist() == wanted


# Each ASF bone begins where this BVH joint stands.
TWINS = dict(
    root="Hips", lhipjoint="LHipJoint", lfemur="LeftUpLeg", ltibia="LeftLeg", lfoot="LeftFoot", ltoes="LeftToeBase",
    rhipjoint="RHipJoint", rfemur="RightUpLeg", rtibia="RightLeg", rfoot="RightFoot", rtoes="RightToeBase",
    lowerback="LowerBack", upperback="Spine", thorax="Spine1", lowerneck="Neck", upperneck="Neck1", head="Head",
    lclavicle="LeftShoulder", lhumerus="LeftArm", lradius="LeftForeArm", lwrist="LeftHand", lhand="LeftFingerBase",
    lfingers="LeftHandIndex1", lthumb="LThumb", rclavicle="RightShoulder", rhumerus="RightArm", rradius="RightForeArm",
    rwrist="RightHand", rhand="RightFingerBase", rfingers="RightHandIndex1", rthumb="RThumb",
)  # fmt: skip
# The conversion to BVH left out the length of these bones, so their children begin where they do.
SHORTENED = ("thorax", "lwrist", "rwrist")


@pytest.mark.parametrize("name", ["05_01", "02_01", "06_01"])
def test_positions_are_those_of_the_conversion_to_bvh(data_dir: Path, name: str):
    subject = name[:2]
    ours = acclaim.read_amc(data_dir / "cmu_amc" / subject / f"{name}.amc")
    theirs = bvh.read_bvh(data_dir / "cmu_bvh" / subject / f"{name}.bvh").frames(1)  # frame 0 is an inserted T-pose
    frames = min(ours.frame_count, theirs.frame_count)
    assert frames > 300
    skeleton = ours.skeleton
    offsets = skeleton.offsets.copy()
    for j, parent in enumerate(skeleton.parents):
        if skeleton.names[parent] in SHORTENED and parent >= 0:
            offsets[j] = 0
    with jax.enable_x64(True):
        short = asf.Skeleton(
            skeleton.names, skeleton.parents, offsets, skeleton.channels,
            skeleton.end_joints, skeleton.end_offsets, skeleton.axes,
        )  # fmt: skip
        a = np.asarray(pose(Motion(short, ours.values, ours.frame_time)).positions)[:frames]
        b = np.asarray(pose(theirs).positions)[:frames]
    twins = [theirs.skeleton.names.index(TWINS[n]) for n in skeleton.names]
    assert np.linalg.norm(a - b[:, twins], axis=-1).max() < 2e-4  # angles of 4 decimals, bones of 5


def test_small_skeleton_and_motion():
    motion = parse(AMC)
    skeleton = motion.skeleton
    assert skeleton.names == ("root", "arm", "hand", "hip")  # parents first, else the order of :bonedata
    assert skeleton.parents == (-1, 0, 1, 0)
    assert skeleton.channels[0] == ("Xposition", "Yposition", "Zposition", "Zrotation", "Yrotation", "Xrotation")
    assert skeleton.channels[1:] == (("Yrotation", "Xrotation"), ("Zrotation",), ())
    assert skeleton.offsets.tolist() == [[0, 0, 0], [0, 0, 0], [2, 0, 0], [0, 0, 0]]
    assert skeleton.end_joints == (2, 3)
    assert skeleton.end_offsets.tolist() == [[0, 0, 0.5], [0, -3, 0]]
    assert motion.values.tolist() == [[1, 2, 3, 30, 20, 10, 50, 40, 0], [1.5, 2, 3, 3.25, 20, 10, -50, 40.5, 60]]
    assert np.signbit(motion.values[0, 8])
    assert motion.frame_time == 1 / 120
    assert acclaim.format_amc(motion) == AMC
    c = turn("y", 90)
    root = turn("z", 30) @ turn("y", 20) @ turn("x", 10)
    arm = root @ c @ turn("y", 50) @ turn("x", 40) @ c.T
    found = pose(motion)
    np.testing.assert_allclose(found.positions[0, 2], [1, 2, 3] + arm @ [2, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(found.ends[0, 0], [1, 2, 3] + arm @ [2, 0, 0.5], rtol=1e-5)


def test_axis_orders_and_root_orientation():
    text = ASF.replace(b"axis 0 90 0 XYZ", b"axis 10 20 30 ZXY").replace(b"orientation 0 0 0", b"orientation 1 2 3")
    axes = asf.parse_asf(text, "x").skeleton.axes
    np.testing.assert_allclose(axes[1], turn("y", 30) @ turn("x", 20) @ turn("z", 10), atol=1e-15)
    np.testing.assert_allclose(axes[0], turn("z", 3) @ turn("y", 2) @ turn("x", 1), atol=1e-15)


def test_radians():
    skeleton = ASF.replace(b"angle deg", b"angle rad").replace(b"axis 0 90 0", b"axis 0 1.5707963267948966 0")
    text = AMC.replace(b":DEGREES", b":RADIANS")
    motion = parse(text, skeleton)
    np.testing.assert_allclose(motion.skeleton.axes[1], turn("y", 90), atol=1e-15)
    assert motion.values[0].tolist() == [1, 2, 3, *np.rad2deg([30, 20, 10, 50, 40, 0.0])]
    assert acclaim.format_amc(motion) == text
    values = motion.values.copy()
    values[0, 3] = 180
    assert acclaim.format_amc(motion.with_values(values)) == text.replace(b"20 30\n", b"20 3.14159265\n")


def test_translation_dofs_move_from_the_bone():
    skeleton = ASF.replace(b"dof rz", b"dof ty rz")
    text = AMC.replace(b"hand -0.0", b"hand 0.25 -0.0").replace(b"hand 6e1", b"hand 0 6e1")
    motion = parse(text, skeleton)
    assert motion.skeleton.channels[2] == ("Yposition", "Zrotation")
    assert motion.values[:, 8].tolist() == [0.25, 0]
    skeleton = skeleton.replace(b"direction 1 0 0", b"direction 0 1 0")
    motion = parse(text, skeleton)
    assert motion.values[:, 8].tolist() == [2.25, 2]
    assert acclaim.format_amc(motion) == text
    values = motion.values.copy()
    values[0, 8] = 3
    assert acclaim.format_amc(motion.with_values(values)) == text.replace(b"hand 0.25", b"hand 1.000000")


@pytest.mark.parametrize("ends", [b"\r\n", b"\r", b"\n\n"])
def test_line_ends_and_spaces(ends: bytes):
    text = b"\xef\xbb\xbf" + AMC.replace(b" ", b"\t  ").replace(b"\n", b" " + ends)
    motion = parse(text, ASF.replace(b"\n", ends))
    assert np.array_equal(motion.values, parse(AMC).values)
    assert acclaim.format_amc(motion) == text
    values = motion.values.copy()
    values[1, 5] = 11
    old, new = b"root\t  1.5\t  2\t  3\t  10", b"root\t  1.5\t  2\t  3\t  11.000000"
    assert acclaim.format_amc(motion.with_values(values)) == text.replace(old, new)


def test_only_changed_tokens_change():
    motion = parse(AMC)
    values = motion.values.copy()
    values[1, 7], values[0, 8] = 41.23456789, 0.0
    written = acclaim.format_amc(motion.with_values(values))
    assert written == AMC.replace(b"40.5", b"41.234568").replace(b"-0.0", b"0.000000")


def test_other_frame_counts_and_no_source_read_back():
    motion = parse(AMC)
    longer = motion.with_values(np.vstack([motion.values, motion.values + 1]))
    again = parse(acclaim.format_amc(longer))
    np.testing.assert_allclose(again.values, longer.values, atol=1e-6)
    assert acclaim.format_amc(longer).startswith(b"#!OML:ASF\n:FULLY-SPECIFIED\n:DEGREES\n1\nroot 1.000000")


def test_written_pair_reads_back(tmp_path: Path, data_dir: Path):
    original = acclaim.read_amc(data_dir / "cmu_amc" / "06" / "06_01.amc")
    write_motion(original, tmp_path / "kept_01.amc")
    assert (tmp_path / "kept_01.asf").read_bytes() == (data_dir / "cmu_amc" / "06" / "06.asf").read_bytes()
    assert (tmp_path / "kept_01.amc").read_bytes() == (data_dir / "cmu_amc" / "06" / "06_01.amc").read_bytes()
    bare = Motion(original.skeleton, original.values, original.frame_time)
    write_motion(bare, tmp_path / "new.amc")
    again = read_motion(tmp_path / "new.amc")
    assert again.skeleton.names == original.skeleton.names
    assert again.skeleton.channels == original.skeleton.channels
    np.testing.assert_allclose(again.skeleton.axes, original.skeleton.axes, atol=1e-12)
    np.testing.assert_allclose(again.skeleton.offsets, original.skeleton.offsets, atol=1e-12)
    np.testing.assert_allclose(again.values, original.values, atol=1e-6)


def test_amc_becomes_bvh(data_dir: Path):
    original = acclaim.read_amc(data_dir / "cmu_amc" / "05" / "05_01.amc")
    converted = bvh.parse_bvh(bvh.format_bvh(original), "x")
    order = [converted.skeleton.names.index(n) for n in original.skeleton.names]
    with jax.enable_x64(True):
        wanted, found = np.asarray(pose(original).positions), np.asarray(pose(converted).positions)
    np.testing.assert_allclose(found[:, order], wanted, atol=1e-6)


def test_the_skeleton_is_found_beside(tmp_path: Path):
    path = tmp_path / "07_01.amc"
    path.write_bytes(AMC)
    with pytest.raises(FormatError, match="put 07_01.asf beside it"):
        read_motion(path)
    other = ASF.replace(b"length 2", b"length 7")
    (tmp_path / "any.asf").write_bytes(other)
    assert read_motion(path).skeleton.offsets[2, 0] == 7
    (tmp_path / "07.asf").write_bytes(ASF)
    assert read_motion(path).skeleton.offsets[2, 0] == 2
    (tmp_path / "07_01.asf").write_bytes(other)
    assert read_motion(path, unit_cm=5.6444).unit_cm == 5.6444
    assert read_motion(path).skeleton.offsets[2, 0] == 7
    assert acclaim.read_amc(path, asf=tmp_path / "07.asf").skeleton.offsets[2, 0] == 2
    assert acclaim.read_asf(tmp_path / "07.asf").names == ("root", "arm", "hand", "hip")
    with pytest.raises(FormatError, match="give the .amc"):
        read_motion(tmp_path / "07.asf")


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (b"arm 40 50", b"leg 40 50", 6, "'leg' is not in the ASF"),
        (b"arm 40 50", b"arm 40", 6, "'arm' has 1 values; its dof in the ASF has 2"),
        (b"arm 40 50", b"arm 40 50 60", 6, "has 3 values"),
        (b"arm 40 50", b"hip 1", 6, "has 1 values; its dof in the ASF has 0"),
        (b"arm 40 50\n", b"", 4, "frame 1 lacks 'arm'"),
        (b"arm 40.5 -50\n", b"", 8, "frame 2 lacks 'arm'"),
        (b"arm 40 50", b"root 1 2 3 4 5 6", 6, "'root' stands twice"),
        (b"arm 40 50", b"arm nan 50", 6, "'nan' is not a finite"),
        (b"arm 40 50", b"arm 1e999 50", 6, "too large"),
        (b"arm 40 50", b"arm 1_0 50", 6, "'1_0' is not"),
        (b"\n2\n", b"\n3\n", 8, "frame 3 follows frame 1; wanted frame 2"),
        (b"\n2\n", b"\n" + b"2" * 5000 + b"\n", 8, "not a whole number"),
        (b":DEGREES\n", b"DEGREES\n", 3, "'DEGREES' where"),
        (b"#!OML", b"\0", 1, "binary"),
    ],
)
def test_amc_refusals(old: bytes, new: bytes, line: int, message: str):
    with pytest.raises(FormatError, match=rf"^odd\.amc, line {line}: .*{message}"):
        parse(AMC.replace(old, new))


@pytest.mark.parametrize("data", [b"", b":DEGREES\n", b"# nothing\n"])
def test_amc_without_frames(data: bytes):
    with pytest.raises(FormatError, match="odd.amc: (no frames|the file is empty)"):
        parse(data)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (b"dof rx ry", b"dof rx ry l", 27, "dof 'l' stretches"),
        (b"dof rx ry", b"dof rx rx", 27, "at most once"),
        (b"dof rx ry", b"dof rx rw", 27, "'rw'"),
        (b"dof rx ry", b"dof rx tx", 21, "slides along its own turned axes"),
        (b"axis 0 90 0 XYZ", b"axis 0 90 XYZ", 26, "not a finite number"),
        (b"axis 0 90 0 XYZ", b"axis 0 90 0 XYY", 26, "order of an axis"),
        (b"axis 0 90 0 XYZ", b"axis 0 90 0", 26, "order of an axis"),
        (b"length 2", b"length inf", 25, "'inf'"),
        (b"direction 1 0 0\n     length 2", b"direction 1e300 0 0\n     length 1e300", 21, "too long"),
        (b"name arm", b"name hand", 30, "a name of its own"),
        (b"root arm hip", b"root arm leg", 40, "'leg' is not in :bonedata"),
        (b"root arm hip", b"root arm hip hip", 40, "'hip' has two parents"),
        (b"root arm hip", b"root hip", 21, "'arm' does not hang on the root"),
        (b"root arm hip\n    arm hand", b"root hip\n hand arm\n arm hand", 13, "'hand' does not hang on the root"),
        (b"  end\n:hierarchy", b":hierarchy", 37, "no 'end'"),
        (b"  end\n  begin\n     id 3", b"  begin\n     id 3", 30, "'begin' inside a bone"),
    ],
)
def test_asf_refusals(old: bytes, new: bytes, line: int, message: str):
    with pytest.raises(FormatError, match=rf"^odd\.asf, line {line}: .*{message}"):
        parse(AMC, ASF.replace(old, new))


def test_asf_without_a_root():
    with pytest.raises(FormatError, match="no 'order' line"):
        parse(AMC, ASF.replace(b"order", b"odor"))


def test_skeletons_that_asf_cannot_say():
    motion = bvh.parse_bvh(
        b"HIERARCHY ROOT root\n{ OFFSET 0 0 0 CHANNELS 1 Xrotation JOINT a\n{ OFFSET 1 0 0 } } MOTION\n"
        b"Frames: 1\nFrame Time: 1\n5", "x"
    )
    with pytest.raises(FormatError, match="children at several places"):
        acclaim.format_amc(motion)
    with pytest.raises(FormatError, match="one root, named 'root'"):
        asf.format_asf(Motion.from_positions(np.zeros((1, 2, 3)), ["a", "b"], 1.0).skeleton)
