"""What is said over the link: keys, commands, answers. No transport is in here.

::

    reel/v1/<rig>/alive/<instance>           liveliness; the instance is new at each boot
    reel/v1/<rig>/@cmd/<instance>/lease      the right to command: acquire, renew, release
    reel/v1/<rig>/@cmd/<instance>/submit     a trial request in, the state of that trial out
    reel/v1/<rig>/@cmd/<instance>/cancel     stop the trial under way
    reel/v1/<rig>/@cmd/<instance>/void       never run a trial that was not taken in yet
    reel/v1/<rig>/@cmd/<instance>/gains      make gains the live ones
    reel/v1/<rig>/@cmd/<instance>/estop      to the safe state, and stay there; needs no lease
    reel/v1/<rig>/@cmd/<instance>/clear      the emergency stop is over; needs no lease
    reel/v1/<rig>/result/<trial id>          the state of a trial; its record once it has ended
    reel/v1/<rig>/status                     what the rig does now; also published at each change
    reel/v1/<rig>/describe                   what the rig is
    reel/v1/<rig>/telemetry/<trial id>       published: samples of the trial under way

A chunk that begins with `@` is matched by no wildcard: no `reel/**` ever reaches a command. A
command names the instance: none ever reaches a rig restarted meanwhile. Every command may be
repeated until it is answered: a trial is known by its id and the digest of its request, and never
runs twice. An empty reply says nothing; in particular it does not say "did not run".

`docs/rig-protocol.md` says all of it to whoever writes a rig in another language.
"""

from estune.remote.messages.binary import (
    LIVE_MAX_SAMPLES,
    Part,
    decode_live,
    decode_part,
    decode_trial,
    encode_live,
    encode_part,
)
from estune.remote.messages.keys import ANY_RIG, VERSION, Keys, Presence, check_name, choose
from estune.remote.messages.messages import (
    ANSWER_MAX_BYTES,
    COMMAND_MAX_BYTES,
    HOLDER_MAX,
    Answer,
    Cancel,
    Clear,
    Description,
    Estop,
    Inquire,
    Lease,
    SetGains,
    Status,
    Submit,
    Void,
    decode,
    decode_description,
    digest,
    encode,
    refusal,
)

__all__ = [
    "ANSWER_MAX_BYTES",
    "ANY_RIG",
    "COMMAND_MAX_BYTES",
    "HOLDER_MAX",
    "LIVE_MAX_SAMPLES",
    "VERSION",
    "Answer",
    "Cancel",
    "Clear",
    "Description",
    "Estop",
    "Inquire",
    "Keys",
    "Lease",
    "Part",
    "Presence",
    "SetGains",
    "Status",
    "Submit",
    "Void",
    "check_name",
    "choose",
    "decode",
    "decode_description",
    "decode_live",
    "decode_part",
    "decode_trial",
    "digest",
    "encode",
    "encode_live",
    "encode_part",
    "refusal",
]
