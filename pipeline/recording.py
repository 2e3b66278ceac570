"""Recordings: MCAP files that survive a killed recorder and open in Rerun and Foxglove as they are.

What is written, byte for byte, is what travelled.  A message's MCAP ``sequence`` is its stamp's,
``publish_time`` its capture and ``log_time`` the recorder's receipt, except for frames: theirs is when the frame
entered the pipeline, so that ``log_time`` of a state minus ``log_time`` of its frame is the latency.  The mission
travels as the attachment ``mission.json``.
"""

from __future__ import annotations

import contextlib
import os
import struct
import time
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from mcap.data_stream import RecordBuilder
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from pipeline.foreign import CALIBRATION_SCHEMAS, IMAGE_SCHEMAS, stamped, standard_message
from pipeline.mission import ATTACHMENT, Mission
from schemas import Envelope, Stamp, Topic
from schemas.codec import descriptor_of, file_descriptor_set, schema_name
from schemas.topics import CALIBRATION, FRAME, topic_for_key

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
MAX_SEQUENCE = 2**32 - 1
MAX_NS = 2**63 - 1
"""MCAP's sequence numbers have 32 bits; its times have 64, of which readers take 63."""
FLUSH_PERIOD_S = 0.25
"""A kill loses what is not flushed and, at worst, the chunk being written: twice this."""
_FOOTER = struct.Struct("<xQQQI8s")
"""Opcode, length, summary_start, summary_offset_start, summary_crc, closing magic: the end of every MCAP file."""


class RecordingError(ValueError):
    """A recording that cannot be read or written, in one line that says what to do."""


class NothingRecordedError(RecordingError):
    """A recording without a single whole message."""


