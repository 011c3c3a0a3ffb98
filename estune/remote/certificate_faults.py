"""What is wrong with a certificate, in a sentence for each fault; Zenoh gives none."""

import ssl
from contextlib import suppress

from estune.remote.security import Tls

_EXPIRED = "has expired; make a new one"
_NOT_YET = "is not valid yet; check the clocks of both machines"
_ISSUER = "is signed by an authority that is not known here; use certificates of one authority"
_ROLE = "is made for the other side of a connection; make it anew with its extension file"

_OF_CODE = {10: _EXPIRED, 9: _NOT_YET, 26: _ROLE, **dict.fromkeys((2, 18, 19, 20, 21), _ISSUER)}
"""Sentences by OpenSSL's codes of verification (`man openssl-verification-options`)."""

_NAME_CODES = (62, 64)

_OF_ALERT = {
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": _EXPIRED,
    "TLSV1_ALERT_UNKNOWN_CA": _ISSUER,
    "SSLV3_ALERT_UNSUPPORTED_CERTIFICATE": _ROLE,
    "SSLV3_ALERT_BAD_CERTIFICATE": "is not valid yet, or is for another address",
}
"""Sentences by the objections of the other side."""


def fault_found(error: ssl.SSLError) -> str:
    """What this side finds wrong with the other's certificate; empty if it is something else."""
    if not isinstance(error, ssl.SSLCertVerificationError):
        return ""
    if error.verify_code in _NAME_CODES:
        return f"is for another address ({error.verify_message}); connect to the one it names"
    return _OF_CODE.get(error.verify_code, f"is not accepted: {error.verify_message}")


def fault_told(error: ssl.SSLError) -> str:
    """What the other side says is wrong with this one's; empty if it is something else."""
    return _OF_ALERT.get(error.reason or "", "")


def own_fault(tls: Tls, *, listens: bool) -> str:
    """What is wrong with the own certificate for a side of connections, by the own authority.

    It is tried in a handshake with itself, of which the other side alone verifies.

    Raises:
        InvalidInput: a file cannot be used.
    """
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for context in (client, server):
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        tls.load_into(context)
    (client if listens else server).verify_mode = ssl.CERT_REQUIRED
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    near, far = client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)
    try:
        for end in (near, far, near, far):
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLError as error:
        return fault_found(error) or f"cannot be used: {error.reason or error}"
    return ""
