"""Authority, members, and the commands that make them."""

from __future__ import annotations

import json
import stat

import pytest
from cryptography import x509
from cryptography.x509.oid import NameOID
from typer.testing import CliRunner

from common.bus.security import read_credentials, read_members
from common.errors import UserError
from presage.cli.main import app
from presage.session import credentials as secure

run = CliRunner()


def certificate(folder, name):
    return x509.load_pem_x509_certificate((folder / name / "own.crt").read_bytes())


def test_certificates_and_secrets(tmp_path):
    members = secure.init(tmp_path, hosts=["robot.lan", "10.0.0.1"], days=30)
    assert {member.name for member in members} >= {"router", "controller", "observer", "viewer-control"}
    assert not {"replay", "remote", "bridge_ros2"} & {member.name for member in members}
    authority = x509.load_pem_x509_certificate((tmp_path / "authority" / "ca.crt").read_bytes())
    for member in members:
        mine = certificate(tmp_path, member.name)
        mine.verify_directly_issued_by(authority)
        assert mine.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == member.name
        assert 29 <= (mine.not_valid_after_utc - mine.not_valid_before_utc).days <= 31
    names = certificate(tmp_path, "router").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["robot.lan"]
    secrets = [*tmp_path.glob("*/*.key"), *tmp_path.glob("*/password*")]
    assert len(secrets) == 2 * len(members) + 2
    assert {stat.S_IMODE(path.stat().st_mode) for path in secrets} == {0o600}
    passwords = [path.read_text() for path in tmp_path.glob("*/password")]
    assert len(set(passwords)) == len(members)


def test_overwriting(tmp_path):
    secure.init(tmp_path)
    before = (tmp_path / "controller" / "own.key").read_bytes()
    with pytest.raises(UserError, match="--force"):
        secure.init(tmp_path)
    with pytest.raises(UserError, match="--force"):
        secure.add(tmp_path, "controller", "controller")
    assert (tmp_path / "controller" / "own.key").read_bytes() == before
    secure.add(tmp_path, "controller", "controller", force=True)
    assert (tmp_path / "controller" / "own.key").read_bytes() != before
    secure.add(tmp_path, "operator", "anna")
    with pytest.raises(UserError, match="has the role 'operator'"):
        secure.add(tmp_path, "replay", "anna", force=True)
    secure.init(tmp_path, force=True)
    assert not (tmp_path / "anna").exists()
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis").touch()
    with pytest.raises(UserError, match="not made by `presage secure`"):
        secure.init(tmp_path / "home", force=True)


def test_added_and_removed_member(tmp_path):
    secure.init(tmp_path)
    secure.add(tmp_path, "operator", "anna", ["one"])
    router = read_credentials(tmp_path, ("router",))
    assert router.members[-1].robots == ("one",)
    assert (tmp_path / "anna" / "password").read_text().strip() in (tmp_path / "router" / "passwords").read_text()
    secure.remove(tmp_path, "anna")
    assert "anna" not in {member.name for member in read_members(tmp_path / "router")}
    assert "anna" not in (tmp_path / "router" / "passwords").read_text()
    with pytest.raises(UserError, match="no member 'anna': choose one of router, "):
        secure.remove(tmp_path, "anna")


@pytest.mark.parametrize(
    ("role", "name", "why"),
    [
        ("king", "arthur", "no role 'king'"), ("operator", "Anna", "lower-case"), ("operator", "a.b", "lower-case"),
        ("operator", "authority", "authority"), ("operator", "../x", "lower-case"), ("router", "two", "one member"),
        ("operator", "router", "one member"),
    ],
)  # fmt: skip
def test_invalid_names(tmp_path, role, name, why):
    secure.init(tmp_path)
    with pytest.raises(UserError, match=why):
        secure.add(tmp_path, role, name)


def test_secure_commands(tmp_path):
    folder = str(tmp_path / "keys")
    made = run.invoke(app, ["secure", "init", folder, "--robots", "one,two", "--days", "90"])
    assert made.exit_code == 0, made.output
    assert "14 members" in made.output
    added = run.invoke(app, ["secure", "add", folder, "observer", "guest", "--days", "10"])
    assert added.exit_code == 0, added.output
    shown = run.invoke(app, ["secure", "show", folder])
    assert shown.exit_code == 1, shown.output  # guest's ends soon
    assert "expiring within 30 days: guest" in shown.output
    assert "controller-two" in shown.output
    assert run.invoke(app, ["secure", "remove", folder, "guest"]).exit_code == 0
    assert run.invoke(app, ["secure", "show", folder]).exit_code == 0
    config = json.loads(run.invoke(app, ["secure", "show", folder, "--zenoh", "observer"]).output)
    assert config["mode"] == "client"
    assert config["transport"]["link"]["tls"]["enable_mtls"] is True


def test_renewed_credentials_keep_their_limits(tmp_path):
    secure.init(tmp_path, hosts=["robot.lan", "10.0.0.1"], robots=["one"])
    password = (tmp_path / "controller-one" / "password").read_text()
    renewed = secure.add(tmp_path, "controller", "controller-one", force=True)
    assert renewed.robots == ("one",)
    assert (tmp_path / "controller-one" / "password").read_text() != password
    assert secure.add(tmp_path, "controller", "controller-one", ["two"], force=True).robots == ("two",)
    secure.add(tmp_path, "router", "router", force=True)
    names = certificate(tmp_path, "router").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["robot.lan"]
    assert [str(address) for address in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.1"]
