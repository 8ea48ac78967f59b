"""`./z1 stop`: the arm brakes, holds, and rejects every command until `./z1 rearm`.

It goes to the HAL of this user and this machine by a Unix socket, else over the link. In an emergency nothing may
delay it: it parses its options with the standard library, and imports the link only where the socket finds no HAL.
"""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from hal.base.clock import WallClock
from hal.base.errors import HalError, Z1Error
from hal.bus.stop_socket import StopAnswer, StopClient

if TYPE_CHECKING:
    from hal.bus.session import BusConfig

_BRAKING_S = 2.0  # five times the longest braking, 0.4 s
_PROBE_S = 0.1
_STOPPED, _DEFAULT_HOST, _DEFAULT_PORT = "stopped", "127.0.0.1", 7447  # as in `BusConfig`, which takes 0.3 s to import
_SENT = "stop_unverified"
NOTHING_WAS_STOPPED = "NOTHING WAS STOPPED. USE THE SWITCH ON THE ARM."


def main(arguments: Sequence[str]) -> int:
    """Stop the arm and print the servo's status; 1 when it is not known to be at rest."""
    options = parse(arguments)
    try:
        status = _stop_by_socket(options) or _stop_over_link(options)
    except Exception as error:  # every type: the first line is for the operator
        if getattr(error, "code", "") == _SENT:
            print(f"error: {error}", file=sys.stderr)
            return 1
        print(f"{NOTHING_WAS_STOPPED}\nerror: {error}", file=sys.stderr)
        if isinstance(error, Z1Error | OSError):
            return 1
        raise
    print(f"servo: {status.mode} ({status.reason})" + (f", owned by {status.owner}" if status.owner else ""))
    if status.mode != _STOPPED:
        print("error: stop: the arm is not at rest. USE THE SWITCH ON THE ARM.", file=sys.stderr)
        return 1
    print("nothing moves until the operator has inspected the arm and typed: ./z1 rearm")
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options in `arguments`."""
    summary, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(prog="z1 stop", description=summary, epilog=rest)
    parser.add_argument("--reason", default="./z1 stop", help="reason in the arm's status")
    parser.add_argument("--robot", default="z1", help="name of the robot")
    parser.add_argument("--host", default=_DEFAULT_HOST, help="address of the HAL")
    parser.add_argument("--port", type=int, default=_DEFAULT_PORT, help="its TCP port")
    parser.add_argument("--keys", default="", help="folder with this party's certificate, for another machine")
    parser.add_argument("--connect-timeout-s", type=float, default=2.0, help="how long to try [s]")
    return parser.parse_args(arguments)


def _stop_by_socket(options: argparse.Namespace) -> StopAnswer | None:
    """Return the servo's status after the stop; None when this user runs no HAL there, or it gives no answer."""
    try:
        client = StopClient(options.robot, options.port)
    except HalError:
        return None
    try:
        client.stop(options.reason)
        return wait_until_stopped(client.read_status)
    except HalError as error:
        print(f"warning: {error}", file=sys.stderr)
        return None
    finally:
        client.close()


def _stop_over_link(options: argparse.Namespace) -> StopAnswer:
    # Zenoh tries again until its timeout; a port without a listener is known at once.
    try:
        socket.create_connection((options.host, options.port), timeout=_PROBE_S).close()
    except OSError as error:
        if isinstance(error, ConnectionRefusedError) or options.host == _DEFAULT_HOST:
            raise HalError(
                f"stop: no HAL listens at {options.host}, port {options.port}. Check `--host` and `--port`.",
                code="no_hal",
            ) from error
    from hal.base.messages import ServoStatus
    from hal.bus import keys
    from hal.bus.codec import decode
    from hal.bus.link import BusLink
    from hal.bus.session import BusConfig

    config = BusConfig(
        robot=options.robot,
        host=options.host,
        port=options.port,
        keys=options.keys,
        connect_timeout_s=options.connect_timeout_s,
    )
    try:
        # Not `RemoteArm`, which waits for the arm's first state: a stop must reach an arm that sends none.
        link = BusLink(config, WallClock(), "the arm")
    except HalError as error:
        if error.code == "unverified_hal":
            _stop_unverified(config, options.reason)
        raise
    try:
        link.request(keys.STOP, options.reason.encode(), "stop command")

        def read() -> StopAnswer:
            status = decode(link.request(keys.READ_STATUS), ServoStatus)
            return StopAnswer(status.mode.value, status.reason, status.owner)

        return wait_until_stopped(read)
    finally:
        link.close()


def _stop_unverified(config: BusConfig, reason: str) -> None:
    """Send a stop to a HAL that may be another user's.

    Raises:
        HalError: always, since its answer cannot be trusted: `stop_unverified`, or `no_answer` when there is none.
    """
    from hal.bus import keys
    from hal.bus.session import open_session

    with open_session(config, listen=False) as session:
        answers = list(session.get(keys.STOP, payload=reason.encode(), timeout=config.request_timeout_s))
    if any(answer.ok for answer in answers):
        raise HalError(
            f"stop: the stop was sent to {config.endpoint}, but it cannot be verified that this is the arm's HAL: it "
            f"is not this user's. USE THE SWITCH ON THE ARM if it moves.",
            code=_SENT,
        )


def wait_until_stopped(read: Callable[[], StopAnswer]) -> StopAnswer:
    """Return the first status that shows the stop, or the newest one after the longest braking time."""
    clock = WallClock()
    deadline_s = clock.now_s() + _BRAKING_S
    while (status := read()).mode != _STOPPED and clock.now_s() < deadline_s:
        clock.sleep_until(clock.now_s() + 0.01)
    return status
