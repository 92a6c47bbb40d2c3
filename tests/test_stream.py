"""Live streams as they are used: real processes, pipes and sockets; then damaged, late and forged packets."""

import json
import random
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pytest

from jaxmocap.__main__ import run
from jaxmocap.codecs.bitstream import varint
from jaxmocap.codecs.live.network import Network
from jaxmocap.codecs.live.packets import NUMBERS, framed
from jaxmocap.codecs.live.playout import Playout
from jaxmocap.codecs.live.stream import Decoder, Encoder, Shown
from jaxmocap.codecs.live.tracker import REFRESH_FRAMES
from jaxmocap.codecs.live.transport import DatagramSink, DatagramSource, StreamEnd
from jaxmocap.errors import FormatError
from jaxmocap.formats import read_motion, write_motion
from jaxmocap.formats.bvh import format_bvh
from jaxmocap.formats.live import BvhReader
from jaxmocap.kinematics import positions_cm
from jaxmocap.motion import Motion
from jaxmocap.skeleton import Skeleton
from jaxmocap.synthesis import walk

UNIT = 5.6444
HALF_A_SECOND = 60  # frames
MUCH = 60.0  # seconds, for what takes a moment on a machine with time
Start = Callable[..., subprocess.Popen]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stream")
    write_motion(walk(5, 3.0), folder / "walk.bvh")
    return folder


@pytest.fixture(scope="module")
def motion(files: Path) -> Motion:
    return read_motion(files / "walk.bvh", UNIT)


@pytest.fixture(scope="module")
def clip(data_dir: Path) -> Motion:
    return read_motion(data_dir / "cmu_bvh/05/05_12.bvh", UNIT).frames(1, 541)


def packets_of(motion: Motion, mean_error: float = 0.5, repeats: int = 0) -> list[bytes]:
    encoder = Encoder(motion.skeleton, motion.frame_time, UNIT, wanted=mean_error, repeats=repeats)
    return [encoder.push(values) for values in motion.values]


def shown_of(decoder: Decoder, packets: list[bytes | None]) -> dict[int, np.ndarray]:
    """Frames by number; None stands for a packet that was lost."""
    found = (decoder.conceal() if packet is None else decoder.push(packet) for packet in packets)
    return {shown.number: shown.values for shown in found if shown is not None}


