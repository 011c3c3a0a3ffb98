"""Messages of the rig protocol and of the daemon: keys, commands, replies; no transport.

`commands.VERBS` is the table of all commands. docs/reference/rig-protocol.md describes the
protocol completely, for rigs written in any language.
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
from estune.remote.messages.codec import (
    ANSWER_MAX_BYTES,
    COMMAND_MAX_BYTES,
    HOLDER_MAX,
    decode,
    encode,
)
from estune.remote.messages.commands import VERBS, Inquire, digest
from estune.remote.messages.keys import ANY_RIG, VERSION, Keys, Presence, check_name, choose
from estune.remote.messages.replies import (
    LAST,
    Answer,
    Description,
    Failure,
    Following,
    Status,
    decode_description,
    decode_following,
    refusal,
)

__all__ = [
    "ANSWER_MAX_BYTES",
    "ANY_RIG",
    "COMMAND_MAX_BYTES",
    "HOLDER_MAX",
    "LAST",
    "LIVE_MAX_SAMPLES",
    "VERBS",
    "VERSION",
    "Answer",
    "Description",
    "Failure",
    "Following",
    "Inquire",
    "Keys",
    "Part",
    "Presence",
    "Status",
    "check_name",
    "choose",
    "decode",
    "decode_description",
    "decode_following",
    "decode_live",
    "decode_part",
    "decode_trial",
    "digest",
    "encode",
    "encode_live",
    "encode_part",
    "refusal",
]
