"""YAML as configurations and model cards need it, and nothing that could take a reader's time or memory.

Aliases are refused: nested ones describe structures that are larger than any memory, or contain themselves. Size,
depth, number of values and length of numbers are bounded, far above what a configuration takes.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from uni4d_fg.errors import ConfigError

MAX_YAML_BYTES = 256 * 1024
_MAX_VALUES = 10_000
_MAX_DEPTH = 20
_MAX_NUMBER = 40
"""Characters of a number."""

_INT_TAG, _FLOAT_TAG = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"


class _PlainLoader(yaml.SafeLoader):
    """The safe loader, which also reads 1e-3 as a number, refuses aliases and repeated keys, and keeps to bounds."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = self._values = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        self._values += 1
        self._depth += 1
        if self.check_event(yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise _refused(event, "anchors and aliases (& and *) are not allowed; write the values out")
        if self._values > _MAX_VALUES:
            raise _refused(event, f"there are more than {_MAX_VALUES} values; is it the right file?")
        if self._depth > _MAX_DEPTH:
            raise _refused(event, f"values are nested more than {_MAX_DEPTH} deep; is it the right file?")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                if key_node.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"{key_node.value!r} is given twice", key_node.start_mark
                    )
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """Construct a number that is not too long."""
        if len(str(node.value)) > _MAX_NUMBER:
            raise _refused(node, f"a number has more than {_MAX_NUMBER} characters")
        made = super().construct_yaml_int if node.tag == _INT_TAG else super().construct_yaml_float
        number: int | float = made(node)
        return number


for _tag in (_INT_TAG, _FLOAT_TAG):
    _PlainLoader.add_constructor(_tag, _PlainLoader.construct_number)
_PlainLoader.add_implicit_resolver(
    _FLOAT_TAG, re.compile(r"^[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)
# "on" and "off" are values of fields; as booleans there are true, false, yes and no.
for _letter in "oO":
    _PlainLoader.yaml_implicit_resolvers[_letter] = []


def parse_yaml(text: str) -> Any:
    """Return the values in a YAML text.

    Raises:
        ConfigError: If it is no YAML, too large, nested too deep, or has aliases or a key twice; the message is the
            reason alone.
    """
    if len(text) > MAX_YAML_BYTES:
        raise ConfigError(f"more than {MAX_YAML_BYTES} characters; is it the right file?")
    try:
        return yaml.load(text, _PlainLoader)
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise ConfigError(f"{line}{error.problem}") from error
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ConfigError(" ".join(str(error).split()) or type(error).__name__) from error


def _refused(place: Any, what: str) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, what, place.start_mark)