def errors(motion: Motion, skeleton: Skeleton | None, shown: dict[int, np.ndarray]) -> dict[int, float]:
    """Mean joint error of each frame, in cm."""
    assert skeleton is not None
    decoded = positions_cm(Motion(skeleton, np.array(list(shown.values())), motion.frame_time, UNIT))
    wanted = positions_cm(motion.with_values(motion.values[list(shown)]))
    found = np.linalg.norm(np.asarray(decoded) - np.asarray(wanted), axis=-1).mean(1)
    return dict(zip(shown, found.tolist(), strict=True))


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `jaxmocap stream`; none outlives its test."""
    started: list[subprocess.Popen] = []

    def one(*arguments: object, stdin: int | IO | None = None, stdout: int | None = None) -> subprocess.Popen:
        command = [sys.executable, "-m", "jaxmocap", "stream", *map(str, arguments)]
        started.append(subprocess.Popen(command, stdin=stdin, stdout=stdout, stderr=subprocess.PIPE, bufsize=0))
        return started[-1]

    yield one
    for process in started:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


def ended(process: subprocess.Popen, code: int = 0) -> str:
    """What it said on stderr."""
    assert process.stderr is not None
    process.wait(MUCH)
    said = process.stderr.read().decode()
    assert process.returncode == code, said
    return said


def listening_port(process: subprocess.Popen) -> int:
    assert process.stderr is not None
    said = process.stderr.readline().decode()
    found = re.fullmatch(r"jaxmocap: listens at (?:tcp|udp) port (\d+)\n", said)
    assert found, said
    return int(found[1])


def raw_frames(data: bytes) -> np.ndarray:
    return np.frombuffer(data, "<f4").reshape(-1, 96)


def test_a_pipe_of_two_processes_gives_what_one_gives(start: Start, files: Path, motion: Motion):
    encode = start("encode", files / "walk.bvh", "-o", "-", "--unit-cm", UNIT, "--mean-error", 0.5, stdout=subprocess.PIPE)
    decode = start("decode", "-", "-o", "-", "--format", "float32", stdin=encode.stdout, stdout=subprocess.PIPE)
    assert encode.stdout is not None
    encode.stdout.close()
    frames, said = decode.communicate(timeout=MUCH)
    assert decode.returncode == 0 and b"ms a frame" in said and "ms a frame" in ended(encode)
    wanted = shown_of(Decoder(), [*packets_of(motion)])
    assert len(wanted) > len(motion.values) - HALF_A_SECOND
    np.testing.assert_array_equal(raw_frames(frames), np.array(list(wanted.values()), np.float32))


def test_files_and_their_reports(files: Path, motion: Motion, capsys: pytest.CaptureFixture[str]):
    """Packets in a file are those of the encoder behind their lengths; BVH text has the decoded frames to its decimals."""
    arguments = [str(files / "walk.bvh"), "-o", str(files / "a.packets"), "--unit-cm", str(UNIT), "--mean-error", "0.5"]
    assert run(["stream", "encode", *arguments, "--json"]) == 0
    packets = packets_of(motion)
    data = b"".join(varint(len(packet)) + packet for packet in packets)
    assert (files / "a.packets").read_bytes() == data
    made = json.loads(capsys.readouterr().out)
    assert made["frames"] == 360 and made["packet_bytes"] == sum(map(len, packets)) and made["stream_bytes"] == len(data)
    assert made["kbit_s"] == pytest.approx(8e-3 * made["packet_bytes"] / (360 * motion.frame_time)) and made["ms_median"] > 0
    assert run(["stream", "decode", str(files / "a.packets"), "-o", str(files / "a.bvh"), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    wanted = shown_of(Decoder(), [*packets])
    decoded = read_motion(files / "a.bvh", UNIT)  # which refuses a wrong count of frames
    assert shown["frames"] == decoded.frame_count == len(wanted) and shown["concealed"] == shown["damaged"] == 0
    assert decoded.skeleton.same_rig(motion.skeleton) and decoded.frame_time == motion.frame_time
    np.testing.assert_allclose(decoded.values, np.array(list(wanted.values())), atol=5.01e-7)
    assert run(["stream", "decode", str(files / "a.packets"), "-o", str(files / "a.bvh")]) == 0
    assert "bytes of packets" in capsys.readouterr().out


def test_frames_go_out_as_lines_come_in(start: Start, files: Path, motion: Motion):
    """Nothing waits for what is to come: of two processes in a row, a line in gives a line out before the next one."""
    arguments = ("encode", "-", "-o", "-", "--unit-cm", UNIT, "--mean-error", 0.5)
    encode = start(*arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    decode = start("decode", "-", "-o", "-", stdin=encode.stdout, stdout=subprocess.PIPE)
    assert encode.stdin is not None and encode.stdout is not None and decode.stdout is not None
    encode.stdout.close()
    header, rows = bvh_parts(files / "walk.bvh")
    encode.stdin.write(re.sub(rb"Frames: \d+", b"Frames: 0", header) + b"".join(rows[:HALF_A_SECOND]))
    while not (line := next_line(decode)).startswith(b"Frame Time:"):
        assert not line.startswith(b"Frames:") or line == b"Frames: 999999999\n"
    for _ in shown_of(Decoder(), [*packets_of(motion.frames(0, HALF_A_SECOND))]):
        assert len(next_line(decode).split()) == 96
    for row in rows[HALF_A_SECOND : HALF_A_SECOND + 20]:
        encode.stdin.write(row)
        assert len(next_line(decode).split()) == 96
    encode.stdin.close()
    assert decode.stdout.read() == b""
    assert "80 frames" in ended(encode) and "frames" in ended(decode)


def bvh_parts(path: Path) -> tuple[bytes, list[bytes]]:
    """Header and rows."""
    lines = path.read_bytes().splitlines(keepends=True)
    at = next(n for n, line in enumerate(lines) if line.startswith(b"Frame Time:")) + 1
    return b"".join(lines[:at]), lines[at:]


def next_line(process: subprocess.Popen) -> bytes:
    assert process.stdout is not None and select.select([process.stdout], [], [], MUCH)[0], "no line comes out"
    return process.stdout.readline()


def test_frames_of_float32(start: Start, files: Path, motion: Motion):
    """In by standard input, cut within the last one; out to a file."""
    arguments = ("encode", "-", "-o", files / "raw.packets", "--skeleton", files / "walk.bvh", "--unit-cm", UNIT, "--start", 1)
    encode = start(*arguments, "--step", 0.5, "--metric", "joints", stdin=subprocess.PIPE)
    values = motion.values.astype("<f4")
    _, said = encode.communicate(values.tobytes()[:-8], timeout=MUCH)
    assert encode.returncode == 0 and b"94 values came" in said and b"358 frames" in said
    wanted = Encoder(motion.skeleton, motion.frame_time, UNIT, "step", 0.5, "joints")
    packets = [wanted.push(frame) for frame in values[1:-1]]
    assert (files / "raw.packets").read_bytes() == b"".join(varint(len(packet)) + packet for packet in packets)


def test_tcp_between_two_processes(start: Start, files: Path, motion: Motion):
    decode = start("decode", "tcp://:0", "-o", files / "tcp.raw", "--format", "float32")
    port = listening_port(decode)
    encode = start("encode", files / "walk.bvh", "-o", f"tcp://localhost:{port}", "--unit-cm", UNIT, "--mean-error", 0.5)
    ended(encode)
    ended(decode)
    wanted = shown_of(Decoder(), [*packets_of(motion)])
    np.testing.assert_array_equal(raw_frames((files / "tcp.raw").read_bytes()), np.array(list(wanted.values()), np.float32))


def test_what_is_cut_within_a_packet_is_kept_before_it(start: Start, files: Path, motion: Motion):
    packets = packets_of(motion.frames(0, 100))
    decode = start("decode", "tcp://:0", "-o", files / "cut.bvh")
    with socket.create_connection(("localhost", listening_port(decode))) as sender:
        data = b"".join(varint(len(packet)) + packet for packet in packets)
        for at in range(0, len(data) - 3, 7):  # in parts that end anywhere
            sender.sendall(data[at : min(at + 7, len(data) - 3)])
    said = ended(decode, 2)
    frames = len(shown_of(Decoder(), [*packets[:-1]]))
    assert f"ends within a packet; frames written before it: {frames}\n" in said
    assert read_motion(files / "cut.bvh").frame_count == frames


def relay(network: Network, through: socket.socket, sender: subprocess.Popen, receivers: list[tuple[int, int]]) -> None:
    """Hands on what a process sends, as the network lets it, to ports whose owners come after so many packets."""
    out, sent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), 0
    with out:
        while select.select([through], [], [], 0.2)[0] or sender.poll() is None:
            if not select.select([through], [], [], 0.0)[0]:
                continue
            sent += 1
            for packet in network.carry(through.recv(1 << 16)):
                for port, after in receivers:
                    if sent > after:
                        out.sendto(packet, ("127.0.0.1", port))


def test_udp_that_loses_swaps_and_repeats(start: Start, tmp_path: Path, clip: Motion):
    """Two real processes, another that comes late, and a network that loses 5 % between them."""
    write_motion(clip, tmp_path / "clip.bvh")
    late = 200
    # A machine that is busy with other tests tells the end late, too: nothing must be concealed behind it.
    options = ("--delay", 250, "--json")
    decoders = [start("decode", "udp://:0", "-o", tmp_path / f"{n}.bvh", *options, stdout=subprocess.PIPE) for n in range(2)]
    ports = [listening_port(decoder) for decoder in decoders]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as through:
        through.bind(("127.0.0.1", 0))
        arguments = ("encode", tmp_path / "clip.bvh", "-o", f"udp://127.0.0.1:{through.getsockname()[1]}", "--unit-cm", UNIT)
        encode = start(*arguments, "--mean-error", 0.5, "--pace")
        relay(Network(4, loss=0.05, swap=0.01, repeat=0.01), through, encode, [(ports[0], 0), (ports[1], late)])
    ended(encode)
    decoder = Decoder()
    clean = shown_of(decoder, [*packets_of(clip, repeats=2)])
    undisturbed = errors(clip, decoder.skeleton, clean)
    for n, process in enumerate(decoders):
        ended(process)
        assert process.stdout is not None
        report = json.loads(process.stdout.read())
        shown = read_motion(tmp_path / f"{n}.bvh", UNIT)
        first = clip.frame_count - shown.frame_count
        assert report["frames"] == shown.frame_count, "every frame is delivered from the first one on"
        assert 0 <= first - late * n <= HALF_A_SECOND and report["concealed"] > 5 and report["repeated"] > 0
        seen = {first + at: values for at, values in enumerate(shown.values)}
        error = errors(clip, shown.skeleton, seen)
        assert np.mean(list(error.values())) <= 2 * np.mean(list(undisturbed.values()))
        assert longest([error[at] > 1.25 * undisturbed[at] for at in error if at in undisturbed]) < HALF_A_SECOND


def longest(happens: list[bool]) -> int:
    """Of the runs in which something happens."""
    return max(map(len, "".join("x" if it else " " for it in happens).split()), default=0)


@pytest.mark.parametrize(("repeats", "burst"), [(0, 1), (0, 3), (2, 2), (2, 5), (0, 12), (2, 30)])
def test_half_a_second_after_a_loss_nothing_is_left_of_it(clip: Motion, repeats: int, burst: int):
    packets, decoder = packets_of(clip, repeats=repeats), Decoder()
    clean = shown_of(decoder, [*packets])
    undisturbed = errors(clip, decoder.skeleton, clean)
    for at in range(100, len(packets) - 140, 150):
        lost = [None if at <= n < at + burst else packet for n, packet in enumerate(packets)]
        shown = shown_of(decoder := Decoder(), [*lost])
        assert shown.keys() == clean.keys() and decoder.tally.concealed == burst
        error = errors(clip, decoder.skeleton, shown)
        after = range(at + burst + HALF_A_SECOND - 1, at + burst + 2 * HALF_A_SECOND)
        assert np.mean([error[n] for n in after]) <= 1.25 * np.mean([undisturbed[n] for n in after])
        if burst <= repeats:
            assert all(np.array_equal(shown[n], clean[n]) for n in range(at + burst, len(packets)))


@pytest.mark.parametrize("first", [1, 77, 300])
def test_who_joins_late_is_right_within_half_a_second(clip: Motion, first: int):
    packets, decoder = packets_of(clip), Decoder()
    undisturbed = errors(clip, decoder.skeleton, clean) if (clean := shown_of(decoder, [*packets])) else {}
    shown = shown_of(joined := Decoder(), [*packets[first:]])
    assert min(shown) <= first + HALF_A_SECOND and max(shown) == len(packets) - 1
    error = errors(clip, joined.skeleton, shown)
    after = range(first + HALF_A_SECOND, len(packets))
    assert np.mean([error[n] for n in after]) <= 1.25 * np.mean([undisturbed[n] for n in after])


def test_who_joins_after_the_numbers_went_round(motion: Motion):
    """Packets count to 4050, which is 34 seconds."""
    frames = np.concatenate([motion.values] * (NUMBERS // len(motion.values) + 1))
    packets = packets_of(motion.with_values(frames))
    assert len(packets) > NUMBERS + 180
    assert len(shown_of(Decoder(), [*packets[NUMBERS + 20 : NUMBERS + 20 + 2 * HALF_A_SECOND]])) >= HALF_A_SECOND


def flood(kind: str, packets: list[bytes]) -> list[bytes]:
    """10,000 packets of random bytes, or 10,000 with a bit flipped; or the three that get by their checksum of so many."""
    rng = random.Random(kind)
    if kind == "random":
        return [rng.randbytes(rng.randrange(60)) for _ in range(10_000)]
    if kind == "flipped":
        network = Network(6, damage=1.0)
        return [network.carry(rng.choice(packets))[0] for _ in range(10_000)]
    return [framed(rng.randrange(NUMBERS), rng.randbytes(rng.randrange(57))) for _ in range(3)]


@pytest.mark.parametrize("kind", ["random", "flipped", *(f"forged {n}" for n in (0, 1, 2, 9))])
@pytest.mark.parametrize("at", [0, 100])
def test_no_flood_is_more_than_a_loss(motion: Motion, kind: str, at: int):
    """Before the first packet, or between two."""
    packets, decoder = packets_of(motion), Decoder()
    undisturbed = errors(motion, decoder.skeleton, clean) if (clean := shown_of(decoder, [*packets])) else {}
    flooded = Decoder()
    shown_of(flooded, [*packets[:at], *flood(kind, packets)])
    shown = {number % NUMBERS: values for number, values in shown_of(flooded, [*packets[at:]]).items()}
    after = range(at + REFRESH_FRAMES + HALF_A_SECOND, len(packets))
    assert shown.keys() >= {*after}, f"{sum(n not in shown for n in after)} frames are not shown"
    error = errors(motion, flooded.skeleton, {n: shown[n] for n in after})
    assert np.mean(list(error.values())) <= 1.25 * np.mean([undisturbed[n] for n in after])


def played(playout: Playout, arrivals: list[tuple[float, bytes]]) -> list[tuple[float, Shown]]:
    """What is shown, and when, as packets arrive and time goes by."""
    seen: list[tuple[float, Shown]] = []
    for now, packet in sorted(arrivals):
        while (due := playout.due) is not None and due < now:
            seen += [(due, shown) for shown in playout.elapsed(due)]
        seen += [(now, shown) for shown in playout.arrived(packet, now)]
    return seen


@pytest.fixture(scope="module")
def packets(motion: Motion) -> list[bytes]:
    return packets_of(motion, repeats=1)


def test_what_comes_in_time_is_shown_at_once_and_in_order(motion: Motion, packets: list[bytes]):
    """Also where packets overtake each other, come twice, and where the sender's clock runs a percent slower or faster."""
    rng = random.Random(3)
    for pace in (0.99, 1.0, 1.01):
        playout = Playout(decoder := Decoder(), 0.05)
        sent = [(n * pace * motion.frame_time, packet) for n, packet in enumerate(packets)]
        arrivals = [(at + rng.choice([0.0, 0.0, 0.03]), packet) for at, packet in sent for _ in range(rng.choice([1, 1, 2]))]
        seen = played(playout, arrivals)
        assert [shown.number for _, shown in seen] == list(range(seen[0][1].number, len(packets)))
        assert decoder.tally.concealed == decoder.tally.damaged == 0
        assert all(now - sent[shown.number][0] < 0.05 for now, shown in seen)


