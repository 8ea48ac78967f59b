"""`./z1 docs`: the command line that it runs, and its options."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hal.base.errors import InvalidValueError, SdkMissingError
from scripts.commands import serve_docs
from scripts.commands.serve_docs import ServeDocsConfig, main, make_command
from tests.support.errors import raises


def test_documentation_is_served_on_the_address_given() -> None:
    command = make_command(ServeDocsConfig(port=8123))
    assert command == [sys.executable, "-m", "mkdocs", "serve", "-f", "mkdocs.yml", "--dev-addr", "127.0.0.1:8123"]


def test_documentation_is_built_into_the_folder_given() -> None:
    command = make_command(ServeDocsConfig(build=Path("out/site")))
    assert command[3:] == ["build", "-f", "mkdocs.yml", "--site-dir", str(Path("out/site").resolve())]


@pytest.mark.parametrize("port", [0, 65536])
def test_port_out_of_range_is_rejected(port: int) -> None:
    with raises(InvalidValueError, "invalid_value"):
        ServeDocsConfig(port=port)


def test_missing_mkdocs_is_an_error_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve_docs, "find_spec", lambda _: None)
    with raises(SdkMissingError, "sdk_missing") as caught:
        main(ServeDocsConfig())
    assert "--group docs" in str(caught.value)
