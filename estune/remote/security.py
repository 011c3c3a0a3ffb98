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
    look = ["guest"]

Relative paths start at this file. A file with a secret must be readable by its owner alone. See
docs/how-to/security.md.
"""

import ssl
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from estune.errors import InvalidInput
from estune.support.toml_file import TomlTable, read_toml, validate

_IN, _OUT = ["ingress"], ["egress"]
# Messages that an observer sends and receives; commands have keys of their own.
_QUERIES = ["query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_REPLIES = ["reply", "put", "declare_queryable", "liveliness_token"]
_KEYS, _COMMANDS = ["reel/**"], ["reel/**/@cmd/**"]


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

    @property
    def own_name(self) -> str:
        """Common name of the certificate, as the authority's other end reads it.

        Raises:
            InvalidInput: a file cannot be used, or the authority does not accept the certificate.
        """
        sides = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        for side in sides:
            side.check_hostname, side.verify_mode = False, ssl.CERT_REQUIRED
            self.load_into(side)
        there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
        client = sides[0].wrap_bio(back, there)
        server = sides[1].wrap_bio(there, back, server_side=True)
        try:
            for end in (client, server, client, server):
                with suppress(ssl.SSLWantReadError):
                    end.do_handshake()
        except ssl.SSLError as error:
            raise InvalidInput(
                f"{self.authority} does not accept {self.certificate}, which must serve for both "
                f"sides of a connection: {getattr(error, 'verify_message', error.reason)}"
            ) from error
        return common_name(server.getpeercert() or {})

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
    look: list[str] = Field(default_factory=list)

    def settings(self, names_are: str, own_name: str = "") -> dict[str, Any]:
        """Zenoh settings of this table.

        Args:
            names_are: The kind of names, as Zenoh calls it.
            own_name: Common name of a listener behind a TLS front, which has compared the
                clients' names itself and passes on those with all rights by a socket of their
                own, the others as itself. Names then are those of routers.
        """
        observers, commanders = {*self.look, *self.command}, {*self.command}
        subjects: list[tuple[str, str, set[str]]] = [
            ("look", names_are, observers - {own_name}),
            ("command", names_are, commanders - {own_name}),
        ]
        if own_name:
            subjects += [
                ("look", "cert_common_names", {own_name}),
                ("look", "link_protocols", {"unixsock-stream"}),
                ("command", "link_protocols", {"unixsock-stream"}),
            ]
        named = [(i, *subject) for i, subject in enumerate(subjects) if subject[2]]
        rules = [
            ("look sends", _IN, _QUERIES, _KEYS),
            ("look receives", _OUT, _REPLIES, _KEYS),
            ("command sends", _IN, ["query"], _COMMANDS),
            ("command receives", _OUT, ["reply", "declare_queryable"], _COMMANDS),
        ]
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {"id": name, "permission": "allow", "flows": f, "messages": m, "key_exprs": k}
                for name, f, m, k in rules
            ],
            "subjects": [{"id": f"{i}", kind: sorted(names)} for i, _, kind, names in named],
            "policies": [
                {"rules": [f"{right} sends", f"{right} receives"], "subjects": [f"{i}"]}
                for i, right, _, _ in named
            ],
        }


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
    def observers(self) -> frozenset[str]:
        """Names of certificates whose clients may look and not command."""
        if self.access is None or self.password is not None:
            return frozenset()
        return frozenset(self.access.look) - frozenset(self.access.command)

    def lets_command(self, name: str) -> bool:
        """Whether a client is let through with all rights, by the name of its certificate.

        With passwords, the session tells clients apart.
        """
        if self.access is None or self.password is not None:
            return True
        return name in self.access.command

    def settings(self, *, behind_front: bool = False) -> dict[str, Any]:
        """Additional settings of a Zenoh session, by key; of one behind a TLS front if asked."""
        settings: dict[str, Any] = {}
        if self.password is not None:
            settings["transport/auth/usrpwd"] = self.password.settings()
        if self.tls is not None:
            front = ["unixsock-stream"] if behind_front else []
            settings["transport/link/protocols"] = ["tls", "quic", *front]
            settings["transport/link/tls"] = self.tls.settings()
        if self.access is not None:
            by_password = self.password is not None
            own = self.tls.own_name if self.tls and behind_front and not by_password else ""
            names_are = "usernames" if by_password else "cert_common_names"
            settings["access_control"] = self.access.settings(names_are, own)
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