def test_what_does_not_come_is_shown_at_its_time_without(motion: Motion, packets: list[bytes]):
    delay, lost = 0.02, {100, 101, 150}
    arrivals = [(n * motion.frame_time, packet) for n, packet in enumerate(packets) if n not in lost]
    arrivals.append((101 * motion.frame_time + 0.1, packets[101]))
    playout = Playout(decoder := Decoder(), delay)
    seen = played(playout, arrivals)
    assert [shown.number for _, shown in seen] == list(range(seen[0][1].number, len(packets)))
    assert {shown.number for _, shown in seen if shown.concealed} == lost and decoder.tally.concealed == 3
    for now, shown in seen:
        assert now <= shown.number * motion.frame_time + delay + 1e-9
    assert decoder.tally.repeated == 1, "what comes late is no news where it was told again"
    assert playout.finish(len(packets)) == []


def test_a_sender_that_pauses_is_followed_again(motion: Motion, packets: list[bytes]):
    """The figure goes on for half a second, stands still, and moves again when the sender does, or soon after."""
    arrivals = [(n * motion.frame_time + 3.0 * (n >= 100), packet) for n, packet in enumerate(packets)]
    seen = played(Playout(Decoder(), 0.02), arrivals)
    assert [shown.number for _, shown in seen] == list(range(seen[0][1].number, len(packets)))
    concealed = [shown.number for _, shown in seen if shown.concealed]
    assert concealed == list(range(100, 100 + len(concealed))) and 59 <= len(concealed) <= 61
    assert seen[-1][0] == arrivals[-1][0]


