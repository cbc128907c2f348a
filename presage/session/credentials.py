"""Certificates and passwords for secure mode.

DIR/authority/      ca.key, ca.crt: makes members; belongs on no robot
DIR/NAME/           certificate, key and password of one member, with its role
DIR/router/         the same, and the list of those it lets in with their passwords
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.bus.security import (
    AUTHORITY,
    CERTIFICATE,
    EVERY_ROBOT,
    IDENTITY,
    KEY,
    MEMBERS,
    NAME,
    PASSWORD,
    PASSWORDS,
    ROLES,
    ROUTER,
    Member,
    Members,
    read_members,
)
from common.errors import UserError

AUTHORITY_FOLDER, AUTHORITY_KEY = "authority", "ca.key"
# Stand in for a robot, one with all its rights: made where asked for.
ON_REQUEST = frozenset({"replay", "remote", "bridge_ros2"})
PER_ROBOT = ("simulator", "estimator", "controller")
HOSTS = ("localhost", "127.0.0.1", "router")  # a router's, for programs that look at names; ours look at roles
Key = ec.EllipticCurvePrivateKey


@dataclass(frozen=True)
class Authority:
    """Who signs."""

    key: Key
    certificate: x509.Certificate


def init(
    folder: Path, hosts: Sequence[str] = (), robots: Sequence[str] = (), days: int = 365, *, force: bool = False
) -> list[Member]:
    """A new authority and a member of every role; with ``robots`` one of each robot's own services for each.

    Raises UserError where the folder holds something already, unless ``force``: then nothing old is let in any more.
    """
    for robot in robots:
        check_robot(robot)
    if folder.exists() and any(folder.iterdir()):
        if not (folder / AUTHORITY_FOLDER).is_dir():
            raise UserError(f"{folder}: not empty, and nothing that `presage secure` made: choose another folder")
        if not force:
            raise UserError(
                f"{folder}: has an authority already; --force makes a new one, which lets in nobody of the old, "
                "`presage secure add` one more member"
            )
        for old in (path.parent for path in folder.glob(f"*/{AUTHORITY}")):
            shutil.rmtree(old)
    members = [
        Member(name=role, role=role) for role in ROLES if role not in ON_REQUEST | set(PER_ROBOT if robots else ())
    ]
    members += [Member(name=f"{role}-{r}", role=role, robots=(r,)) for r in robots for role in PER_ROBOT]
    authority = _new_authority(folder, days)
    for member in members:
        _write_member(folder, authority, member, days, hosts)
    _write_list(folder, members)
    return members


def add(
    folder: Path, role: str, name: str, robots: Sequence[str] = (), days: int = 365, *, hosts: Sequence[str] = (),
    force: bool = False,
) -> Member:  # fmt: skip
    """One more member; with ``force`` new credentials for one there is. Raises UserError where that cannot be."""
    if role not in ROLES:
        raise UserError(f"no role {role!r}: choose one of {', '.join(ROLES)}")
    if re.fullmatch(NAME, name) is None or name == AUTHORITY_FOLDER:
        raise UserError(f"name {name!r}: lower-case letters, digits, - and _, and not {AUTHORITY_FOLDER!r}")
    if (role == ROUTER) != (name == ROUTER):
        raise UserError(f"routers share one name: copy {folder / ROUTER} to where the other runs")
    for robot in robots:
        check_robot(robot)
    authority, members = _authority(folder), list(read_members(folder / ROUTER))
    if not force and any(each.name == name for each in members):
        raise UserError(f"{folder / name}: is there already; --force gives it new credentials")
    member = Member(name=name, role=role, robots=tuple(robots) or EVERY_ROBOT)
    _write_member(folder, authority, member, days, hosts)
    _write_list(folder, [*(each for each in members if each.name != name), member])
    return member


def remove(folder: Path, name: str) -> None:
    """Strike a member from the router's list; raises UserError where it is not on it."""
    members = read_members(folder / ROUTER) if _authority(folder) else ()
    if name == ROUTER:
        raise UserError(f"without {ROUTER!r} nobody is let in; `presage secure init --force` begins anew")
    if all(each.name != name for each in members):
        raise UserError(f"no member {name!r}: there are {', '.join(each.name for each in members)}")
    _write_list(folder, [each for each in members if each.name != name])
    shutil.rmtree(folder / name, ignore_errors=True)


