"""Authentication and access control of a rig: passwords, certificates; from a TOML file.

::

    [password]  # identity of this process
    user = "anna"
    password_file = "anna.password"
    users_file = "users"  # of a listener: all users, a line of user:password each

    [tls]  # certificates, for endpoints of tls/ and quic/
    authority = "ca.pem"  # signer of all certificates
    certificate = "anna.pem"
    key = "anna.key"

    [access]  # of a listener: the rights of each user; others have none
    command = ["anna"]
    stop = ["ben"]
    look = ["guest"]

Relative paths start at this file. A file with a secret must be readable by its owner alone. See
docs/how-to/security.md.
"""

import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from estune.errors import InvalidInput
from estune.remote.messages.commands import VERBS
from estune.remote.messages.rights import Right
from estune.support.toml_file import TomlTable, read_toml, validate

_IN, _OUT = ["ingress"], ["egress"]
# Messages that an observer sends and receives; commands have keys of their own.
_QUERIES = ["query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_REPLIES = ["reply", "put", "declare_queryable", "liveliness_token"]
_KEYS = ["reel/**"]


class Password(TomlTable):
    """Identity of this process, and the users of a listener."""

    user: str | None = None
    password_file: str | None = None
    users_file: str | None = None

    @model_validator(mode="after")
    def _check_complete(self) -> Self:
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file: give both or neither")
        if self.user is None and self.users_file is None:
            raise ValueError("give user and password_file to connect, or users_file to listen")
        return self

    def settings(self) -> dict[str, str]:
        """Zenoh settings of this table."""
        settings = {}
        if self.user is not None and self.password_file is not None:
            password = Path(self.password_file).read_text("utf-8").strip()
            settings = {"user": self.user, "password": password}
        if self.users_file is not None:
            settings["dictionary_file"] = self.users_file
        return settings


class Tls(TomlTable):
    """Certificates, as PEM files."""

    authority: str
    certificate: str
    key: str

    def settings(self) -> dict[str, Any]:
        """Zenoh settings of this table."""
        return {
            "root_ca_certificate": self.authority,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            **{f"{side}_certificate": self.certificate for side in ("listen", "connect")},
            **{f"{side}_private_key": self.key for side in ("listen", "connect")},
        }

    def load_into(self, context: ssl.SSLContext) -> None:
        """Makes a context identify itself by the certificate and trust the authority.

        Raises:
            InvalidInput: a file cannot be used, or the certificate is of an old version.
        """
        try:
            context.load_verify_locations(self.authority)
            context.load_cert_chain(self.certificate, self.key)
        except ssl.SSLError as error:
            raise InvalidInput(
                f"{self.certificate} and {self.key}, or {self.authority}: {error.reason or error}"
            ) from error
        text = Path(self.certificate).read_text("utf-8")
        if not has_version_3(ssl.PEM_cert_to_DER_cert(text[text.index("-----BEGIN") :])):
            raise InvalidInput(
                f"{self.certificate} is a certificate of version 1; make it anew, with an "
                "extension file (estune docs security)"
            )


def common_name(certificate: Mapping[str, Any]) -> str:
    """The first common name of a certificate, as `SSLSocket.getpeercert` gives it; or empty."""
    fields = (field for group in certificate.get("subject", ()) for field in group)
    return next((str(value) for name, value in fields if name == "commonName"), "")


def has_version_3(der: bytes) -> bool:
    """Whether an X.509 certificate in DER says that its version is above 1.

    Its first part, a sequence in a sequence, then begins with an element of tag 0 (RFC 5280,
    section 4.1); without one the version is 1.
    """
    for _ in range(2):
        long_form = der[1] & 0x80
        der = der[2 + (der[1] & 0x7F if long_form else 0) :]
    return der[0] == 0xA0


class Access(TomlTable):
    """Rights: names of users, or common names of certificates."""

    command: list[str] = Field(default_factory=list)
    stop: list[str] = Field(default_factory=list)
    look: list[str] = Field(default_factory=list)

    def right_of(self, name: str) -> Right | None:
        """The greatest right of a name; None if it has none."""
        return next((right for right in reversed(Right) if name in getattr(self, right)), None)

    def settings(self, names_are: str, of_front: Right | None = None) -> dict[str, Any]:
        """Zenoh settings of this table.

        Args:
            names_are: The kind of names, as Zenoh calls it.
            of_front: The right of whatever comes by a socket of Unix: a TLS front has compared
                the clients' names.
        """
        subjects = [(right, names_are, sorted(getattr(self, right))) for right in Right]
        if of_front is not None:
            subjects.append((of_front, "link_protocols", ["unixsock-stream"]))
        named = [(f"{i}", *subject) for i, subject in enumerate(subjects) if subject[2]]
        rules = [("look sends", _IN, _QUERIES, _KEYS), ("look receives", _OUT, _REPLIES, _KEYS)]
        for right in Right:
            if keys := _command_keys(right):
                rules.append((f"{right} sends", _IN, ["query"], keys))
                rules.append((f"{right} receives", _OUT, ["reply", "declare_queryable"], keys))
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {"id": name, "permission": "allow", "flows": f, "messages": m, "key_exprs": k}
                for name, f, m, k in rules
            ],
            "subjects": [{"id": id_, kind: names} for id_, _, kind, names in named],
            "policies": [
                {
                    "rules": [
                        name for name, *_ in rules if right.includes(Right(name.partition(" ")[0]))
                    ],
                    "subjects": [id_],
                }
                for id_, right, _, _ in named
            ],
        }


