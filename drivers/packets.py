"""Binary packets on a byte stream that may start anywhere, lose bytes and carry noise.

    A5 5A | kind u8 | length u16 | sequence u32 | payload (length bytes) | crc u16

little-endian; the CRC is CRC-16/CCITT-FALSE over kind…payload. `parse` is a pure function from
the bytes not yet used and new ones to packets and the bytes to keep. After a damaged packet it
looks for the next sync from one byte behind the damaged one's, so that a sync inside a payload, or
a length that lies, costs no more than the packet itself.
"""

import binascii
import struct
from dataclasses import dataclass

SYNC = b"\xa5\x5a"
HEADER = struct.Struct("<2sBHI")
CRC = struct.Struct("<H")
LONGEST_PAYLOAD = 4096


@dataclass(frozen=True, slots=True)
class Packet:
    kind: int
    sequence: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Parsed:
    """`rest` is to be given to the next call; `damaged` packets failed their CRC or length."""

    packets: tuple[Packet, ...]
    rest: bytes
    damaged: int
    skipped: int


def checksum(data: bytes) -> int:
    """CRC-16/CCITT-FALSE; its check value over b"123456789" is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode(packet: Packet) -> bytes:
    head = HEADER.pack(SYNC, packet.kind, len(packet.payload), packet.sequence)
    return head + packet.payload + CRC.pack(checksum(head[2:] + packet.payload))


def parse(data: bytes) -> Parsed:
    """Every whole packet in `data`, in order.

    Examples
    --------
    >>> found = parse(b"noise" + encode(Packet(1, 7, b"abc")) + SYNC)
    >>> found.packets, found.rest, found.skipped
    ((Packet(kind=1, sequence=7, payload=b'abc'),), b'\\xa5Z', 5)
    """
    packets: list[Packet] = []
    position = damaged = skipped = 0
    while True:
        start = data.find(SYNC, position)
        if start < 0:
            # The last byte may be the first half of a sync, if it is no packet's.
            start = len(data) - data.endswith(SYNC[:1], position)
            return Parsed(tuple(packets), data[start:], damaged, skipped + start - position)
        skipped += start - position
        if len(data) - start < HEADER.size:
            return Parsed(tuple(packets), data[start:], damaged, skipped)
        _, kind, length, sequence = HEADER.unpack_from(data, start)
        end = start + HEADER.size + length + CRC.size
        if length <= LONGEST_PAYLOAD and len(data) < end:
            return Parsed(tuple(packets), data[start:], damaged, skipped)
        if length <= LONGEST_PAYLOAD and _sound(data, start, end):
            payload = data[start + HEADER.size : end - CRC.size]
            packets.append(Packet(kind, sequence, payload))
            position = end
        else:
            damaged += 1
            skipped += 1
            position = start + 1


def _sound(data: bytes, start: int, end: int) -> bool:
    (stated,) = CRC.unpack_from(data, end - CRC.size)
    return checksum(data[start + 2 : end - CRC.size]) == int(stated)
