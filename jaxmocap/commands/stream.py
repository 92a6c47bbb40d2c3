"""`jaxmocap stream`: motion to packets and back, frame by frame, through files, pipes and the network."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import CorruptStream, FormatError, JaxmocapError
from .base import Command, Report, checked_unit, load_model, read_file, table
from .interruption import Interruption, interruption
from .meter import Meter

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from ..codecs.artifact import Artifact
    from ..codecs.live.playout import Playout
    from ..codecs.live.stream import Decoder, Encoder, Shown
    from ..codecs.live.transport import PacketSink, PacketSource, Source
    from ..formats.live import BvhReader, BvhWriter, RawReader, RawWriter
    from .endpoints import FileSink, PipeSink

Place = tyro.conf.Positional[str]
Out = Annotated[str, tyro.conf.arg(aliases=["-o"])]
_LOOK_SECONDS = 0.1
_REPEATS = 2  # with 5 packets of 100 lost, all but one frame of 8,000 arrive


@dataclass(kw_only=True)
class StreamEncode(Command):
    """Encode motion as it comes, a packet a frame; no frame waits for a later one."""

    input: Place
    """Motion: a file, - (standard input), tcp://host:port, or tcp://:port to listen."""
    output: Out
    """Where packets go: a file, -, tcp://host:port, tcp://:port, or udp://host:port."""
    skeleton: Path | None = None
    """A BVH file: the input is float32 frames of its figure (little-endian, channels in its order). Default: BVH text."""
    mean_error: float | None = None
    """The mean error to keep, in cm (in file units where the unit is unknown). Default: 0.5 % of the figure's height."""
    rate: float | None = None
    """The rate to keep, in kbit/s, instead of an error."""
    step: float | None = None
    """The quantiser step, in cm, instead of an error."""
    metric: Literal["joints", "shell"] = "shell"
    """What errors are of: joints, or three points 3 cm from each, which see twist, too."""
    repeats: int | None = None
    """Every packet tells so many frames before it again, at most 3, in case their own are lost. Default: 2 over UDP, else 0."""
    unit_cm: float | None = None
    """Centimetres per file unit: BVH does not say. 5.6444 for the CMU conversions."""
    start: int = 0
    """Leave out so many frames at the front: 1 for the T-pose of the CMU conversions."""
    pace: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Send every frame at its time. For a file over UDP; what is live has its own pace."""
    model: Path | None = None
    """A trained model: a file, or the id of a shipped one. Default: the one shipped for live."""

    @property
    def writes_stdout(self) -> bool:
        return self.output == "-"

    def run(self) -> Report:
        from .endpoints import Address, open_packet_sink, open_source

        self._check()
        model, reader, meter = load_model(self.model), self._reader(), Meter()
        ends = Address.parse(self.input), Address.parse(self.output)
        with closing(open_source(ends[0])) as source, closing(open_packet_sink(ends[1])) as sink, interruption() as stop:
            frames = islice(_frames(source, reader, self.input, stop), self.start, None)
            self._encode(frames, reader, model, sink, meter, stop)
        if not meter.frames and not stop.asked:
            raise FormatError(f"{self.input}: no frame came" + (f" after the first {self.start}" if self.start else ""))
        meter.end()
        return {**meter.totals(), "stream_bytes": sink.size}

    def text(self, report: Report) -> str:
        return _text(self.output, report)

    def _encode(
        self,
        frames: Iterator[Float[np.ndarray, " channels"]],
        reader: BvhReader | RawReader,
        model: Artifact | None,
        sink: PacketSink,
        meter: Meter,
        stop: Interruption,
    ) -> None:
        encoder, begun = None, 0.0
        for number, values in enumerate(frames):
            if encoder is None:
                encoder, begun = self._encoder(reader, model), time.monotonic()
                meter.frame_time = encoder.frame_time
                gc.freeze()  # what was imported need not be looked through while frames wait
            if self.pace:
                stop.sleep(begun + number * encoder.frame_time)
            if stop.asked:
                return
            began = time.perf_counter()
            packet = encoder.push(values)
            meter.took(time.perf_counter() - began)
            try:
                sink.send(packet)
                meter.packet(len(packet))
            except ConnectionError:
                return _say(f"{self.output}: the reader has gone away")
            meter.look()

    def _encoder(self, reader: BvhReader | RawReader, model: Artifact | None) -> Encoder:
        import numpy as np

        from ..codecs.base import Target
        from ..codecs.live.stream import Encoder
        from ..motion import Motion
        from .endpoints import Address

        skeleton, frame_time = reader.skeleton, reader.frame_time
        assert skeleton is not None  # it comes before the first frame
        at_rest = Motion(skeleton, np.zeros((1, skeleton.channel_count)), frame_time, self.unit_cm)
        of, wanted = "error", self.mean_error or Target.default(at_rest).cm
        if self.rate is not None:
            of, wanted = "rate", self.rate
        if self.step is not None:
            of, wanted = "step", self.step
        lossy = Address.parse(self.output).kind == "udp"
        repeats = _REPEATS * lossy if self.repeats is None else self.repeats
        return Encoder(skeleton, frame_time, self.unit_cm, of, wanted, self.metric, repeats, model)

    def _reader(self) -> BvhReader | RawReader:
        from ..formats.live import BvhReader, RawReader

        if self.skeleton is None:
            return BvhReader(self.input)
        motion = read_file(self.skeleton, self.unit_cm)
        return RawReader(motion.skeleton, motion.frame_time)

    def _check(self) -> None:
        from ..codecs.live.packets import MOST_REPEATS

        checked_unit(self.unit_cm)
        asked = {"--mean-error": self.mean_error, "--rate": self.rate, "--step": self.step}
        given = {name: value for name, value in asked.items() if value is not None}
        if len(given) > 1:
            raise JaxmocapError("give one of --mean-error, --rate and --step")
        for name, value in given.items():
            if not 0 < value < float("inf"):
                raise JaxmocapError(f"{name} is {value}, wanted a number above 0")
        if self.repeats is not None and self.repeats not in range(MOST_REPEATS + 1):
            raise JaxmocapError(f"--repeats is {self.repeats}, wanted 0 to {MOST_REPEATS}")
        if self.start < 0:
            raise JaxmocapError(f"--start is {self.start}, wanted 0 or more")


@dataclass(kw_only=True)
class StreamDecode(Command):
    """Decode packets as they come, a frame a packet. Over UDP, where any may be lost, every frame is shown at its time."""

    input: Place
    """Where packets come from: a file, - (standard input), tcp://host:port, tcp://:port or udp://:port to listen."""
    output: Out
    """Where motion goes: a file, -, tcp://host:port, or tcp://:port."""
    format: Literal["bvh", "float32"] = "bvh"
    """BVH text, or its frames alone as float32 (little-endian, channels in the order of the BVH header)."""
    delay: float = 20.0
    """Over UDP: a frame whose packet is so many milliseconds behind its time is shown without it."""
    silence: float = 10.0
    """Over UDP: so many seconds without a packet end the stream, as a sender does that ends in order."""
    model: Path | None = None
    """The model that the stream needs, where it is not shipped."""

    @property
    def writes_stdout(self) -> bool:
        return self.output == "-"

    def run(self) -> Report:
        from ..codecs.live.playout import Playout
        from ..codecs.live.stream import Decoder
        from .endpoints import Address, open_packet_source, open_sink

        for name, value in (("--delay", self.delay), ("--silence", self.silence)):
            if not 0 <= value < float("inf"):
                raise JaxmocapError(f"{name} is {value}, wanted 0 or more")
        decoder, meter = Decoder(load_model(self.model)), Meter()
        ends = Address.parse(self.input), Address.parse(self.output)
        in_order = ends[0].kind != "udp"
        playout, silence = Playout(decoder, None if in_order else self.delay / 1000), float("inf") if in_order else self.silence
        with (
            closing(open_packet_source(ends[0])) as source,
            closing(_MotionSink(open_sink(ends[1]), decoder, self.format)) as sink,
            interruption() as stop,
        ):
            gc.freeze()
            try:
                for shown in _shown(source, playout, meter, stop, silence):
                    sink.write(shown)
                    meter.frame_time, meter.losses = decoder.frame_time, _losses(decoder)
                    meter.look()
            except ConnectionError:
                _say(f"{self.output}: the reader has gone away")
            except CorruptStream as error:
                raise type(error)(f"{self.input}: {error}; frames written before it: {meter.frames}") from error
        meter.losses = _losses(decoder)
        if not meter.frames and not stop.asked:
            raise FormatError(f"{self.input}: {meter.packets} packets came, too few to show a frame")
        meter.end()
        return meter.totals()

    def text(self, report: Report) -> str:
        return _text(self.output, report)