class RecordingWriter:
    """Writes envelopes to an MCAP file: a sink.  Raises RecordingError when the disk refuses."""

    def __init__(self, path: str | Path, mission: Mission):
        self.path = Path(path)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._failure: str | None = None
        self._flushed_s = time.monotonic()
        try:
            self._file: IO[bytes] = self.path.open("wb")
        except OSError as error:
            raise RecordingError(f"cannot write {self.path}: {error.strerror}") from error
        with self._to_disk():
            self._mcap = _open_writer(self._file)
            self._mcap.add_attachment(0, 0, ATTACHMENT, "application/json", mission.to_json().encode())
            self._mcap.flush()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Take one envelope, received at UTC ``t_receipt_ns``.  Raises ValueError for a stamp that MCAP cannot hold."""
        if not envelope.topic.recorded:
            return
        stamp = envelope.stamp
        times_ns = (stamp.t_capture_ns, t_receipt_ns)
        if not (0 <= stamp.sequence <= MAX_SEQUENCE and all(0 <= t_ns <= MAX_NS for t_ns in times_ns)):
            raise ValueError(f"cannot record {envelope.key}: {stamp}, received {t_receipt_ns}, is out of MCAP's range")
        entered = envelope.topic is FRAME and stamp.t_origin_ns > 0
        with self._to_disk():
            self._mcap.add_message(
                channel_id=self._channel(envelope),
                log_time=stamp.t_origin_ns if entered else t_receipt_ns,
                publish_time=stamp.t_capture_ns,
                sequence=stamp.sequence,
                data=envelope.payload,
            )
        if time.monotonic() - self._flushed_s >= FLUSH_PERIOD_S:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system: from here on it survives a kill."""
        with self._to_disk():
            self._mcap.flush()
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Write the summary and close.  Does nothing when closed already or after a failure."""
        if self._failure is not None or self._file.closed:
            return
        with self._to_disk():
            self._mcap.finish()
            self._file.close()

    def _channel(self, envelope: Envelope) -> int:
        if envelope.key not in self._channels:
            descriptor = descriptor_of(envelope.topic.schema)
            if descriptor.full_name not in self._schemas:
                self._schemas[descriptor.full_name] = self._mcap.register_schema(
                    descriptor.full_name, "protobuf", file_descriptor_set(descriptor)
                )
            self._channels[envelope.key] = self._mcap.register_channel(
                envelope.key, "protobuf", self._schemas[descriptor.full_name]
            )
        return self._channels[envelope.key]

    @contextlib.contextmanager
    def _to_disk(self) -> Iterator[None]:
        """Turn a refusal of the disk into one clear error, now and for every later call."""
        if self._failure is not None:
            raise RecordingError(self._failure)
        try:
            yield
        except OSError as error:
            self._failure = (
                f"cannot write {self.path}: {error.strerror}. "
                f"What was written until then is kept: run `relnav recover {self.path}`"
            )
            with contextlib.suppress(OSError):
                self._file.close()
            raise RecordingError(self._failure) from error


def _open_writer(file: IO[bytes]) -> Writer:
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, enable_data_crcs=True)
    writer.start()
    return writer


@dataclass(frozen=True)
class _Role:
    """What a channel of the file is to us."""

    topic: Topic
    key: str
    standard: bool
    """A standard message under a name that is not in our table: read through ``pipeline.foreign``."""
    schema: str


class Recording:
    """Reads an MCAP file: ours, or another's with one topic of foxglove images.

    Raises RecordingError when the file does not exist, is not MCAP, is truncated or damaged; damage inside shows
    when it is reached.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        with self._readable() as file:
            _require_ends(self.path, file)
            _require_summary_crc(file)
            summary = SeekingReader(_rewound(file), record_size_limit=_size(file)).get_summary()
            if summary is None or summary.statistics is None:
                raise RecordingError(f"{self.path} has no summary: run `relnav recover {self.path}`")
            mission = _mission_attachment(file)
        self.has_mission = mission is not None
        self.mission = Mission() if mission is None else Mission.parse(mission, source=f"in {self.path}")
        counts = summary.statistics.channel_message_counts
        self._counts = {channel.id: counts.get(channel.id, 0) for channel in summary.channels.values()}
        self._names = {channel.id: channel.topic for channel in summary.channels.values()}
        self.message_count: int = summary.statistics.message_count
        self._roles = _roles(summary, self._counts, self.mission)

    @property
    def frame_count(self) -> int:
        """Return how many camera frames it holds."""
        return sum(self._counts[i] for i, role in self._roles.items() if role.topic is FRAME)

    @property
    def frame_keys(self) -> list[str]:
        """Return the keys of its cameras' frames."""
        return [role.key for i, role in self._roles.items() if role.topic is FRAME and self._counts[i]]

    @property
    def ignored(self) -> dict[str, int]:
        """Return the channels that are not in our table of topics, with their numbers of messages."""
        return {name: self._counts[i] for i, name in self._names.items() if i not in self._roles}

    @property
    def calibration(self) -> CameraCalibration | None:
        """Return the first camera calibration, None when there is none."""
        return next(iter(self.messages(CALIBRATION)), None)

    def topics(self) -> dict[str, int]:
        """Return the keys of our topics, with their numbers of messages."""
        return {role.key: self._counts[i] for i, role in self._roles.items()}

    def messages(self, topic: Topic) -> Iterator[Any]:
        """Yield the decoded messages of one topic in file order."""
        for envelope, _ in self.envelopes((topic,)):
            yield envelope.message()

    def envelopes(self, topics: Collection[Topic] | None = None) -> Iterator[tuple[Envelope, int]]:
        """Yield envelopes in file order, each with its ``log_time`` (UTC ns), of the given topics or of all."""
        wanted = {i: role for i, role in self._roles.items() if topics is None or role.topic in topics}
        if not any(self._counts[i] for i in wanted):
            return
        seen = dict.fromkeys(wanted, 0)
        with self._readable() as file:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=_size(file)).records:
                if isinstance(record, Message) and record.channel_id in wanted:
                    number = seen[record.channel_id]
                    seen[record.channel_id] += 1
                    yield self._envelope(wanted[record.channel_id], record, number), record.log_time

    def _envelope(self, role: _Role, record: Message, number: int) -> Envelope:
        if not role.standard:
            return Envelope(role.topic, role.key, record.data, Stamp(record.sequence, record.publish_time, 0))
        try:
            payload, t_capture_ns = standard_message(role.schema, record.data)
        except ValueError as error:
            raise RecordingError(f"{self.path}: {self._names[record.channel_id]}: {error}") from error
        if t_capture_ns == 0:
            t_capture_ns = record.publish_time or record.log_time
            payload = stamped(payload, t_capture_ns) if role.topic is FRAME else payload
        return Envelope(role.topic, role.key, payload, Stamp(number, t_capture_ns, 0))

    @contextlib.contextmanager
    def _readable(self) -> Iterator[IO[bytes]]:
        """Open the file; whatever it then turns out not to be becomes one clear error."""
        try:
            with self.path.open("rb") as file:
                yield file
        except RecordingError:
            raise
        except FileNotFoundError as error:
            raise RecordingError(f"no such recording: {self.path}") from error
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror}") from error
        except Exception as error:  # damaged bytes raise whatever the parser stumbles on
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RecordingError(f"{self.path} is damaged ({reason}): run `relnav recover {self.path}`") from error