def test_the_end_of_a_stream_over_udp_is_believed_when_it_is_said_twice(packets: list[bytes]):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        here.bind(("127.0.0.1", 0))
        there.connect(here.getsockname())
        source, sink = DatagramSource(here), DatagramSink(there)
        there.send(b"\xe0\x07")
        for packet in packets[:9]:
            sink.send(packet)
        assert source.receive(1.0) is None
        assert [source.receive(1.0) for _ in range(9)] == packets[:9] and source.receive(0.0) is None
        sink.close()
        assert source.receive(1.0) is None
        with pytest.raises(StreamEnd) as end:
            source.receive(1.0)
        assert end.value.frames == 9 == sink.size - sum(map(len, packets[:9])) + 9


def test_bvh_as_it_is_written(motion: Motion):
    """Byte by byte, with any line ends, rows wrapped, and a count that nobody knew."""
    text = re.sub(rb"Frames: \d+", b"Frames: 0", format_bvh(motion.frames(0, 5)))
    wrapped = re.sub(rb"(-?\d+\.\d{6} ){7}", lambda m: m[0] + b"\n", text)
    for data in (text, text.replace(b"\n", b"\r\n"), text.replace(b"\n", b"\r"), wrapped, text.rstrip()):
        reader = BvhReader("live")
        frames = [frame for at in range(len(data)) for frame in reader.feed(data[at : at + 1])] + reader.end()
        np.testing.assert_allclose(frames, motion.values[:5], atol=5.01e-7)
        assert reader.skeleton is not None and reader.skeleton.same_rig(motion.skeleton) and reader.left == 0
        assert reader.frame_time == motion.frame_time
    reader = BvhReader("live")
    assert len(reader.feed(text[:-30])) == 4 and reader.end() == [] and 80 < reader.left < 96


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize(
    ("line", "wanted"), [(b"1 2 nan", "'nan' is not a finite number"), (b"1 " * 97, "97 values, wanted 96"), (b"1_0", "1_0")]
)
def test_a_bad_row_is_named(motion: Motion, end: bytes, line: bytes, wanted: str):
    header, rows = format_bvh(motion.frames(0, 3)).split(b"Frame Time: ")
    lines = rows.splitlines()
    data = (header + b"Frame Time: ").replace(b"\n", end) + end.join([*lines[:3], line + b" 0" * (96 - len(line.split()))])
    at = (header + b"F").count(b"\n") + 4
    reader = BvhReader("live.bvh")
    with pytest.raises(FormatError, match=f"live.bvh, line {at}: .*{wanted}"):
        for n in range(len(data)):
            reader.feed(data[n : n + 1])
        reader.end()


