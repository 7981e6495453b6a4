"""The recorder node: writes what other nodes publish to a log, and loses nothing that the disk has room for."""

import time
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import structlog

from semantic_mapper.errors import CodecError, LogError
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import RecorderOptions
from semantic_mapper.nodes.publishing import PartStatus, StatusReport
from semantic_mapper.nodes.streams import MissingFrames, Streams
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.reader import LogAttachment
from semantic_mapper.replay.log.recording import Recording, RecordingRules, make_way
from semantic_mapper.replay.log.sequence import parts_on_disk
from semantic_mapper.transport.codec import decode_as, read_envelope, repack_rgb
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.launches import NOTE as LAUNCH
from semantic_mapper.transport.messages import EndOfStream, StreamInfo, parse_topic
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import CameraIntrinsics

POLL_S = 0.05
QUIET_S = 0.5  # after the end of the stream, answers from other nodes may still be on their way
MAX_WAITING = 256  # messages that may wait to be written, while the disk or the processor is busy
MAX_EARLY = 1000  # messages kept while no stream has begun
DRAIN_S = 5.0  # after a stop, for what has come before it; less than the `stop_s` of launches
DRAINED_S = 0.005  # nothing for so long: all is written; what a camera that runs on sends comes later
NOTE = "recording"  # the name of the recording, for the process that replaces this one

_log = structlog.get_logger(__name__)


def run_recorder(context: NodeContext, options: RecorderOptions) -> str:
    """Record until the stream ends or somebody asks to stop, and tell how it goes; what the log lacks, in words.

    A disk that is full later ends the recording, not the node.
    """
    with ExitStack() as stack:
        report = StatusReport(context.name, stack.enter_context(Publisher(context.endpoint(context.name))))

        def follow(recorder: Recorder) -> bool:
            if report.due:
                report.publish("running", recorder.status())
            return False

        recorder = record(context, options, follow)
        report.publish("ended", recorder.status())
    return "; ".join(filter(None, (recorder.losses, recorder.never_came)))


def record(context: NodeContext, options: RecorderOptions, follow: "Callable[[Recorder], bool]") -> "Recorder":
    """Record until the stream ends or somebody asks to stop, or ``follow``, called some twenty times a second, says
    True.

    Raises LogError: the log cannot be begun, or somebody has removed it meanwhile. TransportError: a source cannot be
    subscribed to.
    """
    topics = tuple(dict.fromkeys(("info", *options.topics, "end")))
    cameras = [context.endpoint(name) for name in options.cameras]
    others = [context.endpoint(name) for name in options.sources[options.streams :]]
    recorder = Recorder(context, options)  # at once, so that nothing begins where there is a log already
    with ExitStack() as stack:
        sources: list[LosslessSubscriber] = []
        if others:
            sources.append(stack.enter_context(LosslessSubscriber(others, topics, hwm=MAX_WAITING)))
            sources[0].wait_until_heard(options.source_timeout_s, context.stop)
        # Cameras begin once they have all their subscribers, so this one comes last: by now nothing can be missed.
        frames = stack.enter_context(LosslessSubscriber(cameras, topics, hwm=MAX_WAITING))
        sources.insert(0, frames)
        stack.callback(recorder.close)
        context.heartbeat.ready()
        ended_at = 0.0
        while not (ended_at and time.monotonic() - ended_at > QUIET_S) and not context.stop:
            context.heartbeat.turn()
            recorder.rejected = sum(source.rejected for source in sources)
            if follow(recorder):
                break
            parts = frames.receive_parts(POLL_S)
            if parts is not None and recorder.take(parts):
                ended_at = ended_at or time.monotonic()
            for other in sources[1:]:
                while (parts := other.receive_parts(0)) is not None:
                    recorder.take(parts)
        deadline = time.monotonic() + DRAIN_S
        for source in sources if context.stop else ():  # what had come before the stop, as far as there is time
            while not recorder.cut_off and (parts := source.receive_parts(DRAINED_S)) is not None:
                context.heartbeat.turn()
                recorder.cut_off = time.monotonic() > deadline
                recorder.take(parts)
        recorder.rejected = sum(source.rejected for source in sources)
        context.heartbeat.ending()
    if recorder.recording is not None and recorder.recording.gone:
        raise LogError(f"{recorder.recording.path}: was removed while it was written, and what it held is lost")
    return recorder


