"""`./z1 show-config`: every setting in force with its origin, as YAML that `--config` accepts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from hal.base.files import plain, read_yaml
from z1_runtime.config import load_config


@dataclass(frozen=True, kw_only=True)
class ShowConfig:
    """Configuration to show."""

    config: Path | None = None
    """YAML file whose values override the defaults."""


Config = ShowConfig


def main(config: ShowConfig) -> int:
    """Print the configuration.

    Raises:
        ConfigError: the file cannot be used.
    """
    resolved = asdict(load_config(config.config))
    given = read_yaml(config.config, "the configuration") or {} if config.config else {}
    print("\n".join(to_lines(resolved, given, str(config.config))))
    return 0


def to_lines(values: Mapping[str, Any], given: Mapping[str, Any], source: str, depth: int = 0) -> Iterator[str]:
    """Yield `values` as lines of YAML, each with its origin: `source` for the keys in `given`, else the default."""
    indent = "  " * depth
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield f"{indent}{key}:"
            yield from to_lines(value, given.get(key) or {}, source, depth + 1)
        else:
            # One line for each value, however long; "..." is YAML's end of a lone scalar
            text = yaml.safe_dump(plain(value), default_flow_style=True, width=10_000).removesuffix("...\n").strip()
            yield f"{indent}{key}: {text}  # {source if key in given else 'default'}"
