"""What the documents say is what the code does."""

from __future__ import annotations

import re
from pathlib import Path

from typer.testing import CliRunner

from geofleet.cli import app
from geofleet.config import SECTIONS

REPO = Path(__file__).parent.parent
README = (REPO / "README.md").read_text(encoding="utf-8")


def test_every_command_and_option_in_the_readme_exists():
    pages = {}
    for line in re.findall(r"^geofleet .*$", README, flags=re.MULTILINE):
        words = line.partition("#")[0].replace('"', " ").split()[1:]
        command = [word for word in words[:2] if re.fullmatch(r"[a-z-]+", word) and not word.startswith("-")]
        command = command if command[0] in {"ingest", "study"} else command[:1]
        key = " ".join(command)
        if key not in pages:
            result = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
            assert result.exit_code == 0, key
            pages[key] = result.output
        for option in (word for word in words if word.startswith("--")):
            assert option in pages[key], f"{key} has no {option}"
    assert {"ingest signs", "simulate", "aggregate", "evaluate", "sql"} <= set(pages)


def test_every_make_target_in_the_readme_exists():
    targets = re.findall(r"^([a-z]+):", (REPO / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert {"demo", "test"} <= set(re.findall(r"make ([a-z]+)", README)) <= set(targets)


def test_every_link_of_the_documents_leads_somewhere():
    for page in [REPO / "README.md", *(REPO / "docs").rglob("*.md"), REPO / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} -> {target}"


def test_settings_named_in_the_paper_page_exist():
    page = (REPO / "docs" / "paper.md").read_text(encoding="utf-8")
    keys = {key for section in SECTIONS.values() for key in section.model_fields}
    named = {word for word in re.findall(r"`([a-z_]+)`", page) if "_" in word}
    assert named <= keys, named - keys
