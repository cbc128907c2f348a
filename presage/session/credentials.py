"""Certificates and passwords for secure mode.

DIR/authority/      ca.key and ca.crt, which sign the members' certificates; must not be copied to a robot
DIR/NAME/           certificate, key, password and role of one member
DIR/router/         the same for the router, and the list of the members with access and their passwords
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
# Roles that act in place of a robot and therefore have many rights: made only with `add`.
ROLES_ON_REQUEST = frozenset({"replay", "remote", "bridge_ros2"})
ROLES_PER_ROBOT = ("simulator", "estimator", "mapper", "controller")
# Host names in the router's certificate. Presage verifies roles instead of names; other programs may verify names.
DEFAULT_ROUTER_HOSTS = ("localhost", "127.0.0.1", "router")
Key = ec.EllipticCurvePrivateKey


@dataclass(frozen=True)
class Authority:
    """The certificate authority that signs the members' certificates."""

    key: Key
    certificate: x509.Certificate


def init(
    folder: Path, hosts: Sequence[str] = (), robots: Sequence[str] = (), days: int = 365, *, force: bool = False
) -> list[Member]:
    """Creates an authority and a member for every role; returns the members.

    With ``robots``, the services of each robot become members of their own. Raises UserError if the folder is not
    empty. With ``force``, an existing authority is replaced, and its certificates become invalid.
    """
    for robot in robots:
        check_robot(robot)
    if folder.exists() and any(folder.iterdir()):
        if not (folder / AUTHORITY_FOLDER).is_dir():
            raise UserError(f"{folder}: not empty, and not made by `presage secure`: choose another folder")
        if not force:
            raise UserError(
                f"{folder}: has an authority already; use `presage secure add` to add a member, or --force to make a "
                "new authority, which invalidates all existing certificates"
            )
        for old in (path.parent for path in folder.glob(f"*/{AUTHORITY}")):
            shutil.rmtree(old)
    omitted = ROLES_ON_REQUEST | set(ROLES_PER_ROBOT if robots else ())
    members = [Member(name=role, role=role) for role in ROLES if role not in omitted]
    members += [Member(name=f"{role}-{r}", role=role, robots=(r,)) for r in robots for role in ROLES_PER_ROBOT]
    authority = _new_authority(folder, days)
    for member in members:
        _write_member(folder, authority, member, days, hosts)
    _write_list(folder, members)
    return members


def add(
    folder: Path,
    role: str,
    name: str,
    robots: Sequence[str] = (),
    days: int = 365,
    *,
    hosts: Sequence[str] = (),
    force: bool = False,
) -> Member:
    """Adds a member and returns it.

    With ``force``, an existing member gets a new certificate, key and password. It keeps its robots, and a router its
    hosts, unless others are given. Raises UserError if the role is unknown, a name is not allowed, or the member exists
    with another role, or without ``force``.
    """
    if role not in ROLES:
        raise UserError(f"no role {role!r}: choose one of {', '.join(ROLES)}")
    if re.fullmatch(NAME, name) is None or name == AUTHORITY_FOLDER:
        raise UserError(
            f"name {name!r}: only lower-case letters, digits, - and _ are allowed, and not {AUTHORITY_FOLDER!r}"
        )
    if (role == ROUTER) != (name == ROUTER):
        raise UserError(
            f"the role {ROUTER!r} has one member, of the same name: for another router, copy {folder / ROUTER} to its "
            "host"
        )
    for robot in robots:
        check_robot(robot)
    authority, members = _authority(folder), list(read_members(folder / ROUTER))
    existing = next((each for each in members if each.name == name), None)
    if existing is not None:
        if existing.role != role:
            raise UserError(f"{folder / name}: has the role {existing.role!r}; choose another name, or remove it first")
        if not force:
            raise UserError(f"{folder / name}: exists already; --force renews its credentials")
        robots = robots or existing.robots
        if role == ROUTER and not hosts:
            hosts = _hosts_of(_certificate(folder / name / CERTIFICATE))
    member = Member(name=name, role=role, robots=tuple(robots) or EVERY_ROBOT)
    _write_member(folder, authority, member, days, hosts)
    _write_list(folder, [*(each for each in members if each.name != name), member])
    return member