class _MotionSink:
    """Frames as text or as values, each on its way when `write` returns."""

    def __init__(self, sink: PipeSink | FileSink, decoder: Decoder, form: Literal["bvh", "float32"]):
        self._sink, self._decoder, self._form = sink, decoder, form
        self._writer: BvhWriter | RawWriter | None = None
        self._frames = 0

    def write(self, shown: Shown) -> None:
        if self._writer is None:
            self._writer = self._begun()
            self._sink.write(self._writer.header)
        self._sink.write(self._writer.frame(shown.values))
        self._frames += 1

    def close(self) -> None:
        if self._writer is not None:
            self._sink.patch(self._writer.count_at, self._writer.count(self._frames))
        self._sink.close()

    def _begun(self) -> BvhWriter | RawWriter:
        from ..formats.live import BvhWriter, RawWriter

        skeleton, frame_time = self._decoder.skeleton, self._decoder.frame_time
        assert skeleton is not None and frame_time is not None  # they are known before the first frame
        return BvhWriter(skeleton, frame_time) if self._form == "bvh" else RawWriter()


def _frames(
    source: Source, reader: BvhReader | RawReader, name: str, stop: Interruption
) -> Iterator[Float[np.ndarray, " channels"]]:
    """Each as soon as it is whole."""
    data = None
    while data != b"" and not stop.asked:
        data = source.read(_LOOK_SECONDS)
        if data is not None:
            yield from reader.feed(data) if data else reader.end()
    if data == b"" and reader.left:
        _say(f"{name} ends within a frame, of which {reader.left} values came: it is left out")


