"""Rigs with users and certificates."""

import subprocess
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from estune.remote import zenoh
from estune.remote.messages import VERBS
from estune.remote.messages.rights import Right
from estune.remote.security import read_security
from estune.web.board import Board
from estune.web.rig_reader import RigReader
from tests.support_rigs import ScriptedRig, description

ACCESS = '[access]\ncommand = ["anna"]\nstop = ["ben"]\nlook = ["guest"]\n'
HOLDERS = {"anna": Right.COMMAND, "ben": Right.STOP, "guest": Right.LOOK}


def secret(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o600)


def security(path: Path, text: str):
    path.write_text(text)
    return read_security(path)


@contextmanager
def served(endpoint: str, **options):
    limited = replace(description().controller, output_max_N=100.0)
    rig = ScriptedRig(duration_s=0.02, controller=limited)
    with zenoh.serve(rig, endpoint, **options) as server:
        yield rig, server


def openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(folder: Path, name: str) -> None:
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-subj", f"/CN={name}", "-days", 1),
        *("-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem"),
    )


_USUAL = "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n"
EXTENSIONS = {
    "old": "",
    "bare": "basicConstraints=CA:FALSE\n",
    "server": f"{_USUAL}extendedKeyUsage=serverAuth\n",
    "client": f"{_USUAL}extendedKeyUsage=clientAuth\n",
}
DATES = {"expired": ("20200101000000Z", "20210101000000Z"), "early": ("20900101000000Z",) * 2}
AUTHORITY = """\
[ca]
default_ca = it
[it]
database = index
new_certs_dir = .
default_md = sha256
rand_serial = yes
policy = any
[any]
commonName = supplied
"""


def certificate(folder: Path, name: str, signer: str) -> None:
    """A key and a certificate of that name, for the loopback address unless it is bare."""
    request, extension = folder / f"{name}.csr", folder / f"{name}.ext"
    extension.write_text(EXTENSIONS.get(name, _USUAL))
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-subj", f"/CN={name}", "-keyout", folder / f"{name}.key", "-out", request),
    )
    openssl(
        *("x509", "-req", "-in", request, "-days", 1, "-extfile", extension),
        *("-CA", folder / f"{signer}.pem", "-CAkey", folder / f"{signer}.key", "-CAcreateserial"),
        *("-out", folder / f"{name}.pem"),
    )
    (folder / f"{name}.key").chmod(0o600)
    if name in DATES:
        (folder / "index").write_text("")
        (folder / "ca.cnf").write_text(AUTHORITY)
        begin, end = DATES[name]
        words = ("ca", "-batch", "-notext", "-config", "ca.cnf", "-startdate", begin)
        words += ("-enddate", end, "-extfile", f"{name}.ext", "-in", f"{name}.csr")
        words += ("-cert", f"{signer}.pem", "-keyfile", f"{signer}.key", "-out", f"{name}.pem")
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


def certified(folder: Path):
    """Settings with certificates; the forger's is signed by another authority."""
    for name in ("ca", "other"):
        authority(folder, name)
    found = {}
    for name in ("rig", *HOLDERS, "forger", *EXTENSIONS, *DATES):
        signer = "other" if name == "forger" else "ca"
        certificate(folder, name, signer)
        text = (
            f'[tls]\nauthority = "{signer}.pem"\ncertificate = "{name}.pem"\nkey = "{name}.key"\n'
        )
        found[name] = security(folder / f"{name}.toml", text + ACCESS * (name == "rig"))
    mixed = '[tls]\nauthority = "ca.pem"\ncertificate = "anna.pem"\nkey = "guest.key"\n'
    found["mixed"] = security(folder / "mixed.toml", mixed)
    return found


def check_verbs(known, scheme: str, who: str) -> None:
    """A client sends the verbs of the table that its right includes, and no others."""
    right = HOLDERS[who]
    with (
        served(f"{scheme}/127.0.0.1:0", security=known["rig"]) as (_, server),
        zenoh.connect(server.endpoint, security=known[who]) as client,
    ):
        link = client._connection
        keys = {verb: link.keys.command(link.instance, verb) for verb in VERBS}
        answered = {verb for verb, key in keys.items() if link.ask(key, b"{}")}
        assert answered == {name for name, verb in VERBS.items() if right.includes(verb.right)}
        assert client.right is right
        reader = RigReader(Board(), lambda: client)
        reader.read()
        assert reader.board.get("right") == right
        reader.release()
