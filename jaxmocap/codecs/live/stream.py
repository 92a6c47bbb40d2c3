"""Live streams: a packet for every frame, and a frame for every packet that comes, or that should have come."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import CorruptStream, JaxmocapError, TruncatedStream
from ...features.channels import has_euler_orders
from ...skeleton import Skeleton
from ..artifact import Artifact, find_artifact, load_artifact
from ..learned.basis import direction_of
from ..learned.distortion import Metric, points_of
from ..learned.figure import in_cm
from ..learned.steps import index_of
from .analysis import Analysis
from .codec import fineness_for, model_of
from .control import Control
from .encoder import encode_packet, whole_steps
from .events import Density
from .fountain import Basin, Fountain
from .hello import Hello
from .model import LiveModel
from .packets import (
    MOST_REPEATS,
    NO_OFFSET,
    NUMBERS,
    Frame,
    read_frames,
    read_news,
    step_of,
    unframed,
    write_packet,
)
from .setting import OWN_RIG, Setting, figure_of, read_setting, write_setting
from .tracker import FINEST_STEP, UNITS, State, advance, advance_told, concealed, look, refreshed, step_units, to_cm, to_units

_MEASURED = 120  # every so many frames an error is, since it takes as long as all else
_MEAN_STEPS = 1.42  # the mean error is about so many steps
_BITS_AT_1_CM, _FALL = 25.0, 0.75
_HELLO_FRAMES = 54  # within which a receiver shall have heard who moves
_LATE = 16  # frames: a packet that is later than that mends nothing
_BEHIND = 240  # frames: a number further behind, or more than _LATE ahead, is believed when the next packet says so, too
_LONGEST = 120  # frames that are tracked without packets: what a silence was before that helps nobody
_LARGEST = 1e9


class Encoder:
    """Packets of a motion whose frames come one by one. `push` looks at no other frame than its own and those before it.

    `of` says what `wanted` speaks of: a mean "error" in cm (in file units where `unit_cm` is None), a "rate" in kbit/s,
    framing included, or a "step" in cm. `metric` is what errors are errors of, as in `Live`. Every packet tells the last
    `repeats` frames again, so that so many may be lost in a row and are mended by the next; more are mended by refreshing.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        frame_time: float,
        unit_cm: float | None = None,
        of: Literal["error", "rate", "step"] = "error",
        wanted: float = 0.5,
        metric: Metric = "shell",
        repeats: int = 0,
        artifact: Artifact | None = None,
    ):
        """Raises ValueError for what cannot be wanted, and JaxmocapError for a skeleton that cannot be streamed."""
        if not wanted > 0:
            raise ValueError(f"wanted is {wanted}, must be above 0")
        if repeats not in range(MOST_REPEATS + 1):
            raise ValueError(f"repeats is {repeats}, must be 0 to {MOST_REPEATS}")
        if not has_euler_orders(skeleton):
            raise JaxmocapError("joints of this skeleton turn about axes that are no Euler angles: live streams need these")
        artifact = artifact or load_artifact("live")
        self.model = model_of(artifact)
        self.skeleton, self.frame_time, self.unit_cm = skeleton, frame_time, unit_cm
        self.metric: Metric = metric
        known = self.model.rig.skeleton.same_rig(skeleton)
        self._scale = unit_cm or (self.model.rig.unit_cm if known else 1.0)
        cm = wanted if unit_cm else wanted * self._scale
        if of == "rate":
            bytes_a_packet = wanted * 1000 / 8 * frame_time
            self._control = Control("rate", bytes_a_packet)
            cm = float(np.clip((_BITS_AT_1_CM / (8 * bytes_a_packet)) ** (1 / _FALL), 0.05, 10.0))
        else:
            self._control = Control(of, cm)
        self._index = max(index_of(cm if of == "step" else cm / _MEAN_STEPS), FINEST_STEP)
        self._setting = write_setting(skeleton, self._scale, self.model, metric, fineness_for(cm))
        self._analysis = Analysis(figure_of(skeleton, self._scale, self._setting), self._scale)
        self._density = Density(self._setting.prior, self.model)
        self._digest = artifact.short_digest
        self._number, self._error_of_off = 0, 1.0
        self._repeats = repeats
        self._told: deque[Frame] = deque(maxlen=repeats)
        self._state: State | None = None

    def push(self, values: Float[np.ndarray, " channels"]) -> bytes:
        """The packet of the next frame: channel values in degrees and file units. Raises JaxmocapError for bad values."""
        wanted = self._wanted(np.asarray(values, np.float64))
        index, number = step_of(self._index, self._control.offset), self._number
        if self._state is None:
            frame = Frame(self._control.offset, True, whole_steps(wanted, index), np.zeros_like(wanted))
            self._state = State.at(frame.places * step_units(index))
        else:
            levels, places, self._state = encode_packet(
                wanted, number, self._state, self._setting.prior, self.model.network, index
            )
            frame = Frame(self._control.offset, False, places, levels)
        packet = write_packet(number, [frame, *self._told], self._index, self._density, self._news())
        self._control.saw(len(packet) if self._control.of == "rate" else self._error(wanted))
        self._told.appendleft(frame)
        self._number += 1
        return packet

    def _wanted(self, values: Float[np.ndarray, " channels"]) -> Int[np.ndarray, " components"]:
        """Places of the frame, going on from the last without a jump of a whole turn."""
        if values.shape != (self.skeleton.channel_count,) or not (np.abs(values) < _LARGEST).all():
            raise JaxmocapError(
                f"frame {self._number} has values of shape {values.shape}, wanted {self.skeleton.channel_count} finite numbers"
            )
        self._pose = path, body = self._analysis.of(values)
        if self._state is None:
            self._begin(direction_of(path))
        return to_units(self._setting.basis.coefficients(path, body, self._direction))[0]

    def _error(self, wanted: Int[np.ndarray, " components"]) -> float:
        """Of the frame as receivers have it, in cm, by the metric: measured now and then, else by how far off it is."""
        assert self._state is not None
        off = float(np.linalg.norm((wanted - self._state.place) / UNITS))
        if self._number % _MEASURED == 0 and off > 0:
            decoded = self._setting.basis.vectors(to_cm(self._state.place)[None], self._direction)
            points = points_of(self._setting.figure, self.metric, *decoded)
            error = np.linalg.norm(points - points_of(self._analysis.figure, self.metric, *self._pose), axis=0).mean()
            self._error_of_off = float(error) / off
        return self._error_of_off * off

    def _begin(self, direction: int) -> None:
        self._direction, rig = direction, self.model.rig
        hello = Hello(
            self.metric,
            self._setting.flags,
            self._repeats,
            self._digest,
            self._index,
            direction,
            None if self.frame_time == rig.frame_time else self.frame_time,
            None if self.unit_cm == rig.unit_cm else self.unit_cm or 0.0,
            self._setting.section,
        )
        self._hello = hello.to_bytes()
        try:
            self._fountain = Fountain(self._hello)
        except ValueError as error:
            raise JaxmocapError(f"the skeleton is too large to be streamed: {error}") from error
        self._every = max(_HELLO_FRAMES // self._fountain.needed, 1)

    def _news(self) -> bytes | int | None:
        """What a packet tells of whose motion it is: all in the first, a symbol of the fountain now and then."""
        if self._number == 0:
            return self._hello
        return self._fountain.symbol(self._number % NUMBERS) if self._number % self._every == 0 else None


class Shown(NamedTuple):
    """A frame as the receiver sees it. `number` counts from the first packet heard; `concealed` says that none came for it."""

    number: int
    values: Float[np.ndarray, " channels"]
    concealed: bool


@dataclass
class Tally:
    """What became of packets, and how many frames were shown without one."""

    received: int = 0
    damaged: int = 0
    repeated: int = 0
    late: int = 0
    concealed: int = 0


class Decoder:
    """Frames of packets, of which any may be missing, late, there twice, or damaged. No back channel; one stream.

    Until the receiver has heard whose motion it is, and every component once, there is nothing to show: that takes less than
    half a second. A packet that comes up to 16 frames late mends what is shown from then on.
    """

    def __init__(self, artifact: Artifact | None = None):
        """`artifact` is a model that the stream may need; shipped ones are found."""
        self._artifact = artifact
        self._basin = Basin()
        self._receiver: _Receiver | None = None
        self._waiting: deque[tuple[int, bytes]] = deque(maxlen=64)
        self._last: int | None = None
        self._astray: int | None = None
        self.tally = Tally()

    @property
    def skeleton(self) -> Skeleton | None:
        """In file units, as soon as it is known."""
        return self._receiver and self._receiver.skeleton

    @property
    def frame_time(self) -> float | None:
        return self._receiver and self._receiver.frame_time

    @property
    def unit_cm(self) -> float | None:
        return self._receiver and self._receiver.unit_cm

    def push(self, packet: bytes) -> Shown | None:
        """The frame of a packet; None where it is damaged, late or there twice, or not enough is known yet.

        Frames that were lost before it are concealed, but not shown. Raises ModelMismatch or UnsupportedVersion where
        the stream needs a model that is not at hand.
        """
        try:
            short, payload = unframed(packet)
            number = self._whole_number(short)
            if number is None:
                return None
            shown = self._take(number, payload)
        except (CorruptStream, TruncatedStream):
            self.tally.damaged += 1
            return None
        return shown

    def conceal(self) -> Shown | None:
        """The next frame, when its time has come and its packet has not."""
        if self._receiver is None or self._last is None:
            return None
        self._last += 1
        self.tally.concealed += 1
        return self._receiver.step(self._last, None)

    def _whole_number(self, short: int) -> int | None:
        """The number of the frame, of which the packet has what 4050 leaves over; None where it is not believed yet."""
        if self._last is None:
            return short
        number = self._last + (short - self._last + NUMBERS // 2) % NUMBERS - NUMBERS // 2
        if -_BEHIND <= number - self._last <= _LATE:
            self._astray = None
            return number
        believed = self._astray is not None and 0 < (short - self._astray) % NUMBERS <= _LATE
        self._astray = short
        if not believed:
            self.tally.damaged += 1
            return None
        if number < self._last:  # long silence: the counter went round
            number += NUMBERS
        return number

    def _take(self, number: int, payload: bytes) -> Shown | None:
        if self._receiver is None:
            return self._meet(number, payload)
        frame, *again = self._receiver.read(number, payload)
        late = self._last is not None and number <= self._last
        if not late:
            for missing in range(max(self._last + 1, number - _LONGEST) if self._last is not None else number, number):
                self._receiver.step(missing, None)
        for back, told in reversed(list(enumerate(again, 1))):
            self._receiver.mend(number - back, told)
        if late:
            is_new = self._receiver.mend(number, frame)
            self.tally.late += is_new
            self.tally.repeated += not is_new
            return None
        self.tally.received += 1
        self._last = number
        return self._receiver.step(number, frame)

    def _meet(self, number: int, payload: bytes) -> Shown | None:
        """A packet before it is known whose motion it is: kept, and what it tells of that taken."""
        news = read_news(payload)
        self._waiting.append((number, payload))
        data = self._basin.add(number % NUMBERS, news) if isinstance(news, int) else news
        if data is None:
            return None
        try:
            hello = Hello.of_bytes(data)
            artifact = find_artifact(hello.digest, self._artifact)
            self._receiver = _Receiver(hello, model_of(artifact))
        except (CorruptStream, TruncatedStream):
            self._basin = Basin()
            raise
        first, shown = number - len(self._waiting) - _LATE, None
        for kept in sorted((first + (of - first) % NUMBERS, payload) for of, payload in self._waiting):
            if kept[0] <= number + _LATE:  # further away it was none of this stream
                shown = self._take(*kept) or shown
        return shown


class _Receiver:
    """A decoder that knows whose motion it is."""

    def __init__(self, hello: Hello, model: LiveModel):
        rig = model.rig
        self.unit_cm = rig.unit_cm if hello.unit_cm is None else hello.unit_cm or None
        self.frame_time = rig.frame_time if hello.frame_time is None else hello.frame_time
        self._setting: Setting = read_setting(hello.skeleton, hello.setting_flags, model, hello.metric)
        self._scale = self.unit_cm or (1.0 if hello.setting_flags & OWN_RIG else rig.unit_cm)
        self.skeleton = in_cm(self._setting.figure.skeleton, 1 / self._scale)
        self._model, self._hello = model, hello
        self._density = Density(self._setting.prior, model)
        count = len(self._setting.prior.speed)
        self._state = State.at(np.zeros(count, np.int64))
        self._heard = np.zeros(count, bool)
        self._offset = NO_OFFSET
        self._past: deque[tuple[int, State, Frame | None]] = deque(maxlen=_LATE)

    def read(self, number: int, payload: bytes) -> list[Frame]:
        """Of this number, and of those before it that are told again. Raises CorruptStream."""
        return read_frames(number, payload, 1 + self._hello.repeats, self._hello.step_index, self._density)

    def step(self, number: int, frame: Frame | None) -> Shown | None:
        """The next frame; without a packet it is as it was expected. None until every component was heard."""
        self._past.append((number, self._state, frame))
        self._state = self._after(number, self._state, frame)
        if not self._heard.all():
            return None
        values = self._setting.values(self._state.place[None], self._hello.direction, self._scale)
        return Shown(number, values[0], frame is None)

    def mend(self, number: int, frame: Frame) -> bool:
        """Takes in a frame that is late; False where it is too late, or was there before."""
        at = next((n for n, (of, _, there) in enumerate(self._past) if of == number and there is None), None)
        if at is None:
            return False
        self._state = self._past[at][1]
        for n in range(at, len(self._past)):
            of, _, there = self._past[n]
            there = frame if n == at else there
            self._past[n] = (of, self._state, there)
            self._state = self._after(of, self._state, there)
        return True

    def _after(self, number: int, state: State, frame: Frame | None) -> State:
        self._offset = self._offset if frame is None else frame.offset
        index = step_of(self._hello.step_index, self._offset)
        count = len(state.place)
        if frame is not None and frame.whole:
            self._heard[:] = True
            return State.at(frame.places * step_units(index))
        outlook = look(state, self._setting.prior, self._model.network, index)
        if frame is None:
            return advance(state, concealed(state, outlook, index), np.zeros(count, np.int64))
        turn = refreshed(number, count)
        self._heard[turn] = True
        return advance_told(state, outlook, frame.levels, turn, frame.places, index)