def _shown(source: PacketSource, playout: Playout, meter: Meter, stop: Interruption, silence: float) -> Iterator[Shown]:
    """Frames, each when its packet or its time has come."""
    from ..codecs.live.transport import StreamEnd

    heard, over = float("inf"), False
    while not over and not stop.asked and time.monotonic() - heard <= silence:
        packet, frames, due = None, None, playout.due
        try:
            packet = source.receive(_LOOK_SECONDS if due is None else min(due - time.monotonic(), _LOOK_SECONDS))
        except StreamEnd as end:
            over, frames = True, end.frames
        began, now = time.perf_counter(), time.monotonic()
        if packet is not None:
            heard, found = now, playout.arrived(packet, now)
            meter.packet(len(packet))
        else:
            found = playout.finish(frames) if over else playout.elapsed(now)
        if found:
            meter.took(time.perf_counter() - began, len(found))
        yield from found


def _losses(decoder: Decoder) -> dict[str, int]:
    tally = decoder.tally
    return {"concealed": tally.concealed, "late": tally.late, "repeated": tally.repeated, "damaged": tally.damaged}


def _say(message: str) -> None:
    print(f"jaxmocap: {message}", file=sys.stderr, flush=True)


def _text(output: str, report: Report) -> str:
    names = {"kbit_s": "kbit/s", "ms_median": "ms a frame", "ms_99th": "ms, 99th percentile"}
    size = f"{report['packet_bytes']:,} bytes of packets"
    rows = [(names.get(key, key), value) for key, value in report.items() if key != "packet_bytes" and value is not None]
    return table([(output, size), *rows])
