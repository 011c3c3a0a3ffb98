"""A complete rig for a small board: one Zenoh session, JSON, struct and CRC, no estune.

Written from docs/reference/rig-protocol.md alone. Its drum follows the setpoint with a lag. It
supports steps only, keeps one record, sends it in parts of 1 KiB, and writes its ledger to a file.
It prints its endpoint, and ends when its standard input is closed. Verbs that
it lacks may be named.
"""

import json
import math
import os
import secrets
import socket
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import zenoh

from tests.small_board_frames import (
    RATE_HZ,
    Refused,
    answer,
    check_fields,
    finite,
    gains_of,
    parse,
    part,
    record,
)

LEASE_S = 1.0
NAME, FILE = sys.argv[1], Path(sys.argv[2])
INSTANCE = secrets.token_hex(4)
ROOT = f"reel/v1/{NAME}"


def load():
    """Ledger of the last start, with its open trials ended."""
    stored = {"identity": secrets.token_hex(8), "latched": "", "trials": {}}
    if FILE.exists():
        stored = json.loads(FILE.read_text())
    for entry in stored["trials"].values():
        booted = {"accepted": "never_started", "running": "interrupted"}
        entry["state"] = booted.get(entry["state"], entry["state"])
    return stored


ledger = load()
lock = threading.RLock()
lease = {"token": "", "holder": "", "until": 0.0}
now = SimpleNamespace(
    live={"P": 0.5, "I": 10.0, "D": 0.0, "setpoint_filter_s": 0.0},
    trial=None,
    frame=(None, b""),
    ended=0,
    stop="",  # reason why the trial is being stopped
)
work = threading.Condition(lock)


def save():
    """Writes the ledger to the disk atomically."""
    new = FILE.with_suffix(".new")
    with new.open("w") as file:
        json.dump(ledger, file)
        file.flush()
        os.fsync(file.fileno())
    new.replace(FILE)


def mode():
    if now.trial:
        return "aborting" if now.stop else ledger["trials"][now.trial["id"]]["state"]
    return "safe" if ledger["latched"] else "leased" if holds(lease["token"]) else "idle"


def holds(token):
    return bool(token) and token == lease["token"] and time.monotonic() < lease["until"]


def lease_refusal():
    if holds(lease["token"]):
        return answer("held", sentence=f"held by {lease['holder']}")
    return answer("no_lease", sentence="the lease has run out")


def find_entry(trial_id, digest):
    """Reply with the state of a trial in the ledger, or None."""
    entry = ledger["trials"].get(trial_id)
    if entry is None:
        return None
    if entry["digest"] != digest:
        return answer("refused", trial_id, "RigError", f"another trial has the id {trial_id}")
    return answer(entry["state"], trial_id)


def busy():
    return answer("busy", now.trial["id"], sentence=f"busy with trial {now.trial['id']}")


def obstacle(message):
    """The refusal of what needs the lease and no trial, if anything is against it."""
    if ledger["latched"] and now.trial is None:
        return answer("safe", sentence=ledger["latched"])
    if not holds(message["lease"]):
        return lease_refusal()
    return busy() if now.trial else None


def cancel(message):
    if now.trial is None:
        return answer("accepted")
    if not holds(message["lease"]):
        return lease_refusal()
    if message.get("trial_id", "") not in ("", now.trial["id"]):
        return answer("accepted")
    now.stop = now.stop or "stopped by its client"
    work.notify_all()
    return answer("accepted", now.trial["id"])


def void(message):
    if (reply := find_entry(message["trial_id"], message["digest"])) is not None:
        return reply
    if not holds(message["lease"]):
        return lease_refusal()
    ledger["trials"][message["trial_id"]] = {"digest": message["digest"], "state": "void"}
    save()
    return answer("void", message["trial_id"])


def set_gains(message):
    gains = gains_of(message["gains"])
    if (reply := obstacle(message)) is not None:
        return reply
    now.live = gains
    return answer("accepted")


def refuse_switch_off(message):
    tables = message["tables"]
    if not (isinstance(tables, list) and tables and all(isinstance(t, str) for t in tables)):
        raise Refused("ProtocolError", "tables: no names")
    if (reply := obstacle(message)) is not None:
        return reply
    raise Refused("RigError", "this board has no compensations")


def refuse_setpoint(message):
    setpoint = check_fields("setpoint", message["setpoint"])
    finite(message["sent_s"], setpoint["tension_N"], setpoint.get("angle_rad") or 0.0)
    if (reply := obstacle(message)) is not None:
        return reply
    raise Refused("RigError", "this board runs trials only: it follows no setpoints")


