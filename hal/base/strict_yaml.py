"""YAML of users' files: plain data, with duplicate keys, alias bombs and endless nesting rejected in one line."""

from __future__ import annotations

from typing import Any

import yaml

_MAX_NODES = 100_000  # a hundred times the whole configuration


class StrictYamlError(ValueError):
    """Content that is no YAML, or that is rejected; the message is one line with its place."""


def load_strict(text: str) -> Any:
    """Return the content of one YAML document.

    Raises:
        StrictYamlError: it is not YAML, repeats a key, refers to itself, or expands to more than 100,000 values.
    """
    loader = None
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node, {})
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        raise StrictYamlError(f"{error.problem or error.context}{_place(error.problem_mark)}") from error
    except RecursionError as error:
        raise StrictYamlError("it is nested too deeply") from error
    except StrictYamlError:
        raise
    except Exception as error:  # PyYAML's readers of numbers and dates raise whatever int() or date() do
        raise StrictYamlError(" ".join(str(error).split())[:160] or type(error).__name__) from error
    finally:
        if loader is not None:
            loader.dispose()


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Return the number of values that `node` expands to.

    Args:
        node: the node.
        known: the same of finished nodes, by identity; 0 for those that contain this one.
    """
    if id(node) in known:
        if not (count := known[id(node)]):
            raise StrictYamlError(f"a value contains itself{_place(node.start_mark)}")
        return count
    known[id(node)] = 0
    count = 1
    if isinstance(node, yaml.MappingNode):
        keys = set()
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if (key.tag, key.value) in keys:
                    raise StrictYamlError(f"the key {key.value!r} is there twice{_place(key.start_mark)}")
                keys.add((key.tag, key.value))
            count += _count(key, known) + _count(value, known)
    elif isinstance(node, yaml.SequenceNode):
        count += sum(_count(item, known) for item in node.value)
    if count > _MAX_NODES:
        raise StrictYamlError(f"its aliases expand to more than {_MAX_NODES} values{_place(node.start_mark)}")
    known[id(node)] = count
    return count


def _place(mark: yaml.Mark | None) -> str:
    return f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