def _size(file: IO[bytes]) -> int:
    return os.fstat(file.fileno()).st_size


def _require_magic(path: Path, file: IO[bytes]) -> None:
    """Raise RecordingError unless the file begins as an MCAP file does."""
    if file.read(len(MAGIC)) != MAGIC:
        raise RecordingError(f"{path} is not an MCAP recording" if _size(file) else f"{path} is empty")


def _require_ends(path: Path, file: IO[bytes]) -> None:
    """Raise RecordingError unless the file begins and ends as a finished MCAP file does."""
    _require_magic(path, file)
    file.seek(max(_size(file) - len(MAGIC), len(MAGIC)))
    if file.read() != MAGIC:
        raise RecordingError(f"{path} is truncated or still being written: run `relnav recover {path}`")


def _require_summary_crc(file: IO[bytes]) -> None:
    """Raise ValueError when the summary is not what its checksum says."""
    file.seek(_size(file) - _FOOTER.size)
    _, summary_start, _, crc, _ = _FOOTER.unpack(file.read())
    if not summary_start or not crc:
        return
    file.seek(summary_start)
    if zlib.crc32(file.read()[: -len(MAGIC) - 4]) != crc:
        raise ValueError("wrong checksum of the summary")


def _mission_attachment(file: IO[bytes]) -> bytes | None:
    """Return the mission's text, None when the recording carries none."""
    for attachment in SeekingReader(_rewound(file), record_size_limit=_size(file)).iter_attachments():
        if attachment.name == ATTACHMENT:
            if not _intact(file, attachment):
                raise ValueError(f"wrong checksum of {ATTACHMENT}")
            return attachment.data
    return None


def _intact(file: IO[bytes], attachment: Attachment) -> bool:
    """Tell whether an attachment just read is, with its checksum, what the file holds."""
    builder = RecordBuilder()
    attachment.write(builder)
    expected = builder.end()
    end = file.tell()
    file.seek(end - len(expected))
    return file.read(len(expected)) == expected


def _roles(summary: Summary, counts: dict[int, int], mission: Mission) -> dict[int, _Role]:
    """Find what each channel is to us: its key is in our table, or it is the file's only image or calibration."""
    roles: dict[int, _Role] = {}
    others: dict[int, str] = {}
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        name = schema.name if schema is not None and channel.message_encoding == "protobuf" else ""
        topic = topic_for_key(channel.topic)
        if topic is not None and schema_name(topic.schema) == name:
            roles[channel.id] = _Role(topic, channel.topic, False, name)
        elif counts[channel.id]:
            others[channel.id] = name
    for topic, names in ((FRAME, IMAGE_SCHEMAS), (CALIBRATION, CALIBRATION_SCHEMAS)):
        candidates = [i for i, name in others.items() if name in names]
        if len(candidates) == 1 and not any(role.topic is topic for role in roles.values()):
            (only,) = candidates
            key = topic.key(vehicle=mission.vehicle, camera=mission.camera.name)
            roles[only] = _Role(topic, key, True, others[only])
    return roles


