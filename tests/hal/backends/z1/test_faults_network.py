"""A bad network between the real Z1's driver and its arm, and other senders to their ports."""

from __future__ import annotations

import numpy as np
import pytest

from hal.backends.z1.config import Z1Mode
from hal.base.messages import ServoMode
from hal.z1_protocol.controller import COMMAND_SIZE, STATE_SIZE
from tests.support.faults_table import FaultsTable
from tests.support.hal.bad_network import FATES, BadNetwork
from tests.support.hal.wire_bench import WireBench

pytestmark = pytest.mark.faults

FUZZ = 100_000


@pytest.mark.integration
@pytest.mark.parametrize("fate", FATES)
def test_a_tenth_of_all_datagrams(fate: str, faults_table: FaultsTable) -> None:
    bench = WireBench()
    network = BadNetwork(FATES[fate])
    bench.play(lambda: setattr(bench.link, "mangle", network))
    assert network.touched > 50
    bench.assert_safe()
    assert bench.status.finished or bench.status.mode is ServoMode.STOPPED
    bench.report(faults_table, f"10 % of all datagrams {fate}")


@pytest.mark.integration
def test_random_datagrams(faults_table: FaultsTable) -> None:
    """Half of them to the driver, with the right head as well; half to the controller, which would obey that head."""
    bench = WireBench(Z1Mode.LOW_LEVEL)
    rng = np.random.default_rng(0)
    per_tick = 100
    sent = 0

    def noise(size: int, head: bytes) -> bytes:
        kind = rng.integers(3)
        return rng.bytes(int(rng.integers(400))) if kind == 0 else (head * int(kind == 2) + rng.bytes(size))[:size]

    def flood(data: bytes) -> list[bytes]:
        nonlocal sent
        if sent >= FUZZ:
            return [data]
        sent += per_tick
        size, head = (STATE_SIZE, b"\xfe\xff\x02\0\0\0") if len(data) == STATE_SIZE else (COMMAND_SIZE, b"")
        return [noise(size, head) for _ in range(per_tick)] + [data]

    bench.play(lambda: setattr(bench.link, "mangle", flood))
    assert sent >= FUZZ
    port, counts = bench.twin.port, bench.arm.diagnostics().counts
    assert port.dropped + port.invalid_datagrams + counts.invalid > 0.9 * FUZZ
    bench.assert_safe()
    bench.report(faults_table, f"{sent:,} random datagrams")
