"""The messages of a recording: a file, or a directory of segments; whole, or cut off anywhere."""

import pathlib
import struct

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

# What the streaming reader raises where a file ends within a record, or where bytes are not what they should be.
DAMAGE = (McapError, EOFError, struct.error, ValueError, IndexError, KeyError, RuntimeError)


def segments(path):
    """Files of a recording, in order."""
    path = pathlib.Path(path)
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.mcap"))
    if not files:
        raise FileNotFoundError(f"{path} has no .mcap segment")
    return files


def records(path, warnings):
    """Channels' topics with decoded messages, and attachments (topic `None`), in the order of the files."""
    for file in segments(path):
        with open(file, "rb") as stream:
            if stream.read(8) != b"\x89MCAP0\r\n":
                raise ValueError(f"{file} is not an MCAP recording (its first bytes are not those of one)")
            stream.seek(0)
            yield from of_stream(stream, file, warnings)


def of_stream(stream, file, warnings):
    schemas, channels, decoders, factory = {}, {}, {}, DecoderFactory()
    reader = iter(StreamReader(stream).records)
    while True:
        try:
            record = next(reader)
        except StopIteration:
            return
        except DAMAGE as error:
            warnings.append(f"{file} is cut off or damaged: read to its last whole record ({error or type(error).__name__})")
            return
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Attachment):
            yield None, None, record
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            if record.channel_id not in decoders:
                schema = schemas.get(channel.schema_id)
                decoders[record.channel_id] = factory.decoder_for(channel.message_encoding, schema) if schema else None
            decode = decoders[record.channel_id]
            if decode is None:
                continue
            try:
                yield channel.topic, record, decode(record.data)
            except Exception as error:  # protobuf's own errors have no base but this
                warnings.append(f"{file}: a message on {channel.topic} is damaged and skipped: {error}")
