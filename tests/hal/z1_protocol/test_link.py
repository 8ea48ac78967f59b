"""Datagrams through the kernel."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base.errors import HalError, LeaseError
from hal.z1_protocol.link import UdpLink

HERE = "127.0.0.1"


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((HERE, 0))
        return probe.getsockname()[1]


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as made:
        made.bind((HERE, 0))
        made.settimeout(2.0)
        yield made


@pytest.fixture
def link(peer: socket.socket) -> Iterator[UdpLink]:
    made = UdpLink((HERE, peer.getsockname()[1]), (HERE, free_port()))
    made.open()
    yield made
    made.close()


def test_datagrams_go_both_ways(link: UdpLink, peer: socket.socket) -> None:
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


def test_strangers_are_not_heard(link: UdpLink, peer: socket.socket) -> None:
    link.send(b"?")
    address = peer.recvfrom(100)[1]
    with socket.socket(type=socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"I am the controller", address)
    peer.sendto(b"I am", address)
    received = link.receive(2.0)
    assert received is not None
    assert bytes(received) == b"I am"
    assert link.receive() is None


def test_a_second_client_is_told_that_the_port_is_taken(link: UdpLink) -> None:
    second = UdpLink(link._remote, link._local)
    with pytest.raises(LeaseError, match=rf"{link._local[1]} is taken: another program .*ss -lunp"):
        second.open()
    second.close()


def test_an_address_that_is_not_this_machines_is_said() -> None:
    with pytest.raises(HalError, match=r"cannot talk from 192\.0\.2\.1:9 to 127\.0\.0\.1:9: .*address"):
        UdpLink((HERE, 9), ("192.0.2.1", 9)).open()


def test_a_port_where_nobody_listens_is_noticed_and_raises_nothing() -> None:
    link = UdpLink((HERE, free_port()), (HERE, free_port()))
    link.open()
    for _ in range(3):
        link.send(b"?")
        assert link.receive(0.05) is None
    assert "nothing listens on that port" in link.describe()
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