@pytest.mark.parametrize("signal_", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_both_end_and_keep_what_there_is(start: Start, files: Path, motion: Motion, signal_: signal.Signals):
    """A stream through a pipe that stays open; then the file that the first process wrote, through one that stays open, too."""
    header, rows = bvh_parts(files / "walk.bvh")
    encode = start("encode", "-", "-o", files / "kept.packets", "--unit-cm", UNIT, stdin=subprocess.PIPE)
    assert encode.stdin is not None
    encode.stdin.write(header + b"".join(rows[:70]))
    wait_for(lambda: b"".join(f.read_bytes() for f in files.glob(".kept.packets*")).count(b"") > 300)
    encode.send_signal(signal_)
    said = ended(encode)
    frames = int(said.split(" frames")[0])
    assert 0 < frames <= 70
    packets = (files / "kept.packets").read_bytes()
    decode = start("decode", "-", "-o", files / "kept.bvh", stdin=subprocess.PIPE)
    assert decode.stdin is not None
    decode.stdin.write(packets)
    wait_for(lambda: any(f.stat().st_size > 5000 for f in files.glob(".kept.bvh*")))
    decode.send_signal(signal_)
    shown = int(ended(decode).split(" frames")[0])
    assert read_motion(files / "kept.bvh").frame_count == shown > 0
    assert not [*files.glob(".kept*")]


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + MUCH
    while not condition():
        assert time.monotonic() < until, "it does not happen"
        time.sleep(0.02)


def test_a_reader_that_goes_away_ends_a_writer(start: Start, files: Path):
    encode = start("encode", files / "walk.bvh", "-o", "-", "--pace", "--unit-cm", UNIT, stdout=subprocess.PIPE)
    assert encode.stdout is not None and encode.stdout.read(5)
    encode.stdout.close()
    assert "jaxmocap: -: the reader has gone away\n" in ended(encode)
    with socket.create_server(("127.0.0.1", 0)) as server:
        encode = start("encode", files / "walk.bvh", "-o", f"tcp://127.0.0.1:{server.getsockname()[1]}", "--pace")
        reader, _ = server.accept()
        assert reader.recv(5)
        reader.close()
    assert "the reader has gone away\n" in ended(encode)


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["encode", "{}/none.bvh", "-o", "{}/x"], "none.bvh: No such file"),
        (["encode", "{}/walk.bvh", "-o", "{}/none/x"], "none/x: No such file"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--rate", "9", "--step", "1"], "give one of"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--rate", "0"], "--rate is 0.0"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--unit-cm", "-1"], "--unit-cm is"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--start", "-1"], "--start is -1"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--start", "360"], "no frame came after the first 360"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--repeats", "4"], "--repeats is 4"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--skeleton", "{}/none.bvh"], "none.bvh: No such file"),
        (["encode", "{}/walk.bvh", "-o", "{}/x", "--model", "learned"], "not for live"),
        (["encode", "{}/walk.bvh", "-o", "udp://:9000"], "udp://:9000 says nowhere to send to"),
        (["encode", "{}/walk.bvh", "-o", "ftp://a:9000"], "ftp://a:9000 is no address"),
        (["encode", "{}/walk.bvh", "-o", "tcp://a:70000"], "tcp://a:70000 is no address"),
        (["encode", "{}/walk.bvh", "-o", "tcp://nowhere.invalid:9000"], "tcp://nowhere.invalid:9000: "),
        (["encode", "{}/walk.bvh", "-o", "udp://nowhere.invalid:9000"], "udp://nowhere.invalid:9000: "),
        (["encode", "udp://:9000", "-o", "{}/x"], "UDP is for packets"),
        (["encode", "{}/text", "-o", "{}/x"], "a BVH file begins with HIERARCHY"),
        (["decode", "{}/text", "-o", "{}/x"], "text: the stream ends within a packet"),
        (["decode", "{}/empty", "-o", "{}/x"], "0 packets came, too few to show a frame"),
        (["decode", "{}/empty", "-o", "{}/x", "--delay", "-1"], "--delay is -1.0"),
        (["decode", "udp://127.0.0.1:{port}", "-o", "{}/x"], ": Address already in use"),
    ],
    ids=lambda value: " ".join(value).replace("{}/", "") if isinstance(value, list) else "",
)
def test_bad_input_is_one_line(files: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], wanted: str):
    (files / "text").write_text("hello world\n" * 30)
    (files / "empty").touch()
    before = {f.name for f in files.iterdir()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = str(taken.getsockname()[1])
        assert run(["stream", *(a.replace("{port}", port).replace("{}", str(files)) for a in arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("jaxmocap: ") and err.count("\n") == 1 and wanted in err
    assert {f.name for f in files.iterdir()} == before, "a failed run leaves no file behind"
