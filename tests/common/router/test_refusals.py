"""Refusals read from zenoh's log; the lines are those of zenoh 1.10."""

from __future__ import annotations

from common.router.refusals import Refusal, ZenohLogParser

AT = "2026-01-01T00:00:00.000000Z"
ACCESS = "zenoh::net::routing::interceptor::access_control"
CERTIFICATE_READ = (
    f"{AT} DEBUG acc-0 ThreadId(05) zenoh_link_tls::unicast: Accepted TLS connection on 10.0.0.1:7447: "
    "10.0.0.2:50998. Common Name: observer."
)
LINK_ACCEPTED = (
    f"{AT} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: New transport link accepted from "
    "9e87 to 607b: TransportLinkUnicast { link: Link { src: tls/10.0.0.1:7447, dst: tls/10.0.0.2:50998, mtu: 1 } }"
)


def denied(what, key, zid="9e87", how="Using cached result: ", flow="ingress"):
    return f"{AT} TRACE  rx-1 ThreadId(09) {ACCESS}: {how}{zid} is unauthorized to {what} ({flow}) on {key}"


def read(*lines):
    reader = ZenohLogParser()
    return [found for line in lines if (found := reader.read(line)) is not None]


def test_name_of_a_refused_sender():
    assert read(CERTIFICATE_READ, LINK_ACCEPTED, denied("Put", "presage/r/cmd_vel")) == [
        Refusal("put", "observer", "presage/r/cmd_vel")
    ]
    assert read(denied("Put", "presage/r/cmd_vel")) == [Refusal("put", "", "presage/r/cmd_vel")]


def test_cached_permissions():
    planned = [f"{AT} TRACE  rx-1 ThreadId(09) {ACCESS}: ACL (ingress): caching permissions for `presage/r/goal` ..."]
    subject = "9e87 on Interface(lo)+CertCommonName(observer)+Username(observer)"
    planned += [denied(f"Kind{what}", "presage/r/goal", subject, how="") for what in range(9)]
    asked = denied("Query", "presage/r/teleport", subject, how="")
    assert read(CERTIFICATE_READ, LINK_ACCEPTED, *planned, asked) == [
        Refusal("query", "observer", "presage/r/teleport")
    ]


def test_messages_not_forwarded():
    assert read(denied("Put", "presage/r/goal", flow="egress")) == []
    assert read(denied("Put", "presage/r/goal").replace("unauthorized", "authorized")) == []


def test_colours_are_removed():
    coloured = denied("Put", "presage/r/goal").replace("TRACE", "\x1b[35mTRACE\x1b[0m")
    assert read(coloured) == [Refusal("put", "", "presage/r/goal")]


def test_handshakes():
    accept = f"{AT} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: "
    tls = f"{AT}  WARN acc-1 ThreadId(07) zenoh_link_tls::unicast: "
    assert read(
        CERTIFICATE_READ, accept + "UsrPwd extension - Recv OpenSyn. Invalid password. at /src/x.rs:1.",
        accept + "UsrPwd extension - Recv InitSyn. Expected extension. at /src/x.rs:1.",
        tls + "invalid peer certificate: BadSignature. Hint: increase the system open file limit.",
        tls + "peer sent no certificates. Hint: increase the system open file limit.",
        tls + "received corrupt message of type InvalidContentType. Hint: increase the system open file limit.",
        tls + "Timeout during TLS handshake. Hint: increase the system open file limit.",
        tls + "tls handshake eof. Hint: increase the system open file limit.",
    ) == [
        Refusal("wrong password", "observer"), Refusal("no password", "observer"),
        Refusal("certificate of another authority, or expired"), Refusal("no certificate"), Refusal("no TLS"),
        Refusal("no TLS handshake in time"),
    ]  # fmt: skip


def test_other_errors_of_zenoh_are_passed_on():
    line = f"{AT} ERROR rx-0 ThreadId(12) zenoh::something: went wrong"
    assert read(line) == [line]
    assert read("") == []


def test_repeated_connections():
    reader = ZenohLogParser()
    for number in range(5000):
        reader.read(CERTIFICATE_READ.replace("10.0.0.2:50998", f"10.0.0.2:{number}"))
    assert len(reader._names) <= 1000
