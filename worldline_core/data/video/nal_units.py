"""Packets of H.264 and H.265 as mp4 holds them: every NAL unit behind its length.

FFmpeg's bitstream filters hand packets on with start codes (Annex B). Its mp4 writer stores them like that when the stream's
header is one of lengths; its decoders do not mind, while other players, and the joining of LeRobot's tools, do.
"""

from __future__ import annotations

from av import Packet
from av.video.stream import VideoStream

_START_CODE = b"\x00\x00\x01"


def length_prefixed(packet: Packet, stream: VideoStream) -> Packet:
    """The packet with lengths in the place of start codes, or itself where it has none.

    Args:
        stream: whose header (avcC, hvcC: it begins with 1) says that lengths are expected.
    """
    header = stream.codec_context.extradata
    if not header or header[0] != 1 or stream.codec_context.codec.canonical_name not in ("h264", "hevc"):
        return packet
    data = bytes(packet)
    if not data.startswith(b"\x00" + _START_CODE) or _are_lengths(data):
        return packet
    # A NAL unit ends without zeros and holds no start code (emulation prevention), so splitting at start codes is exact.
    units = [unit.rstrip(b"\x00") for unit in data.split(_START_CODE)]
    prefixed = Packet(b"".join(len(unit).to_bytes(4, "big") + unit for unit in units if unit))
    prefixed.pts, prefixed.dts, prefixed.duration = packet.pts, packet.dts, packet.duration
    prefixed.is_keyframe = packet.is_keyframe
    if packet.time_base is not None:
        prefixed.time_base = packet.time_base
    return prefixed


def _are_lengths(data: bytes) -> bool:
    position = 0
    while position + 4 < len(data):
        position += 4 + int.from_bytes(data[position : position + 4], "big")
    return position == len(data)
