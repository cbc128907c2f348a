"""docs/messages.md agrees with the source."""

from __future__ import annotations

import re
from pathlib import Path

from common.messages.definitions import Belief, Scan, Stamped
from common.messages.reference import page
from common.messages.topics import QUERIES, TOPICS

PAGE = Path(__file__).resolve().parents[3] / "docs" / "messages.md"


def test_the_page_is_current():
    assert PAGE.read_text(encoding="utf-8") == page(), "run: python -m common.messages.reference > docs/messages.md"


def test_the_page_lists_all_topics_and_fields():
    text = page()
    for row in (*TOPICS, *QUERIES):
        name = row.key("<robot>", "<service>").removeprefix("presage/<robot>/")
        assert f"\n`{name}` | " in text
        assert row.about in text
    for cls in (Scan, Belief):
        section = text.split(f"### {cls.__name__}\n")[1].split("###")[0]
        own = cls.model_fields.keys() - Stamped.model_fields.keys() - {"frame_id"}
        assert all(f"\n    {name}: " in section or f"\n    {name}=" in section for name in own)
        assert re.search(rf"\bin [^;]*\b{cls.__name__}\b", text)  # its frame_id, at the top of the page
    assert "\n    mount: Pose = " in text  # a type and a default
    assert "\n    yaw=0.0 " in text  # a default that shows the type
    assert "+inf is nothing within range_max" in text  # a comment beside its field
    assert "the negative gradient of accuracy" in " ".join(text.split())  # a comment above its field


def test_links_have_targets():
    text = page()
    anchors = {line[4:].lower() for line in text.splitlines() if line.startswith("### ")}
    linked = {part.split(")")[0] for part in text.split("](#")[1:]}
    assert linked <= anchors
