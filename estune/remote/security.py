"""Who may speak to a rig and command it: passwords, certificates, access; from a TOML file.

::

    [password]  # who this process is
    user = "anna"
    password_file = "anna.password"
    users_file = "users"  # where it listens: who else there is, a line of user:password

    [tls]  # certificates, for endpoints of tls/ and quic/
    authority = "ca.pem"  # who signed all of them
    certificate = "anna.pem"
    key = "anna.key"

    [access]  # where it listens: who may do what; nobody else anything
    command = ["anna"]
    look = ["guest"]

Files are beside this one unless their path says otherwise. What holds a secret must be readable by
its owner alone. See docs/security.md.
"""

from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from estune.errors import InvalidInput
from estune.support.toml_file import TomlTable, read_toml, validate

_IN, _OUT = ["ingress"], ["egress"]
# What a client sends who looks on, what it is sent back, and what is said of commands.
_ASKS = ["query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_TOLD = ["reply", "put", "declare_queryable", "liveliness_token"]
_KEYS, _COMMANDS = ["reel/**"], ["reel/**/@cmd/**"]


class Password(TomlTable):
    """Who this process is, and who else there is."""

    user: str | None = None
    password_file: str | None = None
    users_file: str | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file: give both or neither")
        if self.user is None and self.users_file is None:
            raise ValueError("give user and password_file to connect, or users_file to listen")
        return self


class Tls(TomlTable):
    """The certificates, as PEM files."""

    authority: str
    certificate: str
    key: str


class Access(TomlTable):
    """Who may do what: names of users, or common names of certificates."""

    command: list[str] = Field(default_factory=list)
    look: list[str] = Field(default_factory=list)


class Security(TomlTable):
    """How a process shows who it is, and whom it lets do what. Made by `read_security`."""

    password: Password | None = None
    tls: Tls | None = None
    access: Access | None = None

    @model_validator(mode="after")
    def _names(self) -> Self:
        if self.access is not None and self.password is None and self.tls is None:
            raise ValueError("access: without password or tls nobody has a name; give one of them")
        return self

    def check_endpoint(self, endpoint: str) -> None:
        """Refuses an endpoint that does not go with it.

        Raises:
            InvalidInput: certificates were given, but the endpoint would not use them.
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
        """What is to be added to the settings of a Zenoh session, by dotted key."""
        found: dict[str, Any] = {}
        if self.password is not None:
            found["transport/auth/usrpwd"] = self._password(self.password)
        if self.tls is not None:
            tls = self.tls
            found["transport/link/protocols"] = ["tls", "quic"]
            found["transport/link/tls"] = {
                "root_ca_certificate": tls.authority,
                "enable_mtls": True,
                "verify_name_on_connect": True,
                **{f"{side}_certificate": tls.certificate for side in ("listen", "connect")},
                **{f"{side}_private_key": tls.key for side in ("listen", "connect")},
            }
        if self.access is not None:
            found["access_control"] = self._access(self.access)
        return found

    @staticmethod
    def _password(password: Password) -> dict[str, str]:
        found = {}
        if password.user is not None and password.password_file is not None:
            text = Path(password.password_file).read_text("utf-8").strip()
            found = {"user": password.user, "password": text}
        if password.users_file is not None:
            found["dictionary_file"] = password.users_file
        return found

    def _access(self, access: Access) -> dict[str, Any]:
        kind = "usernames" if self.password is not None else "cert_common_names"
        lookers = sorted({*access.look, *access.command})
        subjects = [("look", lookers), ("command", sorted(set(access.command)))]
        rules = [
            ("look asks", _IN, _ASKS, _KEYS),
            ("look told", _OUT, _TOLD, _KEYS),
            ("command asks", _IN, ["query"], _COMMANDS),
            ("command told", _OUT, ["reply", "declare_queryable"], _COMMANDS),
        ]
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {"id": name, "permission": "allow", "flows": f, "messages": m, "key_exprs": k}
                for name, f, m, k in rules
            ],
            "subjects": [{"id": name, kind: names} for name, names in subjects if names],
            "policies": [
                {"rules": [f"{name} asks", f"{name} told"], "subjects": [name]}
                for name, names in subjects
                if names
            ],
        }


OPEN = Security()
"""Nobody is asked who they are: for endpoints that only this machine reaches."""


def read_security(path: Path) -> Security:
    """The settings in a file.

    Raises:
        InvalidInput: something in it is wrong, or a file it names is missing or open to others;
            all of it is in the message, a line each.
    """
    data = read_toml(path)
    faults = list(_resolve(data, path))
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
"""Where files are named, and whether they hold a secret."""


def _resolve(data: dict[str, Any], path: Path) -> list[str]:
    """Makes the files' names absolute; what is wrong with the files."""
    faults = []
    for (table, key), secret in _FILES.items():
        tables = data.get(table)
        name = tables.get(key) if isinstance(tables, dict) else None
        if not isinstance(tables, dict) or not isinstance(name, str):
            continue  # said when the tables are checked
        file = path.parent / name
        tables[key] = str(file.resolve())
        if not file.is_file():
            faults.append(f"{table}.{key}: there is no file {file}")
        elif secret and file.stat().st_mode & 0o077:
            faults.append(f"{table}.{key}: others can read {file}; say: chmod 600 {file}")
    return faults