def clear(_):
    if now.trial:
        return busy()
    ledger["latched"] = ""
    save()
    return answer("accepted")


def handle_lease(message):
    token, until = message["lease"], time.monotonic() + LEASE_S
    match message["action"]:
        case "acquire" if not holds(lease["token"]) or holds(token):
            holder = message.get("holder", "")[:128]
            lease.update(token=token, holder=holder, until=until)
        case "renew" if holds(token):
            lease["until"] = until
        case "release" if holds(token):
            lease["until"] = 0.0
            now.stop = now.stop or ("its client released the lease" if now.trial else "")
        case "acquire" | "renew" | "release":
            return lease_refusal()
        case _:
            raise Refused("ProtocolError", f"no such action: {message['action']}")
    work.notify_all()
    return answer("accepted")


def submit(message):
    request = check_fields("request", message["request"])
    gains, profile = gains_of(request["gains"]), request["profile"]
    attempt = request.get("attempt", 0)
    trial_id = f"{request['run']}-{request['number']:05d}" + (f".{attempt}" if attempt else "")
    if (reply := find_entry(trial_id, message["digest"])) is not None:
        return reply
    if ledger["latched"] and now.trial is None:
        return answer("safe", sentence=f"safe state: {ledger['latched']}")
    if not holds(message["lease"]):
        return lease_refusal()
    if isinstance(profile, dict) and profile.get("kind") != "step":
        raise Refused("InvalidInput", "this board knows steps only")
    check_fields("step", profile)
    numbers = [profile[n] for n in ("preload_N", "step_N", "step_at_s", "duration_s")]
    numbers.append(profile.get("ramp_s", 0.0))
    finite(*numbers)
    preload, size, at, duration, ramp = numbers
    if not (size and at >= 0.0 and ramp >= 0.0 and at + ramp < duration):
        raise Refused("ProtocolError", "no step profile")
    if not all(0.0 <= tension <= 50.0 for tension in (preload, preload + size)):
        raise Refused("InvalidInput", "a setpoint is outside the rig's range 0 to 50 N")
    if duration > 5.0 or profile.get("loop", "closed") != "closed":
        raise Refused("InvalidInput", "longer than the rig's limit of 5 s, or an open loop")
    if now.trial:
        return busy()
    ledger["trials"][trial_id] = {"digest": message["digest"], "state": "accepted"}
    save()
    now.trial = {"id": trial_id, "gains": gains, "profile": numbers}
    work.notify_all()
    return answer("accepted", trial_id)


COMMANDS = {
    "lease": (handle_lease, {"action", "lease"}, {"holder"}),
    "submit": (submit, {"lease", "request", "digest"}, set()),
    "cancel": (cancel, {"lease"}, {"trial_id"}),
    "void": (void, {"lease", "trial_id", "digest"}, set()),
    "gains": (set_gains, {"lease", "gains"}, set()),
    "switch_off": (refuse_switch_off, {"lease", "tables"}, set()),
    "follow": (refuse_setpoint, {"lease", "sent_s", "setpoint"}, set()),
    "clear": (clear, set(), set()),
}
"""Function of each verb, and the fields that its message must and may have."""

for missing in sys.argv[3:]:
    del COMMANDS[missing]


def question(words, payload):
    match words:
        case ["status"]:
            status = {
                "instance": INSTANCE,
                "mode": mode(),
                "trial_id": now.trial["id"] if now.trial else "",
                "ended": now.ended,
                "holder": lease["holder"] if holds(lease["token"]) else "",
                "latched": ledger["latched"],
            }
            return json.dumps(status).encode()
        case ["describe"]:
            return json.dumps(
                {"rig": description(), "instance": INSTANCE, "ledger": ledger["identity"]}
            ).encode()
        case ["result", trial_id]:
            message = check_fields("result", parse(payload))
            reply = find_entry(trial_id, message["digest"]) or answer("unknown", trial_id)
            if b'"ended"' in reply and now.frame[0] == trial_id:
                return part(now.frame[1], message.get("offset", 0), message.get("length", 0))
            if b'"ended"' in reply:
                raise Refused("RigError", "it has run, its record is gone")
            return reply
    raise AssertionError(words)


