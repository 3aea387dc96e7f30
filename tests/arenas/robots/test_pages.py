"""Every robot that comes with the league has a page with its picture, and a picture of its kind is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
NOT_ROBOTS = {
    "__init__",
    "kinds",
    "kinematics",
    "nature",
    "robot",
    "puck",
    "rotations",
}  # the puck is a test piece, told in CONTRIBUTING; nature has no body
ROBOTS = sorted(file.stem for file in (ROOT / "arenas" / "robots").glob("*.py") if file.stem not in NOT_ROBOTS)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_has_a_page_with_a_picture_and_the_files_that_it_names(robot):
    page = (ROOT / "docs" / "robots" / f"{robot}.md").read_text()
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", page)
    assert pictures
    for picture in pictures:
        assert (ROOT / "docs" / "robots" / picture).resolve().read_bytes().startswith(b"\x89PNG")
    files = re.findall(r"`((?:arenas|tests)/[\w/]+\.py)`", page)
    assert f"arenas/robots/{robot}.py" in files
    assert [file for file in files if not (ROOT / file).exists()] == []