def remove(folder: Path, name: str) -> None:
    """Removes a member from the router's list, and its folder; raises UserError if there is no such member."""
    members = read_members(folder / ROUTER) if _authority(folder) else ()
    if name == ROUTER:
        raise UserError(
            f"{ROUTER!r} cannot be removed: without a router there is no access at all; `presage secure init --force` "
            "replaces all credentials"
        )
    if all(each.name != name for each in members):
        raise UserError(f"no member {name!r}: choose one of {', '.join(each.name for each in members)}")
    _write_list(folder, [each for each in members if each.name != name])
    shutil.rmtree(folder / name, ignore_errors=True)


def expiry(path: Path) -> dt.datetime:
    """Expiry date of a certificate, UTC; raises UserError if the file is not a certificate."""
    return _certificate(path).not_valid_after_utc


def check_robot(name: str) -> None:
    """Raises UserError if the name of a robot cannot be used in names of members and in keys."""
    if re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,40}", name) is None:
        raise UserError(
            f"robot {name!r}: only lower-case letters, digits, - and _ are allowed (it becomes part of names and keys)"
        )


def _new_authority(folder: Path, days: int) -> Authority:
    key, subject = ec.generate_private_key(ec.SECP256R1()), _subject("presage authority")
    certificate = (
        _builder(subject, subject, key, max(3650, 2 * days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_SIGNING_ONLY, critical=True)
        .sign(key, hashes.SHA256())
    )
    _make_folder(folder / AUTHORITY_FOLDER)
    _write(folder / AUTHORITY_FOLDER / AUTHORITY_KEY, _pem(key))
    _write(folder / AUTHORITY_FOLDER / AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return Authority(key, certificate)


_SIGNING_ONLY = x509.KeyUsage(
    digital_signature=False,
    content_commitment=False,
    key_encipherment=False,
    data_encipherment=False,
    key_agreement=False,
    key_cert_sign=True,
    crl_sign=True,
    encipher_only=False,
    decipher_only=False,
)


def _authority(folder: Path) -> Authority:
    path = folder / AUTHORITY_FOLDER / AUTHORITY_KEY
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except FileNotFoundError:
        raise UserError(f"{path}: does not exist; `presage secure init {folder}` makes an authority") from None
    except ValueError:
        raise UserError(f"{path}: not a private key in PEM format") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UserError(f"{path}: not a key made by `presage secure init`")
    return Authority(key, _certificate(folder / AUTHORITY_FOLDER / AUTHORITY))


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise UserError(f"{path}: not a certificate in PEM format") from None


def _write_member(folder: Path, authority: Authority, member: Member, days: int, hosts: Sequence[str]) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    names: list[x509.GeneralName] = [x509.DNSName(member.name)]
    if member.role == ROUTER:
        names = [_host(host) for host in (hosts or DEFAULT_ROUTER_HOSTS)]
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
    """Writes the router's list of members and their passwords."""
    passwords = {
        member.name: (folder / member.name / PASSWORD).read_text(encoding="utf-8").strip() for member in members
    }
    lines = "".join(f"{name}:{password}\n" for name, password in passwords.items())
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
        .not_valid_before(now - dt.timedelta(hours=1))  # tolerates differences between the clocks of hosts
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _hosts_of(certificate: x509.Certificate) -> list[str]:
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [str(name.value) for name in names]


def _pem(key: Key) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _make_folder(path: Path) -> None:
    path.mkdir(parents=True, exist_ok=True)


def _write(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Replaces the file; the new one has its mode from the first byte on, so that a secret is never readable."""
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
    new.chmod(mode)
    new.replace(path)
