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


class Access(TomlTable):
    """Rights: names of users, or common names of certificates."""

    command: list[str] = Field(default_factory=list)
    look: list[str] = Field(default_factory=list)

    def settings(self, names_are: str) -> dict[str, Any]:
        """Zenoh settings of this table, for names of the kind that Zenoh calls so."""
        observers = sorted({*self.look, *self.command})
        subjects = [("look", observers), ("command", sorted(set(self.command)))]
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
            "subjects": [{"id": name, names_are: names} for name, names in subjects if names],
            "policies": [
                {"rules": [f"{name} sends", f"{name} receives"], "subjects": [name]}
                for name, names in subjects
                if names
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

    def settings(self) -> dict[str, Any]:
        """Additional settings of a Zenoh session, by key."""
        settings: dict[str, Any] = {}
        if self.password is not None:
            settings["transport/auth/usrpwd"] = self.password.settings()
        if self.tls is not None:
            settings["transport/link/protocols"] = ["tls", "quic"]
            settings["transport/link/tls"] = self.tls.settings()
        if self.access is not None:
            names_are = "usernames" if self.password is not None else "cert_common_names"
            settings["access_control"] = self.access.settings(names_are)
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