def expiry(path: Path) -> dt.datetime:
    """When a certificate ends, UTC; raises UserError where it is none."""
    return _certificate(path).not_valid_after_utc


def check_robot(name: str) -> None:
    """Raises UserError where it is no single chunk of a key."""
    if re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,40}", name) is None:
        raise UserError(f"robot {name!r}: lower-case letters, digits, - and _ (it becomes part of names and keys)")


def _new_authority(folder: Path, days: int) -> Authority:
    key, subject = ec.generate_private_key(ec.SECP256R1()), _subject("presage authority")
    certificate = (
        _builder(subject, subject, key, max(3650, 2 * days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_SIGNS, critical=True)
        .sign(key, hashes.SHA256())
    )
    _make_folder(folder / AUTHORITY_FOLDER)
    _write(folder / AUTHORITY_FOLDER / AUTHORITY_KEY, _pem(key))
    _write(folder / AUTHORITY_FOLDER / AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return Authority(key, certificate)


_SIGNS = x509.KeyUsage(
    digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
    key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
)  # fmt: skip


def _authority(folder: Path) -> Authority:
    path = folder / AUTHORITY_FOLDER / AUTHORITY_KEY
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except FileNotFoundError:
        raise UserError(f"{path}: not there; `presage secure init {folder}` makes an authority") from None
    except ValueError:
        raise UserError(f"{path}: no private key in PEM") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UserError(f"{path}: not a key that `presage secure init` made")
    return Authority(key, _certificate(folder / AUTHORITY_FOLDER / AUTHORITY))


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError:
        raise UserError(f"{path}: no certificate in PEM") from None


def _write_member(folder: Path, authority: Authority, member: Member, days: int, hosts: Sequence[str]) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    names = [_host(host) for host in (hosts or HOSTS)] if member.role == ROUTER else [x509.DNSName(member.name)]
    certificate = (
        _builder(_subject(member.name), authority.certificate.subject, key, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
        .sign(authority.key, hashes.SHA256())
    )
    home = folder / member.name
    _make_folder(home)
    _write(home / KEY, _pem(key))
    _write(home / PASSWORD, f"{secrets.token_urlsafe(32)}\n".encode())
    _write(home / CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    _write(home / AUTHORITY, (folder / AUTHORITY_FOLDER / AUTHORITY).read_bytes(), 0o644)
    _write(home / IDENTITY, member.model_dump_json(indent=1).encode(), 0o644)


def _write_list(folder: Path, members: Sequence[Member]) -> None:
    """The router's: whom it lets in, and their passwords."""
    words = {member.name: (folder / member.name / PASSWORD).read_text(encoding="utf-8").strip() for member in members}
    lines = "".join(f"{name}:{word}\n" for name, word in words.items())
    _write(folder / ROUTER / PASSWORDS, lines.encode())
    _write(folder / ROUTER / MEMBERS, Members(members=tuple(members)).model_dump_json(indent=1).encode(), 0o644)


def _builder(subject: x509.Name, issuer: x509.Name, key: Key, days: int) -> x509.CertificateBuilder:
    now = dt.datetime.now(dt.timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(hours=1))  # clocks of hosts differ
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _pem(key: Key) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _make_folder(path: Path) -> None:
    path.mkdir(parents=True, exist_ok=True)


def _write(path: Path, data: bytes, mode: int = 0o600) -> None:
    """With its mode from the first byte on, in place of what was there."""
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
    new.chmod(mode)
    new.replace(path)
