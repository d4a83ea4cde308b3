"""Kinds of assets that a survey asks for, with their validated settings, each after those that it uses."""

from __future__ import annotations

from dataclasses import dataclass

from roadscan.assets.kind import AssetKind, asset_kinds
from roadscan.assets.settings import AssetsConfig
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.strict import Strict
from roadscan.run.code_reach import code_digest, name_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.asset_schema import AssetSchema, asset_schema


@dataclass(frozen=True)
class WantedKind:
    """A kind of assets and what determines its evidence and its objects, beside the returns."""

    kind: AssetKind
    options: Strict

    @property
    def name(self) -> str:
        """Returns its name."""
        return self.kind.name

    @property
    def schema(self) -> AssetSchema:
        """Returns its schema."""
        return asset_schema(self.kind.name)

    def evidence_key(self) -> str:
        """Returns the key of what determines its evidence."""
        code = code_digest("roadscan.assets.tasks.evidence:find_evidence", name_of(type(self.kind)))
        return key_of(self.name, code, self.options.model_dump(mode="json"))

    def objects_key(self) -> str:
        """Returns the key of what determines its objects."""
        code = code_digest("roadscan.assets.tasks.objects:join_objects", name_of(type(self.kind)))
        columns = [[c.name, c.type] for c in self.schema.columns]
        return key_of(self.name, code, self.options.model_dump(mode="json"), columns)


def wanted_kinds(config: AssetsConfig) -> tuple[WantedKind, ...]:
    """Returns the requested kinds and those that they need, each after those that it names.

    Raises
    ------
    ConfigError
        for a kind that does not exist, settings that it does not have, or kinds that wait for one another.
    """
    known = asset_kinds()
    for name in (*(config.kinds or ()), *config.options):
        if name not in known:
            raise ConfigError(
                f"[assets] names the unknown kind '{name}'{nearest(name, known)}",
                expected="one of: " + ", ".join(known),
            )
    waiting = dict.fromkeys(sorted(known) if config.kinds is None else config.kinds)
    for name in list(waiting):
        waiting.update(dict.fromkeys(_needed(name, known)))
    ordered: list[str] = []
    while waiting:
        ready = sorted(name for name in waiting if all(n in ordered or n not in known for n in known[name].after))
        if not ready:
            raise ConfigError(f"these kinds wait for one another: {', '.join(sorted(waiting))}")
        ordered.append(ready[0])
        del waiting[ready[0]]
    return tuple(WantedKind(known[name], _options(known[name], config)) for name in ordered)


def _needed(name: str, known: dict[str, AssetKind]) -> list[str]:
    """Returns all kinds that a kind uses, directly or not, as far as they exist."""
    found: list[str] = []
    waiting = [name]
    while waiting:
        for one in known[waiting.pop()].after:
            if one in known and one not in found:
                found.append(one)
                waiting.append(one)
    return found


def _options(kind: AssetKind, config: AssetsConfig) -> Strict:
    try:
        return kind.options.parse(config.options.get(kind.name, {}))
    except ConfigError as error:
        raise ConfigError(
            f"[assets.options.{kind.name}] {error.arrived}", expected=error.expected, change=error.change
        ) from error
