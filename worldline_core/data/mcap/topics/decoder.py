"""Messages decoded by the schemas that the file itself holds."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoderFactory
from mcap_ros2.decoder import DecoderFactory as Ros2DecoderFactory

from worldline_core.data.guards.json_file import parse_json
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.topics.fields import READERS, stated_time
from worldline_core.data.mcap.topics.messages import SCHEMA_KINDS, Kind, Message, schema_name

# What the decoders raise for bytes that are not of their schema; the ROS 2 parser raises plain subclasses of these.
_FAULTS = (
    McapError,
    DecodeError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    struct.error,
    binascii.Error,
)


class MessageDecoder:
    """Decodes the messages of one file's channels."""

    def __init__(self, where: object) -> None:
        self._where = where
        self._factories = (Ros2DecoderFactory(), ProtobufDecoderFactory())
        self._channels: dict[int, tuple[Kind, Callable[[bytes], Any]]] = {}

    def kind(self, channel: Channel, schema: Schema | None) -> Kind:
        """What a channel's messages say.

        Raises: RejectedInputError (unknown_schema).
        """
        return self._channel(channel, schema)[0]

    def decode(self, channel: Channel, schema: Schema | None, data: bytes) -> Message:
        """One message.

        Raises: RejectedInputError: unknown_schema; unreadable where the bytes are not of the schema.
        """
        kind, decode = self._channel(channel, schema)
        try:
            raw = decode(data)
            return Message(stated_time(raw), READERS[kind](raw))
        except _FAULTS as error:
            raise RejectedInputError(
                "unreadable",
                "Message cannot be decoded",
                where=f"{self._where}, topic {channel.topic}",
                expected=schema.name if schema else "a schema",
                got=repr(error)[:200],
            ) from error

    def _channel(self, channel: Channel, schema: Schema | None) -> tuple[Kind, Callable[[bytes], Any]]:
        if channel.id not in self._channels:
            name = schema.name if schema is not None else ""
            kind = SCHEMA_KINDS.get(schema_name(name))
            decoder = self._decoder(channel, schema) if kind is not None else None
            if kind is None or decoder is None:
                encoding = schema.encoding if schema is not None else "no schema"
                raise RejectedInputError(
                    "unknown_schema",
                    "Messages of this schema are not understood",
                    where=f"{self._where}, topic {channel.topic}",
                    expected="CDR with ros2msg, protobuf or JSON of " + ", ".join(SCHEMA_KINDS),
                    got=f"{name or 'no schema'} ({channel.message_encoding or 'no encoding'}, {encoding})",
                    next_step="name another topic, or convert the recording",
                    evidence={"topic": channel.topic, "schema": name, "encoding": channel.message_encoding},
                )
            self._channels[channel.id] = kind, decoder
        return self._channels[channel.id]

    def _decoder(self, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if channel.message_encoding == "json":
            return partial(parse_json, where=f"{self._where}, topic {channel.topic}")
        try:
            found = (factory.decoder_for(channel.message_encoding, schema) for factory in self._factories)
            return next((decoder for decoder in found if decoder is not None), None)
        except _FAULTS as error:
            raise RejectedInputError(
                "unknown_schema",
                "Schema definition cannot be read",
                where=f"{self._where}, topic {channel.topic}",
                expected=schema.name if schema else "a schema",
                got=repr(error)[:200],
            ) from error
