"""Datagrams through the kernel's loopback."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base.errors import HalError, LeaseError
from hal.z1_protocol.link import UdpLink
from tests.support.errors import raises

HERE = "127.0.0.1"


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((HERE, 0))
        return probe.getsockname()[1]


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as peer:
        peer.bind((HERE, 0))
        peer.settimeout(2.0)
        yield peer


@pytest.fixture
def link(peer: socket.socket) -> Iterator[UdpLink]:
    link = UdpLink((HERE, peer.getsockname()[1]), (HERE, free_port()))
    link.open()
    yield link
    link.close()


def test_datagrams_are_exchanged_in_both_directions(link: UdpLink, peer: socket.socket) -> None:
    assert link.send(b"question")
    data, address = peer.recvfrom(100)
    assert data == b"question"
    peer.sendto(b"answer", address)
    received = link.receive(2.0)
    assert received is not None
    assert bytes(received) == b"answer"
    assert link.receive() is None


def test_a_datagram_longer_than_the_buffer_is_cut_and_nothing_breaks(link: UdpLink, peer: socket.socket) -> None:
    link.send(b"?")
    address = peer.recvfrom(100)[1]
    peer.sendto(bytes(60_000), address)
    received = link.receive(2.0)
    assert received is not None
    assert len(received) == 2048


def test_datagrams_of_other_senders_are_dropped(link: UdpLink, peer: socket.socket) -> None:
    link.send(b"?")
    address = peer.recvfrom(100)[1]
    with socket.socket(type=socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"I am the controller", address)
    peer.sendto(b"I am", address)
    received = link.receive(2.0)
    assert received is not None
    assert bytes(received) == b"I am"
    assert link.receive() is None


def test_a_second_client_gets_the_port_and_the_remedy(link: UdpLink) -> None:
    second = UdpLink(link._remote, link._local)
    with raises(LeaseError, "port_in_use") as caught:
        second.open()
    assert f"port {HERE}:{link._local[1]} is in use" in str(caught.value)
    assert "ss -lunp" in str(caught.value)
    second.close()


def test_an_address_of_another_machine_is_an_error() -> None:
    with raises(HalError, "address_unavailable"):
        UdpLink((HERE, 9), ("192.0.2.1", 9)).open()


def test_a_closed_port_is_detected_and_raises_nothing() -> None:
    link = UdpLink((HERE, free_port()), (HERE, free_port()))
    link.open()
    for _ in range(3):
        link.send(b"?")
        assert link.receive(0.05) is None
    assert "nothing listens on the port" in link.describe()
    link.close()
    assert not link.send(b"?")
    assert link.receive() is None


def test_a_link_is_closed_and_opened_again(link: UdpLink, peer: socket.socket) -> None:
    link.close()
    link.close()
    link.open()
    link.open()
    assert link.send(b"again")
    assert peer.recv(100) == b"again"


def test_noise_of_any_size_comes_through_as_it_is(link: UdpLink, peer: socket.socket) -> None:
    rng = np.random.default_rng(3)
    link.send(b"?")
    address = peer.recvfrom(100)[1]
    for size in rng.integers(0, 2000, 200):
        noise = rng.bytes(int(size))
        peer.sendto(noise, address)
        received = link.receive(2.0)
        assert received is not None
        assert bytes(received) == noise