def description():
    step = {"kind": "step", "preload_N": 10.0, "step_N": 5.0, "step_at_s": 0.1, "duration_s": 0.5}
    return {
        "name": NAME,
        "gains": now.live,
        "controller": {
            "sampling_Hz": RATE_HZ,
            "derivative_filter_s": 0.01,
            "output_min_N": -50.0,
            "output_max_N": 50.0,
        },
        "newtons_per_ampere": 20.0,
        "limits": {"tension_min_N": 0.0, "tension_max_N": 50.0, "duration_max_s": 5.0},
        "step": step,
        "settling_time_s": 0.2,
        "cable_length_m": 0.8,
        "software": "small board 1",
        "simulated": True,
    }


def serve(key, query):
    """Replies to a query; a command needs a query on exactly its own key."""
    requested_key = str(query.key_expr)
    if key.endswith("/result/*"):
        key = f"{ROOT}/result/{requested_key.rpartition('/')[2]}"
    payload = query.payload.to_bytes() if query.payload is not None else b""
    with query:
        if "*" not in key and (requested_key == key or "/@cmd/" not in key):
            query.reply(key, reply(key, payload), attachment=INSTANCE)


def reply(key, payload):
    try:
        with lock:
            match key.split("/")[3:]:
                case ["@cmd", _, "estop"]:
                    return emergency(payload)
                case ["@cmd", _, verb]:
                    execute, *names = COMMANDS[verb]
                    return execute(check_fields(verb, parse(payload), names))
                case words:
                    return question(words, payload)
    except Refused as refused:
        return answer("refused", "", *refused.args)


def emergency(payload):
    try:
        reason = str(json.loads(payload)["reason"])[:128] or "no reason given"
    except (ValueError, KeyError, TypeError):
        reason = "no reason given"
    ledger["latched"] = ledger["latched"] or reason
    now.stop = now.stop or (f"emergency stop: {reason}" if now.trial else "")
    save()
    work.notify_all()
    return answer("accepted")


def run():
    """Main loop of the board: waits for a trial, runs it, and writes its end to the ledger."""
    while True:
        with lock:
            work.wait_for(lambda: now.trial is not None)
            entry = ledger["trials"][now.trial["id"]]
            if not now.stop:
                entry["state"] = "running"
                save()
            profile, gains = now.trial["profile"], now.trial["gains"]
        columns = follow(gains, profile)
        with lock:
            now.frame = now.trial["id"], record(NAME, now.trial, columns, now.stop)
            entry["state"] = "ended"
            save()
            now.trial, now.stop, now.ended = None, "", now.ended + 1
        session.put(f"{ROOT}/status", question(["status"], b""), attachment=INSTANCE)


def follow(gains, profile):
    """Samples in real time of PIDF and drum, which lags the effort, until the end or a stop."""
    rows, began, h = [], time.monotonic(), 1.0 / RATE_HZ
    preload, size, at, duration, ramp = profile
    tension = integral = filtered = lagged = preload
    lag_s = gains["setpoint_filter_s"]
    pole = math.exp(-h / lag_s) if lag_s else 0.0
    for k in range(round(duration * RATE_HZ)):
        with lock:
            if not now.stop and not holds(lease["token"]):
                now.stop = f"{lease['holder']} has not renewed the lease for 1 s"
            work.wait_for(lambda: now.stop, max(0.0, began + k / RATE_HZ - time.monotonic()))
            if now.stop:
                break
        moved = (k - round(at * RATE_HZ) + 1) / max(1, round(ramp * RATE_HZ))
        setpoint = preload + size * min(max(moved, 0.0), 1.0)
        filtered = pole * filtered + (1.0 - pole) * setpoint
        rate = (tension - lagged) / (0.01 + h)
        lagged += h * rate
        wanted = gains["P"] * (filtered - tension) + integral - gains["D"] * rate
        effort = min(max(wanted, -50.0), 50.0)
        integral += h * gains["I"] * (filtered - tension)
        rows.append((k / RATE_HZ, setpoint, tension, effort / 20.0, 0.1 * tension))
        tension += 0.2 * (effort - tension)
    return rows


with socket.create_server(("127.0.0.1", 0)) as probe:
    endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
config = {
    "mode": "peer",
    "listen": {"endpoints": [endpoint]},
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}
with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
    save()
    commands = (f"{ROOT}/@cmd/{INSTANCE}/{verb}" for verb in (*COMMANDS, "estop"))
    for key in (*commands, *(f"{ROOT}/{name}" for name in ("status", "describe", "result/*"))):
        session.declare_queryable(key, partial(serve, key), complete=True)
    threading.Thread(target=run, daemon=True).start()
    token = session.liveliness().declare_token(f"{ROOT}/alive/{INSTANCE}")
    print(endpoint, flush=True)
    sys.stdin.read()