class Recorder:
    """The recording, opened once it is known what the stream is.

    Where the node was killed before, the recording goes on in the next part. ``LogError`` where the log is there
    already, and must not be replaced.
    """

    def __init__(self, context: NodeContext, options: RecorderOptions) -> None:
        self._context = context
        self._options = options
        self._path = Path(options.out)
        self._goes_on = bool(context.note(NOTE))  # else the one before was killed before it had begun
        split_bytes, reserve_bytes = round(options.split_mb * 1e6), round(options.reserve_mb * 1e6)
        self._rules = RecordingRules(split_bytes, options.split_s, options.disk_full, reserve_bytes)
        if not self._goes_on:  # before the stream begins, so that nothing else is overwritten
            make_way(self._path, overwrite=options.overwrite, dry=True)
        self._packing = None
        if options.rgb != "as-sent":
            self._packing = CodecOptions(rgb=options.rgb, jpeg_quality=options.jpeg_quality)
        self.recording: Recording | None = None  # while no stream has begun
        self.received = self.rejected = 0  # frames that came, messages that could not be read
        self.cut_off = False  # whether there was no time to write all that had come before a stop
        self.missing_frames = MissingFrames()
        self._streams = Streams(options.streams)
        self._cameras: dict[str, CameraIntrinsics] = {}  # of all streams so far
        self._recorded: set[bytes] = set()  # what the recording holds of streams
        self._early: deque[list[bytes]] = deque(maxlen=MAX_EARLY)

    def status(self) -> PartStatus:
        """For the node's status."""
        counters = {"missed": self.missing_frames.missed, "rejected": self.rejected}
        if (r := self.recording) is None:
            return PartStatus(counters)
        counters |= {"recorded": r.frames, "messages": r.messages, "lost": r.lost}
        size = 0
        for file in parts_on_disk(self._path).values():
            with suppress(FileNotFoundError):  # somebody has just deleted it
                size += file.stat().st_size
        counters |= {"parts": r.parts, "deleted": r.deleted, "log_kb": size // 1024}
        return PartStatus(counters, (r.trouble,))

    @property
    def losses(self) -> str:
        """What was sent and is not in the log, as far as anybody knows, in words; empty = nothing."""
        r, texts = self.recording, []
        if self._goes_on:
            texts.append("the recorder was restarted, and what was sent meanwhile is missing")
        if r is not None and r.lost:
            texts.append(f"{counted(r.lost, 'message')} not written: {r.trouble or 'the disk was full for a while'}")
        if self.cut_off:
            texts.append(f"what was still not written {DRAIN_S:g} s after the stop")
        if r is None and self.received:
            texts.append(f"{counted(self.received, 'frame')} came, but not of what stream they are")
        return "; ".join(texts)

    @property
    def never_came(self) -> str:
        """As ``losses``: frames that cameras say they have sent to one who listened from the beginning."""
        missing = self._streams.published - self.received
        if missing <= 0 or self._goes_on or "frame" not in self._options.topics:
            return ""
        return f"{missing} of {counted(self._streams.published, 'frame')} that were sent never came"

    def take(self, parts: list[bytes]) -> bool:
        """Keep one message; True where all streams have ended."""
        topic, _ = parse_topic(parts[0])
        self.received += topic.name == "frame"
        if topic.name == "info":
            info = decode_as(StreamInfo, parts)
            self._cameras |= info.cameras
            if self.recording is None:
                self._begin(info)
            elif bytes(parts[1]) not in self._recorded:  # of another camera, or of one that was restarted
                self.recording.announce(parts, self._calibration())
            self._recorded.add(bytes(parts[1]))
        elif topic.name != "end":
            if self.recording is None:
                self._early.append(parts)
            else:
                self.recording.write(self._packed(parts, topic.name))
        return topic.name == "end" and self._streams.end(decode_as(EndOfStream, parts))

    def close(self) -> None:
        """Finish the log."""
        if self.recording is None:
            _log.warning("nothing_recorded", reason="no stream has begun")
            return
        self.recording.close()
        r = self.recording
        if r.nothing_left:
            _log.error("recording_gone", log=str(r.path), reason="its files were removed while it was recorded")
            return
        _log.info("recorded", log=str(r.path), frames=r.frames, messages=r.messages, parts=r.parts, deleted=r.deleted)
        if r.gone:
            _log.error("recording_incomplete", reason="a part of it was removed while it was recorded")
        if self.losses:
            _log.error("recording_incomplete", reason=self.losses)

    def _begin(self, info: StreamInfo) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        before = self._context.note(NOTE) if self._goes_on else ""
        name = before or uuid.uuid4().hex
        self._context.try_to_leave_note(NOTE, name, "who replaces it begins another recording next to it")
        kept, note = [self._calibration()], (self._context.folder or Path()) / LAUNCH
        if self._context.folder is not None and note.exists():
            kept.append(LogAttachment(LAUNCH, "application/json", note.read_bytes()))
        self.recording = Recording(
            self._path,
            info,
            self._rules,
            recording=name,
            attachments=kept,
            overwrite=self._options.overwrite,
            goes_on=self._goes_on,
        )
        _log.info("recording", log=str(self.recording.path))
        for early in self._early:
            self.recording.write(early)
        self._early.clear()

    def _calibration(self) -> LogAttachment:
        cameras = msgspec.json.format(msgspec.json.encode({"cameras": self._cameras}), indent=1)
        return LogAttachment("calibration.json", "application/json", cameras)

    def _packed(self, parts: list[bytes], topic: str) -> list[bytes]:
        if topic != "frame":
            return parts
        envelope = read_envelope(parts)
        self.missing_frames.note(envelope.source, envelope.seq)
        if self._packing is None:
            return parts
        try:
            return repack_rgb(parts, self._packing)
        except CodecError as error:  # the reader of the log judges it
            _log.warning("frame_kept_as_sent", seq=envelope.seq, error=str(error))
            return parts
