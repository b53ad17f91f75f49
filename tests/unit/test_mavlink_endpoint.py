"""Addresses in both spellings."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint, EndpointKind, parse_endpoint

UDP_IN, UDP_OUT = EndpointKind.UDP_IN, EndpointKind.UDP_OUT
TCP, TCP_IN, SERIAL = EndpointKind.TCP_CLIENT, EndpointKind.TCP_SERVER, EndpointKind.SERIAL


@pytest.mark.parametrize(
    ("text", "kind", "host", "number"),
    [
        # pymavlink's
        ("udpin:0.0.0.0:14540", UDP_IN, "0.0.0.0", 14540),
        ("udp:127.0.0.1:14540", UDP_IN, "127.0.0.1", 14540),
        ("udpout:192.168.1.2:14550", UDP_OUT, "192.168.1.2", 14550),
        ("tcp:127.0.0.1:5760", TCP, "127.0.0.1", 5760),
        ("tcpin:0.0.0.0:5760", TCP_IN, "0.0.0.0", 5760),
        ("/dev/ttyACM0", SERIAL, "/dev/ttyACM0", 57600),
        ("/dev/ttyAMA0,921600", SERIAL, "/dev/ttyAMA0", 921600),
        # MAVSDK's
        ("udpin://0.0.0.0:14540", UDP_IN, "0.0.0.0", 14540),
        ("udp://:14540", UDP_IN, "0.0.0.0", 14540),
        ("udpout://10.0.0.7:14550", UDP_OUT, "10.0.0.7", 14550),
        ("tcpout://127.0.0.1:5760", TCP, "127.0.0.1", 5760),
        ("tcp://autopilot.local:5760", TCP, "autopilot.local", 5760),
        ("tcpin://0.0.0.0:5760", TCP_IN, "0.0.0.0", 5760),
        ("serial:///dev/ttyACM0:921600", SERIAL, "/dev/ttyACM0", 921600),
        ("serial:///dev/ttyACM0", SERIAL, "/dev/ttyACM0", 57600),
        ("serial_flowcontrol:///dev/ttyS1:57600", SERIAL, "/dev/ttyS1", 57600),
        # as people type
        ("  UDPIN:0.0.0.0:14540 ", UDP_IN, "0.0.0.0", 14540),
        ("udpin:[::]:14540", UDP_IN, "::", 14540),
        ("tcp://[::1]:5760", TCP, "::1", 5760),
        ("udpbcast:192.168.1.255:14550", EndpointKind.UDP_BROADCAST, "192.168.1.255", 14550),
        ("udpcast:192.168.1.255:14550", EndpointKind.UDP_BROADCAST, "192.168.1.255", 14550),
        ("udp:14540", UDP_IN, "0.0.0.0", 14540),
        ("COM7,115200", SERIAL, "COM7", 115200),
        ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0,57600", SERIAL, None, 57600),
    ],
)
def test_spellings(text, kind, host, number):
    endpoint = parse_endpoint(text)
    assert (endpoint.kind, endpoint.number) == (kind, number)
    assert endpoint.host == (host or text.rpartition(",")[0])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not an address I know"),
        ("14540", "not an address I know"),
        ("http://127.0.0.1:80", "not an address I know"),
        ("udpin:0.0.0.0", "names no port; use for example udpin:0.0.0.0:14540"),
        ("udpin:0.0.0.0:", "port '' is not a number"),
        ("udpout:a..b:14550", "is no host name"),
        (f"tcp:{'a' * 64}:5760", "is no host name"),
        ("udp://:14540@127.0.0.1:14557", "udpin:0.0.0.0:14540 to listen, or udpout:127.0.0.1:14557"),
        ("udpin:0.0.0.0:0", "port '0' is not a number from 1 to 65535"),
        ("udpin:0.0.0.0:65536", "port '65536' is not a number from 1 to 65535"),
        ("udpin:0.0.0.0:-1", "port '-1'"),
        ("tcp:127.0.0.1:57a", "port '57a'"),
        ("/dev/ttyACM0,fast", "baud rate 'fast'"),
        ("/dev/ttyACM0,0", "baud rate '0'"),
        ("serial:", "names no device"),
        ("serial://:57600", "names no device"),
        ("serial:,57600", "names no device"),
    ],
)
def test_wrong_addresses_are_named(text, says):
    with pytest.raises(UserError) as caught:
        parse_endpoint(text)
    assert says in str(caught.value)
    assert repr(text.strip()) in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.text(max_size=40))
def test_any_text_is_an_endpoint_or_a_user_error(text):
    try:
        endpoint = parse_endpoint(text)
    except UserError:
        return
    assert endpoint.host and endpoint.number >= 1


@given(
    st.sampled_from([UDP_IN, UDP_OUT, TCP, TCP_IN]),
    st.from_regex(r"[a-z0-9]{1,20}(\.[a-z0-9]{1,20})?|::1", fullmatch=True),
    st.integers(1, 65535),
)
def test_both_spellings_come_back(kind, host, port):
    endpoint = Endpoint(kind, host, port)
    assert parse_endpoint(str(endpoint)) == endpoint
    assert parse_endpoint(endpoint.mavsdk_url) == endpoint


def test_serial_comes_back():
    endpoint = Endpoint(SERIAL, "/dev/ttyACM0", 921600)
    assert parse_endpoint(str(endpoint)) == endpoint
    assert parse_endpoint(endpoint.mavsdk_url) == endpoint
