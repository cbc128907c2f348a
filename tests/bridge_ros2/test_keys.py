"""Keys, tokens and attachments as rmw_zenoh and zenoh-bridge-ros2dds have them."""

from __future__ import annotations

import struct

import pytest
from zenoh import KeyExpr

from services.bridge_ros2.keys import (
    LATCHED_QOS,
    SENSOR_QOS,
    TOKEN_KEYS,
    BridgeNode,
    Qos,
    RosEndpoint,
    RosKeys,
    attachment,
    full_name,
    publisher_gid,
    read_attachment,
    read_token,
)
from services.bridge_ros2.ros_types import LASER_SCAN, TWIST, type_hash

# From microcontrollers' firmware that speaks to rmw_zenoh of Jazzy, and from its documentation.
TWIST_KEY = "0/nucleo/cmd_vel/geometry_msgs::msg::dds_::Twist_/" + type_hash(TWIST)
TOKEN = (
    "@ros2_lv/0/100f0e0d0c0b0a090807060504030201/0/16/MS/%/%/nucleo_h743zi2/%nucleo%cmd_vel/"
    "geometry_msgs::msg::dds_::Twist_/" + type_hash(TWIST) + "/::,:,:,:,,"
)
NODE = BridgeNode(RosKeys(), "100f0e0d0c0b0a090807060504030201", "", "nucleo_h743zi2")


def test_keys_of_rmw_zenoh():
    assert RosKeys().publish("/nucleo/cmd_vel", TWIST) == TWIST_KEY
    assert RosKeys(domain=7, hashes=False).publish("/scan", LASER_SCAN) == (
        "7/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"
    )
    heard = KeyExpr(RosKeys().subscribe("/scan", LASER_SCAN))
    for names in (RosKeys(), RosKeys(hashes=False)):
        assert heard.includes(KeyExpr(names.publish("/scan", LASER_SCAN)))
    assert not heard.intersects(KeyExpr(RosKeys().publish("/scan_raw", LASER_SCAN)))


def test_keys_of_ros2dds():
    names = RosKeys("ros2dds", domain=3)
    assert names.publish("/robot1/scan", LASER_SCAN) == names.subscribe("/robot1/scan", LASER_SCAN) == "robot1/scan"
    assert KeyExpr(names.caches("/tf_static")[0]).includes(KeyExpr("@/a1/@ros2_pub_cache/tf_static"))
    assert any(KeyExpr(k).includes(KeyExpr("@/a1/@ros2_lv/MP/scan/sensor_msgs§msg§LaserScan/:::")) for k in TOKEN_KEYS)


def test_tokens():
    qos = Qos(depth=42)  # the default of rmw_zenoh
    assert NODE.endpoint_token("MS", 16, "/nucleo/cmd_vel", TWIST, qos) == TOKEN
    assert NODE.token() == "@ros2_lv/0/100f0e0d0c0b0a090807060504030201/0/0/NN/%/%/nucleo_h743zi2"
    spaced = BridgeNode(RosKeys(domain=5), "ab", "/robot1/", "presage").endpoint_token("MP", 1, "/robot1/x", TWIST, qos)
    assert spaced.startswith("@ros2_lv/5/ab/0/1/MP/%/%robot1/presage/%robot1%x/")
    KeyExpr(spaced)  # a key expression that zenoh takes
    assert any(KeyExpr(k).includes(KeyExpr(TOKEN)) for k in TOKEN_KEYS)


def test_quality_of_service():
    assert (SENSOR_QOS.text(), LATCHED_QOS.text(), Qos().text()) == ("2::,5:,:,:,,", ":1:,1:,:,:,,", "::,10:,:,:,,")


def test_read_tokens():
    assert read_token(TOKEN) == RosEndpoint(
        False, "/nucleo/cmd_vel", TWIST, type_hash(TWIST), "/nucleo_h743zi2", domain=0
    )
    for key in ("@/a1/@ros2_lv/MP/robot1§scan/sensor_msgs§msg§LaserScan/:::", "@ros2_lv/a1/MP/robot1§scan/sensor_msgs§msg§LaserScan/:::"):  # fmt: skip  # noqa: E501
        assert read_token(key) == RosEndpoint(True, "/robot1/scan", LASER_SCAN, flavor="ros2dds")
    for key in (
        NODE.token(),
        "@/a1/@ros2_lv",
        "@ros2_lv",
        "a/b/c",
        "@ros2_lv/0/z/0/1/SS/%/%/n/%s/t/h/q",
        "@ros2_lv/a/MP",
    ):
        assert read_token(key) is None


def test_attachment():
    gid = bytes(range(16))
    data = attachment(3, 1_700_000_000_123_456_789, gid)
    assert data == struct.pack("<qq", 3, 1_700_000_000_123_456_789) + b"\x10" + gid
    assert len(data) == 33
    assert read_attachment(data) == (3, 1_700_000_000_123_456_789, gid)
    legacy = b"\x0fsequence_number" + data[:8] + b"\x10source_timestamp" + data[8:16] + b"\x0asource_gid" + data[16:]
    assert len(legacy) == 77
    assert read_attachment(legacy) == read_attachment(data)  # Jazzy's first versions
    for none in (b"", data[:-1], data + b"\0", b"\0" * 33):
        assert read_attachment(none) is None


def test_gid():
    """XXH3 of 128 bits: of nothing, by its specification, 99aa06d3014798d8 6001c324468d497f, the higher half first."""
    assert publisher_gid("") == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1]
    assert publisher_gid(TOKEN) != publisher_gid(TOKEN + "x")


@pytest.mark.parametrize(
    ("topic", "namespace", "name"),
    [
        ("scan", "", "/scan"),
        ("scan", "robot1", "/robot1/scan"),
        ("scan", "/a/b/", "/a/b/scan"),
        ("/tf", "robot1", "/tf"),
    ],
)
def test_names_in_a_namespace(topic, namespace, name):
    assert full_name(topic, namespace) == name


def test_other_type_hash():
    names = RosKeys()
    names.check_type_hash(names.publish("/scan", LASER_SCAN), LASER_SCAN)
    names.check_type_hash(RosKeys(hashes=False).publish("/scan", LASER_SCAN), LASER_SCAN)
    with pytest.raises(ValueError, match=r"RIHS01_00.*another definition"):
        names.check_type_hash("0/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_00", LASER_SCAN)
    RosKeys("ros2dds").check_type_hash("scan", LASER_SCAN)
