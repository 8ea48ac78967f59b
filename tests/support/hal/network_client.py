"""Clients of a HAL on another machine: what each party's keys let it do, printed as JSON."""

from __future__ import annotations

import json
import socket
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import numpy as np

from hal.base.errors import Z1Error
from hal.base.messages import ArmSetpoint, TrajectoryChunk
from hal.bus import keys
from hal.bus.authentication import Request
from hal.bus.client import RemoteArm
from hal.bus.codec import encode
from hal.bus.session import BusConfig, open_session
from tests.support.hal.bus_hal import HOME

COMMANDS = (keys.CLAIM, keys.CHUNK, keys.SEND, keys.RELEASE, keys.REARM)


def code_of(call) -> str:
    """Return the code of the error that `call` raises; "done" without one."""
    try:
        call()
    except Z1Error as error:
        return error.code
    return "done"


def stay(trajectory_id: int) -> TrajectoryChunk:
    t_s, q = np.array([0.0, 0.05]), np.array([HOME, HOME])
    return TrajectoryChunk(trajectory_id=trajectory_id, t_s=t_s, q=q, dq=np.zeros((2, 7)), final=True)


def use(config: BusConfig) -> dict[str, str]:
    """Try all that a client can do, in order."""
    arm = RemoteArm(config, owner="tester")
    found = {"connect": code_of(arm.connect)}
    if found["connect"] == "done":
        found["read"] = code_of(arm.read_state)
        found["claim"] = code_of(arm.claim)
        found["stream"] = code_of(lambda: arm.stream(stay(arm.status().trajectory_id + 1)))
        found["rearm"] = code_of(arm.rearm)
        found["owner"] = arm.status().owner
        arm.disconnect()
    return found


def attack(config: BusConfig) -> dict[str, object]:
    """Send raw commands, declare the HAL's services, publish its topics; return what was answered, asked and heard."""
    try:
        session, spy = open_session(config, listen=False), open_session(config, listen=False)
    except Z1Error as error:
        return {"refused": error.code}
    asked: list[str] = []
    with session, spy:
        for key in ("**", *keys.SERVICES):
            spy.declare_queryable(key, lambda query: asked.append(str(query.key_expr)), complete=True)
        for key in ("**", *keys.PUBLISHED, keys.HEARTBEAT):
            spy.declare_subscriber(key, lambda sample: asked.append(str(sample.key_expr)))
        answered = []
        for key in COMMANDS:
            payload = encode(ArmSetpoint(q=HOME, dq=np.zeros(7))) if key == keys.SEND else encode(stay(7))
            request = Request.make(b"", key, payload, "tester", 1)
            if list(session.get(key, payload=payload, attachment=request.pack(), timeout=0.5)):
                answered.append(key)
        for key in (keys.HEARTBEAT, keys.STATE, keys.STATUS):
            session.put(key, b"forged")
        Event().wait(0.3)
    return {"answered": answered, "heard": sorted(set(asked))}


def replay(config: BusConfig) -> dict[str, object]:
    """Record the bytes of a whole session of an operator in a proxy, and send them to the HAL again."""
    recorded = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as server:
        Thread(target=_forward, args=(server, config, recorded), daemon=True).start()
        found = use(replace(config, host="127.0.0.1", port=server.getsockname()[1]))
    with socket.create_connection((config.host, config.port), timeout=2.0) as again:
        again.sendall(recorded)
        answer = b""
        try:
            while part := again.recv(65536):
                answer += part
        except (TimeoutError, ConnectionError):
            pass
    return {**found, "recorded": len(recorded), "answered": len(answer)}


def _forward(server: socket.socket, config: BusConfig, recorded: bytearray) -> None:
    client, _ = server.accept()
    hal = socket.create_connection((config.host, config.port))

    def pump(source: socket.socket, sink: socket.socket, copy: bytearray) -> None:
        try:
            while data := source.recv(65536):
                copy += data
                sink.sendall(data)
        except OSError:
            pass
        sink.close()

    Thread(target=pump, args=(hal, client, bytearray()), daemon=True).start()
    pump(client, hal, recorded)


def main(root: str, address: str, port: str) -> None:
    """Act as each party whose folder is in `root`, and print what each could do."""
    found: dict[str, object] = {}
    for folder in sorted(Path(root).iterdir()):
        if not (folder / "private.key").exists() or folder.name in ("hal", "authority"):
            continue
        config = BusConfig(host=address, port=int(port), keys=str(folder), connect_timeout_s=1.0, state_max_age_s=5.0)
        if folder.name == "operator":
            found["replay"] = replay(config)
        found[folder.name] = {**use(config), **attack(config)}
    found["without keys"] = {"connect": code_of(lambda: RemoteArm(BusConfig(host=address, port=int(port))).connect())}
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
