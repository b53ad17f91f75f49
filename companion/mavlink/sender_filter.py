"""One sender only, by the kernel: a socket's filter drops datagrams of everybody else before they are queued.

Without it a stranger's flood fills the socket's queue, so that the autopilot's own datagrams are lost, and wakes the
control thread for every one. Linux only (SO_ATTACH_FILTER, classic BPF); elsewhere they are dropped after being read.
"""

from __future__ import annotations

import ctypes
import socket
import struct
import sys

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27  # <asm-generic/socket.h>; Python names no constants for them
_INSTRUCTION = struct.Struct("=HBBI")  # struct sock_filter: code, jump if true, jump if false, k
_NETWORK_HEADER = 0xFFF00000  # SKF_NET_OFF: offsets from here on count from the IP header
_LOAD_WORD, _LOAD_HALF, _JUMP_EQUAL, _RETURN = 0x20, 0x28, 0x15, 0x06
_SOURCE_ADDRESS = {socket.AF_INET: _NETWORK_HEADER + 12, socket.AF_INET6: _NETWORK_HEADER + 8}
_IPV4_IN_IPV6 = "::ffff:"  # how a socket that hears both spells an IPv4 sender
_SOURCE_PORT = 0  # a UDP socket's filter sees the datagram from its UDP header on
_WHOLE = 0xFFFFFFFF


def hear_only(listener: socket.socket, sender: tuple[str, int] | tuple[str, int, int, int]) -> bool:
    """Let only datagrams of `sender` (IPv4 or IPv6 address, port, …) into a UDP socket; False where the system cannot."""
    if sys.platform != "linux":
        return False
    host, port = sender[0].partition("%")[0].removeprefix(_IPV4_IN_IPV6), sender[1]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        words = struct.iter_unpack(">I", socket.inet_pton(family, host))
        wanted = [(_LOAD_WORD, _SOURCE_ADDRESS[family] + 4 * n, word) for n, (word,) in enumerate(words)]
        wanted.append((_LOAD_HALF, _SOURCE_PORT, port))
        tests = []
        for load, place, value in wanted:
            to_the_end = 2 * len(wanted) - len(tests) - 1
            tests += [(load, 0, 0, place), (_JUMP_EQUAL, 0, to_the_end, value)]
        program = b"".join(
            _INSTRUCTION.pack(*instruction)
            for instruction in (*tests, (_RETURN, 0, 0, _WHOLE), (_RETURN, 0, 0, 0))
        )
        buffer = ctypes.create_string_buffer(program, len(program))
        count = len(program) // _INSTRUCTION.size
        listener.setsockopt(
            socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("HP", count, ctypes.addressof(buffer))
        )
    except OSError:
        return False
    return True


def hear_everybody(listener: socket.socket) -> None:
    """Take the filter away."""
    try:
        listener.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
    except OSError:
        return  # there was none
