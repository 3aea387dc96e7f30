"""Fixtures of `league rate` for logs of pairs and of rankings."""

import json

import pytest

from league.commands.cli import main


@pytest.fixture
def rate_file(tmp_path, monkeypatch, capsys):
    """Run the command on a file of these rows: exit code, output, complaint."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")

    def run(rows, *args, head):
        (tmp_path / "log.csv").write_text("\n".join([head, *rows]) if head else "")
        with pytest.raises(SystemExit) as left:
            main(["rate", *args])
        return left.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def rated(rate):
    """Run `rate` of the test's own module, and return its JSON."""

    def run(rows, *args, **named):
        code, out, err = rate(rows, *args, "--format", "json", **named)
        assert (code, err) == (0, "")
        return json.loads(out)

    return run
