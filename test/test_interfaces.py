"""docs/interfaces.md names everything that scripts may rely on."""

import re
from pathlib import Path

import pytest
from garments import example_garment, example_views

from vflatten_ros import outputs, results
from vflatten_ros.core.buffer import DROP_REASONS
from vflatten_ros.core.values import NOTICE_CODES

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
VIEWS = example_views()
GARMENT = example_garment(VIEWS)


@pytest.mark.parametrize("codes", [NOTICE_CODES, DROP_REASONS], ids=["notices", "drops"])
def test_codes_stand_with_their_meaning(codes):
    assert [code for code, text in codes.items() if f"| `{code}` | {text} |" not in PAGE] == []


def test_every_status_stands_with_its_number():
    text = (ROOT / "msg" / "Status.msg").read_text()
    for name, number in re.findall(r"uint8 ([A-Z_]+)=(\d+)", text):
        assert f"| {number} | {name} |" in PAGE


def test_every_key_of_the_json_is_described():
    result = results.garment_result(GARMENT, VIEWS)
    keys = {*result, "clouds", "timing_s", *result["landmarks"][0], *result["points"]}
    assert [key for key in keys if f"`{key}`" not in PAGE] == []


def test_every_output_is_described():
    for message in outputs.result_messages(GARMENT, VIEWS):
        assert f"`{message.topic}`" in PAGE
        assert message.type.split("/")[1] in PAGE
