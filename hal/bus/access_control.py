"""Roles of the link's clients, as access control of Zenoh in the HAL's session: what is not allowed here is dropped.

The HAL joins all its clients, so its rules also keep clients from each other: none can answer a request, publish a
state, or listen to another's requests, although Zenoh lets every session declare any key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hal.bus import keys

OPERATOR, VIEWER = "operator", "viewer"
ROLES = (OPERATOR, VIEWER)
"""An operator commands the arm; a viewer reads, and can stop it like everybody."""

_MAX_HEARTBEATS_HZ = 250.0  # five times the owner's rate; drops a flood before it reaches Python
# A service keeps 32 waiting messages, so these bound what a flood of large ones takes of the memory: 80 MB.
_MAX_BYTES, _MAX_CHUNK_BYTES = 64 * 2**10, 2 * 2**20  # the longest chunk has 1.2 MB
_IN, _OUT = "ingress", "egress"


def _rule(name: str, flow: str, messages: Sequence[str], key_expressions: Sequence[str], robot: str) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": [f"{robot}/{key}" for key in key_expressions],
    }


def access_control(robot: str, clients: Mapping[str, str] | None, own_name: str = "") -> dict[str, Any]:
    """Return Zenoh's `access_control` settings of the HAL of `robot`.

    Args:
        robot: name of the robot, the namespace of its keys.
        clients: role of each certificate's common name; None without TLS, when every client has the operator's role.
        own_name: common name of the HAL's own certificate, with which the twin serves its ground truth.
    """
    evaluation = f"{keys.EVALUATION}/*"
    viewing = [
        _rule("ask", _IN, ["query"], [*keys.QUESTIONS, evaluation], robot),
        _rule("listen", _IN, ["declare_subscriber"], keys.PUBLISHED, robot),
        _rule("publish", _OUT, ["put"], keys.PUBLISHED, robot),
        _rule("answer", _OUT, ["reply", "declare_queryable"], [*keys.QUESTIONS, evaluation], robot),
    ]
    commanding = [
        _rule("command", _IN, ["query"], keys.COMMANDS, robot),
        _rule("command answer", _OUT, ["reply", "declare_queryable"], keys.COMMANDS, robot),
        _rule("heartbeat", _IN, ["put"], [keys.HEARTBEAT], robot),
        _rule("heartbeat wanted", _OUT, ["declare_subscriber"], [keys.HEARTBEAT], robot),
    ]
    evaluating = [
        _rule("evaluation", _IN, ["reply", "declare_queryable"], [evaluation], robot),
        _rule("evaluation query", _OUT, ["query"], [evaluation], robot),
    ]
    granted = {
        OPERATOR: [rule["id"] for rule in (*viewing, *commanding)],
        VIEWER: [rule["id"] for rule in viewing],
        "evaluation": [rule["id"] for rule in evaluating],
    }
    if clients is None:
        subjects = {OPERATOR: None, "evaluation": None}
    else:
        subjects = {role: [name for name in clients if clients[name] == role] for role in ROLES}
        subjects["evaluation"] = [own_name]
    present = {role: names for role, names in subjects.items() if names is None or names}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*viewing, *commanding, *evaluating],
        "subjects": [
            {"id": role} if names is None else {"id": role, "cert_common_names": names}
            for role, names in present.items()
        ],
        "policies": [{"rules": granted[role], "subjects": [role]} for role in present],
    }


def heartbeat_limit(robot: str) -> list[dict[str, Any]]:
    """Return Zenoh's `downsampling` settings: the rate of heartbeats from one client."""
    rules = [{"key_expr": f"{robot}/{keys.HEARTBEAT}", "freq": _MAX_HEARTBEATS_HZ}]
    return [{"flows": [_IN], "messages": ["put"], "rules": rules}]


def size_limits(robot: str) -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter` settings: sizes of what a client sends."""
    small = [f"{robot}/{key}" for key in (*keys.SERVICES, keys.HEARTBEAT) if key != keys.CHUNK]
    limits = ((small, _MAX_BYTES), ([f"{robot}/{keys.CHUNK}"], _MAX_CHUNK_BYTES))
    return [
        {"flows": [_IN], "messages": ["put", "query"], "key_exprs": names, "size_limit": size} for names, size in limits
    ]