@dataclass(frozen=True)
class RecoverReport:
    """What ``recover`` found."""

    messages: int
    lost_bytes: int
    out: Path
    """The whole recording: a new file, or the given one when nothing was wrong with it."""
    whole: bool
    """Nothing was wrong, nothing was written."""


def recover(path: str | Path, out: str | Path | None = None) -> RecoverReport:
    """Write all that can be read of a truncated or damaged recording as a whole one.

    ``out`` is ``NAME.recovered.mcap`` beside the file unless given; the file itself is not touched.  Chunks with a
    wrong checksum are left out.  Raises RecordingError when the file is no recording or holds no message.
    """
    path = Path(path)
    out = path.with_suffix(".recovered.mcap") if out is None else Path(out)
    whole = _count_if_whole(path)
    if whole is not None:
        return RecoverReport(messages=whole, lost_bytes=0, out=path, whole=True)
    part = out.with_name(out.name + ".part")
    try:
        with path.open("rb") as file, part.open("wb") as part_file:
            _require_magic(path, file)
            messages, lost_bytes = _copy_intact(file, _open_writer(part_file))
        if messages == 0:
            raise NothingRecordedError(f"{path} holds no complete message: nothing to recover")
        part.replace(out)
    except OSError as error:
        raise RecordingError(f"cannot recover {path} to {out}: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
    return RecoverReport(messages=messages, lost_bytes=lost_bytes, out=out, whole=False)


def _count_if_whole(path: Path) -> int | None:
    """Return the number of messages of a recording that is in order from end to end, None for any other."""
    try:
        recording = Recording(path)
        with recording._readable() as file:
            records = StreamReader(file, validate_crcs=True, record_size_limit=_size(file)).records
            found = sum(isinstance(record, Message) for record in records)
    except ValueError:
        return None
    return found if found == recording.message_count else None


def _copy_intact(file: IO[bytes], writer: Writer) -> tuple[int, int]:
    """Copy every intact record and finish the copy; return messages copied and bytes that were given up."""
    schemas, channels = _summary_tables(file)
    channel_ids: dict[int, int] = {}
    schema_ids: dict[int, int] = {0: 0}
    messages = lost_bytes = 0
    for record in _intact_records(file):
        if isinstance(record, int):
            lost_bytes += record
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None or (channel.schema_id and channel.schema_id not in schemas):
                lost_bytes += len(record.data)
                continue
            if channel.schema_id not in schema_ids:
                schema = schemas[channel.schema_id]
                schema_ids[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channel_ids:
                channel_ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_ids[channel.schema_id], channel.metadata
                )
            writer.add_message(
                channel_ids[channel.id], record.log_time, record.data, record.publish_time, record.sequence
            )
            messages += 1
    writer.finish()
    return messages, lost_bytes


def _summary_tables(file: IO[bytes]) -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Return the schemas and channels of the summary, empty when there is none that can be trusted."""
    try:
        _require_summary_crc(file)
        summary = SeekingReader(_rewound(file), record_size_limit=_size(file)).get_summary()
    except Exception:  # a truncated file ends in bytes that mean anything
        return {}, {}
    return (summary.schemas, summary.channels) if summary is not None else ({}, {})


def _intact_records(file: IO[bytes]) -> Iterator[McapRecord | int]:
    """Yield the intact records in file order, chunks opened, and for what is damaged its number of bytes.

    A message outside a chunk has no checksum: in a chunked file it is taken for debris.
    """
    records = StreamReader(_rewound(file), emit_chunks=True, record_size_limit=_size(file)).records
    end, chunked = 0, False
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception:  # where the parser stumbles, the readable part ends
            yield _size(file) - end
            return
        end = file.tell()
        if isinstance(record, Chunk):
            chunked = True
            try:
                yield from breakup_chunk(record, validate_crc=True)
            except Exception:  # wrong checksum, or what follows from damage without one
                yield len(record.data)
        elif isinstance(record, Attachment) and not _intact(file, record):
            yield len(record.data)
        elif not (chunked and isinstance(record, Message)):
            yield record


def _rewound(file: IO[bytes]) -> IO[bytes]:
    file.seek(0)
    return file