def _command_keys(right: Right) -> list[str]:
    """The keys of the commands that need a right. Of all a daemon's, that is the greatest."""
    if right is Right.COMMAND:
        return ["reel/**/@cmd/**"]
    return [f"reel/*/*/@cmd/*/{name}" for name, verb in VERBS.items() if verb.right is right]


class Security(TomlTable):
    """Identity of a process, and the rights of its users. Made by `read_security`."""

    password: Password | None = None
    tls: Tls | None = None
    access: Access | None = None

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        if self.access is not None and self.password is None and self.tls is None:
            raise ValueError("access: without password or tls no client has a name; add one")
        return self

    def check_endpoint(self, endpoint: str) -> None:
        """Refuses an endpoint whose encryption does not match these settings.

        Raises:
            InvalidInput: only one of them, endpoint or settings, is for certificates.
        """
        encrypted = endpoint.startswith(("tls/", "quic/"))
        if self.tls is not None and not encrypted:
            raise InvalidInput(
                f"endpoint {endpoint} would not use the certificates; write it as "
                f"tls/{endpoint.partition('/')[2]}"
            )
        if self.tls is None and encrypted:
            raise InvalidInput(f"endpoint {endpoint} needs certificates: add [tls] to --security")

    @property
    def rights(self) -> tuple[Right, ...]:
        """The rights by which a TLS front tells clients apart; with passwords it does not."""
        if self.access is None or self.password is not None:
            return (Right.COMMAND,)
        names = self.access
        return tuple(r for r in Right if r is Right.COMMAND or getattr(names, r))

    def right_of(self, name: str) -> Right | None:
        """The right with which a front passes on a client, by the name of its certificate."""
        if self.access is None or self.password is not None:
            return Right.COMMAND
        return self.access.right_of(name)

    def settings(self, of_front: Right | None = None) -> dict[str, Any]:
        """Additional settings of a Zenoh session, by key.

        Args:
            of_front: The right of the clients that a TLS front passes on to it, if one does.
        """
        settings: dict[str, Any] = {}
        if self.password is not None:
            settings["transport/auth/usrpwd"] = self.password.settings()
        if self.tls is not None:
            front = ["unixsock-stream"] if of_front else []
            settings["transport/link/protocols"] = ["tls", "quic", *front]
            settings["transport/link/tls"] = self.tls.settings()
        if self.access is not None:
            by_password = self.password is not None
            names_are = "usernames" if by_password else "cert_common_names"
            given = None if by_password else of_front
            settings["access_control"] = self.access.settings(names_are, given)
        return settings


OPEN = Security()
"""No authentication: for endpoints on the loopback address."""


def read_security(path: Path) -> Security:
    """The settings in a file.

    Raises:
        InvalidInput: a setting is wrong, or a file it names is missing or readable by others; the
            message has a line for each fault.
    """
    data = read_toml(path)
    faults = _resolve(data, path)
    if faults:
        raise InvalidInput("\n".join(f"{path}: {fault}" for fault in faults))
    return validate(Security, data, str(path))


_FILES = {
    ("password", "password_file"): True,
    ("password", "users_file"): True,
    ("tls", "key"): True,
    ("tls", "authority"): False,
    ("tls", "certificate"): False,
}
"""Keys that name a file, and whether it holds a secret."""


def _resolve(data: dict[str, Any], path: Path) -> list[str]:
    """Makes the files' names absolute; returns their faults."""
    faults = []
    for (table, key), secret in _FILES.items():
        tables = data.get(table)
        name = tables.get(key) if isinstance(tables, dict) else None
        if not isinstance(tables, dict) or not isinstance(name, str):
            continue  # reported when the tables are validated
        file = path.parent / name
        tables[key] = str(file.resolve())
        if not file.is_file():
            faults.append(f"{table}.{key}: there is no file {file}")
        elif secret and file.stat().st_mode & 0o077:
            faults.append(f"{table}.{key}: others can read {file}; run: chmod 600 {file}")
    return faults
